"""The compiled recurrent unit does what torch's operations do."""

import pytest
import torch

from esp_cli.networks.kernels.recurrent import CompiledUnroll
from esp_cli.networks.recurrent import SeedGRU
from tests.networks.gradients import assert_same_gradients
from tests.networks.kernels.compiler import assert_same_bits_alone_and_for_any_threads, needs_compiler
from tests.networks.test_layers import generators


@needs_compiler
@pytest.mark.parametrize("truncation", [0, 3])
@pytest.mark.parametrize(("inputs", "hidden", "rows"), [(64, 64, 192), (6, 5, 3), (20, 33, 130)])
def test_memories_and_gradients_equal_those_of_autograd(inputs, hidden, rows, truncation):
    torch.manual_seed(0)
    compiled, eager = (SeedGRU(generators(0, 1), inputs, hidden, c) for c in (True, False))
    for ours, theirs in zip(compiled.parameters(), eager.parameters(), strict=True):
        theirs.data.normal_(0, 0.4)
        ours.data.copy_(theirs.data)
    x = torch.randn(2, 7, rows, inputs)
    memories, weight = compiled.unroll(x, truncation), torch.randn(2, 7, rows, hidden)
    assert type(memories.grad_fn).__name__ == "_PassedBackward"
    with torch.no_grad():
        torch.testing.assert_close(compiled.unroll(x, truncation), memories, rtol=0, atol=0)
    torch.testing.assert_close(memories, eager.unroll(x, truncation), rtol=1e-5, atol=1e-5)
    found = [
        torch.autograd.grad((unit.unroll(there, truncation) * weight).sum(), [there, *unit.parameters()])
        for unit, there in ((compiled, x.clone().requires_grad_()), (eager, x.clone().requires_grad_()))
    ]
    for ours, theirs in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4 * theirs.abs().max().item())


@needs_compiler
def test_rows_and_gradients_that_lie_otherwise_in_memory():
    unit = SeedGRU(generators(0), 4, 6, True)
    x = torch.randn(1, 9, 5, 4).transpose(1, 2).requires_grad_()
    memory = torch.zeros(1, 9, 6)
    steps = []
    for t in range(5):
        memory = unit(x[:, t], memory)
        steps.append(memory)
    grad = torch.randn(1, 6, 5, 9).permute(0, 2, 3, 1)
    assert_same_gradients(unit.unroll(x), torch.stack(steps, 1), grad, [x, *unit.parameters()], rtol=1e-4, atol=1e-5)


@needs_compiler
@pytest.mark.parametrize("rows", [50, 300])
def test_a_seed_alone_and_any_number_of_threads_give_the_same_bits(rows):
    torch.manual_seed(0)
    x, grad = torch.randn(3, 4, rows, 5), torch.randn(3, 4, rows, 8)
    parameters = [torch.randn(3, *size) * 0.3 for size in ((5, 24), (1, 24), (8, 24), (1, 24))]

    def found(seeds):
        run = CompiledUnroll(0, [x[seeds]], [p[seeds] for p in parameters], keep=True)
        by_parameters, by_x = run.backward_to(grad[seeds])
        return [run.outputs, *by_x, *by_parameters]

    assert_same_bits_alone_and_for_any_threads(found, 3)
