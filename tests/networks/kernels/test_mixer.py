"""The compiled mixer does what torch's operations do."""

import math

import pytest
import torch

from esp_cli.networks.joint_q import MonotonicMixer
from esp_cli.networks.kernels.mixer import CompiledMixer
from tests.networks.kernels.compiler import assert_same_bits_alone_and_for_any_threads, needs_compiler
from tests.networks.test_layers import generators


@needs_compiler
@pytest.mark.parametrize(("num_agents", "width", "rows"), [(3, 32, 700), (4, 7, 13), (2, 33, 3000)])
def test_values_and_gradients_equal_those_of_torch(num_agents, width, rows):
    torch.manual_seed(0)
    compiled, eager = (MonotonicMixer(generators(0, 1), num_agents, 6, width, 16, c) for c in (True, False))
    state, weight = torch.randn(2, rows, 6, requires_grad=True), torch.randn(2, rows)
    found = []
    for mixer in (compiled, eager):
        own = torch.randn(2, rows, num_agents, generator=torch.Generator().manual_seed(1)).requires_grad_()
        total = mixer(own, state)
        found.append([total, *torch.autograd.grad((total * weight).sum(), [own, state, *mixer.parameters()])])
    for ours, theirs in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5 * max(1.0, theirs.abs().max().item()))


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
def test_values_may_have_any_axes(compiled):
    mixer = MonotonicMixer(generators(0, 1), 3, 6, 5, 8, compiled)
    values, state = torch.randn(2, 4, 7, 3), torch.randn(2, 4, 7, 6)
    torch.testing.assert_close(mixer(values, state)[:, 2, 5], mixer(values[:, 2, 5], state[:, 2, 5]))


@needs_compiler
def test_two_agents_and_two_units_by_hand():
    """Units 1 * 2 + |-2| * 3 + 1 = 9 and |-1| * 2 + 0 * 3 - 3 = -1, so 9 and 1/e - 1; with |-2| and 3: 14.1036..."""
    own = torch.tensor([[[2.0, 3.0]]])
    weights = torch.tensor([[[1.0, -1.0, -2.0, 0.0, 1.0, -3.0, -2.0, 3.0, -2.0]]])
    hidden = [torch.zeros(1, 4, 5), torch.ones(1, 1, 5)]  # units of the hypernetwork, whose last bias says the weights
    run = CompiledMixer(2, [own, torch.randn(1, 1, 4)], [*hidden, torch.zeros(1, 5, 9), weights], keep=True)
    below = math.exp(-1) - 1
    assert run.outputs.item() == pytest.approx(2 * 9 + 3 * below - 2, abs=1e-5)
    (_, by_hidden, by_last, by_weights), (by_own, _) = run.backward_to(
        torch.tensor([[10.0]]), [True] * 4, [True, False]
    )
    first, second = 20.0, 30 * math.exp(-1)  # by the sums of both units
    assert by_own.flatten().tolist() == pytest.approx([first + second, 2 * first], abs=1e-3)
    by_hand = [2 * first, -2 * second, -3 * first, 0.0, first, second, -90.0, 10 * below, 10.0]
    assert by_weights.flatten().tolist() == pytest.approx(by_hand, abs=1e-3)
    torch.testing.assert_close(by_last, by_weights.expand(1, 5, 9), msg="all units of the hypernetwork are 1")
    assert not by_hidden.any(), "no weight leads from the hidden units to the outputs"


@needs_compiler
def test_a_seed_alone_and_any_number_of_threads_give_the_same_bits():
    torch.manual_seed(0)
    own, state, grad = torch.randn(3, 500, 3), torch.randn(3, 500, 7), torch.randn(3, 500)
    parameters = [torch.randn(3, *size) for size in ((7, 16), (1, 16), (16, 5 * 20 + 1), (1, 5 * 20 + 1))]

    def found(seeds):
        run = CompiledMixer(20, [own[seeds], state[seeds]], [p[seeds] for p in parameters], keep=True)
        grads, below = run.backward_to(grad[seeds], [True] * 4, [True, True])
        return [run.outputs, *grads, *below]

    assert_same_bits_alone_and_for_any_threads(found, 3)
