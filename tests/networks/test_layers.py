"""Seed-batched layers: right gradients, one seed independent of the others."""

import pytest
import torch

from esp_cli.networks import perceptron
from esp_cli.networks.build import NETWORKS, build_network
from esp_cli.networks.layers import SeedMLP, orthogonal
from esp_cli.networks.recurrent import SeedGRU
from tests.networks.gradients import assert_same_gradients
from tests.networks.kernels.compiler import needs_compiler


def generators(*seeds):
    return [torch.Generator().manual_seed(seed) for seed in seeds]


def reference(mlp, x):
    for k, layer in enumerate(mlp.layers):
        x = torch.baddbmm(layer.bias, x, layer.weight)
        if k < len(mlp.layers) - 1 or mlp.activate_output:
            x = torch.relu(x) if mlp.activation == "relu" else torch.tanh(x)
    return x


@pytest.mark.parametrize("activate_output", [False, True])
@pytest.mark.parametrize("outputs", [1, 5, 20])
def test_rows_go_through_in_pieces_as_they_do_at_once(activate_output, outputs, monkeypatch):
    mlp = SeedMLP(generators(0, 1), (7, 16, outputs), "tanh", 1.0, activate_output=activate_output)
    x = torch.randn(2, 11, 7, requires_grad=True)
    weight, inputs = torch.randn(2, 11, outputs), [x, *mlp.parameters()]
    whole = mlp(x)
    expected = torch.autograd.grad(whole, inputs, weight)
    monkeypatch.setattr(perceptron, "CACHED_ROWS", 8)  # pieces of four, four and three rows
    pieces = mlp(x)
    assert pieces.shape == whole.shape
    torch.testing.assert_close(pieces, whole)
    for ours, theirs in zip(torch.autograd.grad(pieces, inputs, weight), expected, strict=True):
        torch.testing.assert_close(ours, theirs)
    with torch.no_grad():
        torch.testing.assert_close(mlp(x), whole)


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
@pytest.mark.parametrize("rows_innermost", [False, True])
def test_parts_side_by_side_equal_whole_rows_and_get_gradients_where_they_ask(rows_innermost, compiled, monkeypatch):
    monkeypatch.setattr(perceptron, "CACHED_ROWS", 8)  # pieces of four, four and three rows
    mlp = SeedMLP(generators(0, 1), (7, 16, 20), "relu", 1.0, compiled=compiled)
    fixed, moving = torch.randn(2, 11, 5), torch.randn(2, 11, 2, requires_grad=True)
    ours, theirs = (mlp(fixed, moving, rows_innermost=rows_innermost), reference(mlp, torch.cat([fixed, moving], -1)))
    torch.testing.assert_close(ours, theirs)
    assert ours.transpose(1, 2).is_contiguous() == rows_innermost
    assert_same_gradients(ours, theirs, torch.randn(2, 11, 20), [moving, *mlp.parameters()])


def test_frozen_parameters_get_no_gradient_but_pass_one_on():
    mlp = SeedMLP(generators(0, 1), (7, 16, 1), "relu", 1.0).requires_grad_(False)
    x = torch.randn(2, 11, 7, requires_grad=True)
    ours, theirs = mlp(x), reference(mlp, x)
    assert_same_gradients(ours, theirs, torch.randn(2, 11, 1), [x])
    mlp(x).sum().backward()
    assert x.grad is not None
    assert all(p.grad is None for p in mlp.parameters())


def test_bfloat16_products_stay_near_float32_and_keep_float32_gradients():
    full = SeedMLP(generators(0, 1), (7, 64, 64, 5), "tanh", 1.0)
    half = SeedMLP(generators(0, 1), (7, 64, 64, 5), "tanh", 1.0, precision=torch.bfloat16)
    x = torch.randn(2, 50, 7)
    assert half(x).dtype == torch.float32
    assert (full(x) - half(x)).abs().max() < 0.1
    assert not torch.equal(full(x), half(x)), "negative control: the products really were rounded"
    half(x).sum().backward()
    assert all(p.grad.dtype == torch.float32 for p in half.parameters())


def test_weights_are_orthogonal_and_a_seed_draws_the_same_alone_and_among_others():
    weights = orthogonal(generators(3, 4), 10, 6, 2.0)
    identity = weights.transpose(1, 2) @ weights / 4.0
    torch.testing.assert_close(identity, torch.eye(6).expand(2, 6, 6), rtol=0, atol=1e-5)
    assert torch.equal(weights[1:], orthogonal(generators(4), 10, 6, 2.0))
    assert not torch.allclose(weights[0], weights[1])


@pytest.mark.parametrize("name", ["mlp", "gru"])
def test_a_seed_neither_sees_nor_moves_another(name):
    network = build_network(generators(0, 1), 6, 3, NETWORKS[name](hidden=(8,), layer_norm=True), 1.0)
    x = torch.randn(2, 4, 5, 6)
    before = network.unroll(x)
    x[1] += torch.randn(4, 5, 6)
    after = network.unroll(x)
    assert torch.equal(before[0], after[0])
    assert not torch.allclose(before[1], after[1])
    (gradient,) = torch.autograd.grad(after[0].sum(), [next(network.parameters())])
    assert gradient[1].abs().max() == 0


@pytest.mark.parametrize("name", ["mlp", "gru"])
@pytest.mark.parametrize("norm", [True, False])
def test_precision_changes_nothing_where_layers_are_normalised(name, norm):
    choices = [NETWORKS[name](hidden=(8,), layer_norm=norm, precision=p) for p in ("float32", "bfloat16")]
    x = torch.randn(2, 4, 5, 6)
    exact, rounded = (build_network(generators(0, 1), 6, 3, config, 1.0).unroll(x) for config in choices)
    assert torch.equal(exact, rounded) is norm
    assert all(config.without_effect() == ({"precision", "compiled"} if norm else set()) for config in choices)


def test_gru_by_hand():
    gru = SeedGRU(generators(0), 1, 1)
    with torch.no_grad():
        for parameter in gru.parameters():
            parameter.zero_()
        gru.input.weight[..., 2] = 1.0  # candidate = tanh(x); both gates stay sigmoid(0) = 1/2
    h = gru(torch.tensor([[[0.5]]]), torch.tensor([[[0.8]]]))
    assert h.item() == pytest.approx(0.5 * torch.tanh(torch.tensor(0.5)).item() + 0.5 * 0.8)


@pytest.mark.parametrize("name", ["mlp", "gru"])
def test_unrolling_an_episode_equals_stepping_through_it(name):
    network = build_network(generators(0, 1), 6, 3, NETWORKS[name](hidden=(8, 8)), 1.0)
    x = torch.randn(2, 4, 5, 6)
    memory = network.initial_memory(2, 4, x)
    steps = []
    for t in range(5):
        y, memory = network.step(x[:, :, t], memory)
        steps.append(y)
    torch.testing.assert_close(network.unroll(x), torch.stack(steps, 2))


@pytest.mark.parametrize(("name", "norm"), [("mlp", False), ("mlp", True), ("gru", False)])
def test_the_vjp_is_that_of_autograd(name, norm):
    network = build_network(generators(0, 1), 6, 3, NETWORKS[name](hidden=(8, 8), layer_norm=norm), 1.0)
    x, gradient = torch.randn(2, 2, 3, 5, 6), torch.randn(2, 2, 3, 5, 3)  # episodes of five agents
    given = network.with_vjp(x, gradient.shape)
    outputs, expected = given.tensor, network.unroll_agents(x)
    torch.testing.assert_close(outputs, expected.detach())
    assert not outputs.requires_grad
    found, parameters = given.vjp(gradient), list(network.parameters())
    for ours, theirs in zip(found, torch.autograd.grad(expected, parameters, gradient), strict=True):
        torch.testing.assert_close(ours, theirs)
    assert all(ours.abs().max() > 0 for ours in found), "negative control: no gradient is empty"


def test_truncation_cuts_gradients_but_not_values():
    network = build_network(generators(0), 2, 1, NETWORKS["gru"](hidden=(4,)), 1.0)
    x = torch.randn(1, 1, 6, 2, requires_grad=True)
    full, cut = network.unroll(x), network.unroll(x, truncation=3)
    torch.testing.assert_close(full, cut)
    (whole,) = torch.autograd.grad(full[:, :, 5].sum(), [x])
    (part,) = torch.autograd.grad(cut[:, :, 5].sum(), [x])
    assert whole[:, :, :3].abs().max() > 0
    assert part[:, :, :3].abs().max() == 0
    assert part[:, :, 3:].abs().min() > 0


@pytest.mark.parametrize("truncation", [0, 3])
def test_the_hand_written_unrolling_equals_autograd_through_single_steps(truncation):
    gru = SeedGRU(generators(0, 1), 5, 6).double()
    x = torch.randn(2, 7, 4, 5, dtype=torch.float64, requires_grad=True)  # seven steps, four episodes
    memory, history = torch.zeros(2, 4, 6, dtype=torch.float64), []
    for t in range(7):
        if truncation and t % truncation == 0:
            memory = memory.detach()
        memory = gru(x[:, t], memory)
        history.append(memory)
    reference, ours = torch.stack(history, 1), gru.unroll(x, truncation)
    torch.testing.assert_close(ours, reference)
    with torch.no_grad():
        assert torch.equal(gru.unroll(x, truncation), ours)
    weight = torch.randn_like(reference)
    inputs = [x, *gru.parameters()]
    assert_same_gradients(ours, reference, weight, inputs, rtol=None, atol=None)
