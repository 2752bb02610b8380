"""The compiled mixer does what torch's operations do."""

import math

import pytest
import torch

from esp_cli.kernels.mixer import mix, mix_backward
from esp_cli.networks.mixer import MonotonicMixer
from tests.kernels.compiler import assert_same_bits_alone_and_for_any_threads, needs_compiler
from tests.networks.test_layers import generators


@needs_compiler
@pytest.mark.parametrize(("num_agents", "width", "rows"), [(3, 32, 700), (4, 7, 13), (2, 33, 3000)])
def test_values_and_gradients_equal_those_of_torch(num_agents, width, rows):
    torch.manual_seed(0)
    compiled, eager = (MonotonicMixer(generators(0, 1), num_agents, 6, width, 16, c) for c in (True, False))
    state, weight = torch.randn(2, rows, 6), torch.randn(2, rows)
    found = []
    for mixer in (compiled, eager):
        own = torch.randn(2, rows, num_agents, generator=torch.Generator().manual_seed(1)).requires_grad_()
        total = mixer(own, state)
        found.append([total, *torch.autograd.grad((total * weight).sum(), [own, *mixer.parameters()])])
    for ours, theirs in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5 * max(1.0, theirs.abs().max().item()))


@needs_compiler
def test_two_agents_and_two_units_by_hand():
    """Units 1 * 2 + |-2| * 3 + 1 = 9 and |-1| * 2 + 0 * 3 - 3 = -1, so 9 and 1/e - 1; with |-2| and 3: 14.1036..."""
    own = torch.tensor([[[2.0, 3.0]]])
    weights = torch.tensor([[[1.0, -1.0, -2.0, 0.0, 1.0, -3.0, -2.0, 3.0, -2.0]]])
    below = math.exp(-1) - 1
    assert mix(own, weights, 2).item() == pytest.approx(2 * 9 + 3 * below - 2, abs=1e-5)
    by_own, by_weights = mix_backward(own, weights, 2, torch.tensor([[10.0]]))
    first, second = 20.0, 30 * math.exp(-1)  # by the sums of both units
    assert by_own.flatten().tolist() == pytest.approx([first + second, 2 * first], abs=1e-3)
    by_hand = [2 * first, -2 * second, -3 * first, 0.0, first, second, -90.0, 10 * below, 10.0]
    assert by_weights.flatten().tolist() == pytest.approx(by_hand, abs=1e-3)


@needs_compiler
def test_a_seed_alone_and_any_number_of_threads_give_the_same_bits():
    torch.manual_seed(0)
    own, weights, grad = torch.randn(3, 500, 3), torch.randn(3, 500, 5 * 20 + 1), torch.randn(3, 500)

    def found(seeds):
        given = (own[seeds], weights[seeds], 20)
        return [mix(*given), *mix_backward(*given, grad[seeds])]

    assert_same_bits_alone_and_for_any_threads(found, 3)
