"""The compiled perceptron does what torch's operations do, for each seed by itself, and says when it cannot."""

import math

import pytest
import torch

from esp_cli.networks.kernels.perceptron import CompiledPass
from esp_cli.networks.layers import SeedMLP
from tests.networks.gradients import assert_same_gradients
from tests.networks.kernels.compiler import assert_same_bits_alone_and_for_any_threads, needs_compiler
from tests.networks.test_layers import generators, reference


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
@pytest.mark.parametrize("activation", ["relu", "tanh"])
@pytest.mark.parametrize("activate_output", [False, True])
@pytest.mark.parametrize("sizes", [(14, 64, 64, 5), (43, 64, 161), (7, 30, 17, 1), (3, 1), (5, 150, 40, 3)])
@pytest.mark.parametrize("rows", [1, 300, 1100])
def test_outputs_and_gradients_equal_those_of_autograd(activation, activate_output, sizes, rows, compiled):
    mlp = SeedMLP(generators(0, 1, 2), sizes, activation, 1.0, activate_output=activate_output, compiled=compiled)
    x, weight = torch.randn(3, rows, sizes[0], requires_grad=True), torch.randn(3, rows, sizes[-1])
    ours, theirs = mlp(x), reference(mlp, x)
    assert type(ours.grad_fn.next_functions[0][0]).__name__ == "_PassedBackward"
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5)
    assert_same_gradients(ours, theirs, weight, [x, *mlp.parameters()], rtol=1e-4, atol=1e-4)
    with torch.no_grad():
        torch.testing.assert_close(mlp(x), ours, rtol=0, atol=0)


@needs_compiler
def test_a_pass_by_hand():
    """y = 3 tanh(2 x1 - x2 + 0.5) + 1 at x = (1, 2): tanh(0.5) = 0.46212; slope 1 - 0.46212^2 = 0.78645."""
    x = torch.tensor([[[1.0, 2.0]]])
    parameters = [
        torch.tensor([[[2.0], [-1.0]]]),
        torch.tensor([[[0.5]]]),
        torch.tensor([[[3.0]]]),
        torch.ones(1, 1, 1),
    ]
    run = CompiledPass([x], parameters, "tanh", False)
    assert run.outputs.item() == pytest.approx(3 * 0.46212 + 1, abs=1e-4)
    grads, (below,) = run.backward_to(torch.full((1, 1, 1), 10.0), [True] * 4, [True])
    first, bias, second, offset = (g.flatten().tolist() for g in grads)
    assert second == pytest.approx([4.6212], abs=1e-3)
    assert offset == [10.0]
    assert bias == pytest.approx([30 * 0.78645], abs=1e-3)
    assert first == pytest.approx([30 * 0.78645, 60 * 0.78645], abs=1e-3)
    assert below.flatten().tolist() == pytest.approx([60 * 0.78645, -30 * 0.78645], abs=1e-3)


@needs_compiler
def test_tanh_is_right_from_end_to_end():
    x = torch.cat([torch.linspace(-50, 50, 5001), torch.tensor([math.inf, -math.inf, math.nan, 0.0, 1e-30])])
    one, none = torch.ones(1, 1, 1), torch.zeros(1, 1, 1)
    y = CompiledPass([x.view(1, -1, 1)], [one, none], "tanh", True).outputs.flatten()
    torch.testing.assert_close(y, torch.tanh(x.double()).float(), rtol=0, atol=3e-7, equal_nan=True)


@needs_compiler
@pytest.mark.parametrize("rows", [50, 1100])
def test_a_seed_alone_and_any_number_of_threads_give_the_same_bits(rows):
    torch.manual_seed(0)
    parameters = [torch.randn(3, *size) for size in ((9, 40), (1, 40), (40, 5), (1, 5))]
    x, grad = torch.randn(3, rows, 9), torch.randn(3, rows, 5)

    def passed(seeds):
        run = CompiledPass([x[seeds]], [p[seeds] for p in parameters], "tanh", False)
        return [run.outputs, *run.backward(grad[seeds])]

    assert_same_bits_alone_and_for_any_threads(passed, 3)


@needs_compiler
@pytest.mark.parametrize("axes", [(2, 3, 1, 0, 4), (4, 1, 2, 3, 0), (0, 3, 2, 1, 4)])
def test_parts_may_lie_anyhow_in_memory(axes):
    mlp = SeedMLP(generators(0, 1), (9, 16, 3), "tanh", 1.0, compiled=True)
    places = [axes.index(k) for k in range(5)]
    size = (2, 6, 5, 7, 4)  # seeds, three axes of rows, columns
    moved = torch.randn([size[k] for k in axes]).permute(places)
    shared = torch.randn(7, 1).expand(2, 6, 5, 7, 1)  # the same numbers for all seeds
    cut = torch.randn(2, 6, 5, 9, 4)[:, :, :, 1:8]
    assert moved.shape == size
    parts = [cut, moved.requires_grad_(), shared]
    ours, theirs = mlp(*parts).flatten(1, -2), reference(mlp, torch.cat(parts, -1).flatten(1, 3))
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5)
    wanted = [moved, *mlp.parameters()]
    assert_same_gradients(ours, theirs, torch.randn(2, 210, 3), wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
def test_a_change_of_inputs_before_the_backward_is_noticed(compiled):
    mlp = SeedMLP(generators(0), (5, 16, 3), "tanh", 1.0, compiled=compiled)
    x, more = torch.randn(1, 7, 4), torch.randn(1, 7, 1)
    y = mlp(x, more)
    x.zero_()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        y.sum().backward()


@needs_compiler
@pytest.mark.parametrize(
    "parts",
    [
        [torch.zeros(1, 7, 4)],
        [torch.zeros(1, 7, 3), torch.zeros(1, 6, 2)],
        [torch.zeros(2, 7, 5)],
        [torch.zeros(1, 7, 5, dtype=torch.float64)],
    ],
)
def test_inputs_of_other_shapes_or_numbers_are_refused(parts):
    """The kernel would read foreign memory."""
    mlp = SeedMLP(generators(0), (5, 16, 3), "tanh", 1.0, compiled=True)
    with pytest.raises(ValueError, match=r"a perceptron for float32 rows \[1, ..., 5\] got"):
        mlp(*parts)


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
@pytest.mark.parametrize("frozen", [0, 1, 2, 3])
def test_a_frozen_parameter_leaves_the_others_their_gradients(frozen, compiled):
    mlp = SeedMLP(generators(0, 1), (5, 16, 3), "tanh", 1.0, compiled=compiled)
    list(mlp.parameters())[frozen].requires_grad_(False)
    x = torch.randn(2, 7, 5)
    learning = [p for p in mlp.parameters() if p.requires_grad]
    assert_same_gradients(mlp(x), reference(mlp, x), torch.randn(2, 7, 3), learning, rtol=1e-4, atol=1e-4)


@needs_compiler
def test_rows_along_more_axes_than_the_kernel_counts_are_copied():
    mlp = SeedMLP(generators(0), (2, 16, 3), "relu", 1.0, compiled=True)
    x = torch.randn(2, 3, 4, 5, 2, 1).permute(5, 3, 0, 2, 1, 4)
    torch.testing.assert_close(mlp(x).flatten(1, -2), reference(mlp, x.flatten(1, -2)), rtol=1e-5, atol=1e-5)
    assert mlp(x[:, :, :0]).shape == (1, *x[:, :, :0].shape[1:-1], 3)
    torch.testing.assert_close(mlp(x, x[..., :0]), mlp(x), rtol=0, atol=0)  # a part of no numbers


@needs_compiler
def test_parameters_that_are_no_rows_and_no_rows_at_all():
    weight = torch.randn(2, 20, 5).transpose(1, 2)
    x, bias = torch.randn(2, 30, 5), torch.randn(2, 1, 20)
    run = CompiledPass([x], [weight, bias], "relu", True)
    torch.testing.assert_close(run.outputs, torch.relu(x @ weight + bias))
    empty = CompiledPass([x[:, :0]], [weight, bias], "tanh", False)
    assert empty.outputs.shape == (2, 0, 20)
    (found,) = empty.backward(torch.zeros(2, 0, 20))
    assert found.shape == (2, 6 * 20)
    assert not found.any()
