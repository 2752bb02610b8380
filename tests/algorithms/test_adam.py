"""One buffer for the parameters of all seeds: views, clipping and Adam's steps against torch's own."""

import math

import pytest
import torch
from torch import nn

from esp_cli.algorithms.adam import SeedAdam, SeedParameters, clip_per_seed

SHAPES = ((2, 3, 4), (2, 1, 4), (2, 5))


def parameters(seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [nn.Parameter(torch.randn(shape, generator=generator)) for shape in SHAPES]


def adam(ours, max_grad_norm=1e9):
    return SeedAdam(ours[:2], ours[2:], learning_rate=0.01, epsilon=1e-5, max_grad_norm=max_grad_norm)


def losses(tensors, target):
    return sum((t - target).square().flatten(1).sum(1) * (k + 1) for k, t in enumerate(tensors))


def test_parameters_are_views_of_one_buffer_and_keep_their_numbers():
    ours, before = parameters(), parameters()
    flat = SeedParameters(ours)
    assert all(torch.equal(a, b) for a, b in zip(ours, before, strict=True))
    assert flat.buffer.shape == (2, 32), "12 + 4 + 5 numbers, filled up to two vectors of 16"
    flat.buffer[1] = 7.0
    assert all((p[1] == 7).all() and torch.equal(p[0], b[0]) for p, b in zip(ours, before, strict=True))
    assert torch.equal(flat.flat(ours), torch.cat([flat.buffer[:, :21], torch.zeros(2, 11)], 1))


@pytest.mark.parametrize("steps", [1, 20])
def test_its_steps_are_those_of_torch(steps):
    ours, theirs = parameters(), parameters()
    optimiser, reference = adam(ours), torch.optim.Adam(theirs, 0.01, eps=1e-5)
    for k in range(steps):
        optimiser.step(losses(ours, k))
        reference.zero_grad()
        losses(theirs, k).sum().backward()
        reference.step()
    for a, b, start in zip(ours, theirs, parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-7)
        assert (a - start).abs().min() > 0.005 * min(steps, 2), "negative control: they moved"


def test_the_first_step_by_hand():
    weight = nn.Parameter(torch.tensor([[1.0], [1.0]]))
    optimiser = SeedAdam([weight], learning_rate=0.1, epsilon=1.0, max_grad_norm=1e9)
    optimiser.anneal(0.5)
    optimiser.step((weight * torch.tensor([[3.0], [-1.0]])).sum(1))
    # m / (1 - b1) = g and v / (1 - b2) = g^2, so p - 0.05 g / (|g| + 1)
    torch.testing.assert_close(weight.detach(), torch.tensor([[1 - 0.05 * 3 / 4], [1 + 0.05 * 1 / 2]]))


def test_a_parameter_without_a_gradient_stays():
    ours = parameters()
    optimiser = adam(ours)
    optimiser.step(losses(ours[:2], 0.0))
    assert torch.equal(ours[2], parameters()[2])
    assert not torch.equal(ours[0], parameters()[0])


def test_groups_are_clipped_apart():
    ours = parameters()
    optimiser = adam(ours, max_grad_norm=2.0)
    gradient = torch.ones(2, 32)
    first, second = optimiser.apply(gradient)
    torch.testing.assert_close(first, torch.full((2,), 4.0))  # the root of 12 + 4
    torch.testing.assert_close(second, torch.full((2,), math.sqrt(5)))
    torch.testing.assert_close(gradient[:, :16], torch.full((2, 16), 0.5))
    torch.testing.assert_close(gradient[:, 16:21], torch.full((2, 5), 2 / math.sqrt(5)))


def test_gradients_are_clipped_by_the_norm_of_their_own_seed():
    # seed 0 has norm 5, seed 1 has 0.5
    gradient = torch.tensor([[3.0, 4.0], [0.3, 0.4]])
    torch.testing.assert_close(clip_per_seed([gradient], 1.0), [torch.tensor([5.0, 0.5])])
    torch.testing.assert_close(gradient, torch.tensor([[0.6, 0.8], [0.3, 0.4]]), atol=1e-5, rtol=0)


def test_a_broken_seed_does_not_spoil_the_others_gradients():
    gradient = torch.tensor([[3.0, 4.0], [math.nan, 1.0]])
    clip_per_seed([gradient], 1.0)
    torch.testing.assert_close(gradient[0], torch.tensor([0.6, 0.8]), atol=1e-5, rtol=0)
    assert gradient[1].isnan().all()


def test_its_state_is_that_of_torch_and_comes_back():
    ours, theirs = parameters(), parameters()
    optimiser, reference = adam(ours), torch.optim.Adam(theirs, 0.01, eps=1e-5)
    assert optimiser.state_dict() == {}
    for _ in range(3):
        optimiser.step(losses(ours, 0.0))
        reference.zero_grad()
        losses(theirs, 0.0).sum().backward()
        reference.step()
    state = {name: tensor.clone() for name, tensor in optimiser.state_dict().items()}
    expected = reference.state_dict()["state"]
    assert state.keys() == {f"{k}.{name}" for k in range(3) for name in ("step", "exp_avg", "exp_avg_sq")}
    for name, tensor in state.items():
        index, _, key = name.partition(".")
        torch.testing.assert_close(tensor, expected[int(index)][key])
    other = adam(parameters(1))
    other.load_state_dict(state)
    assert all(torch.equal(tensor, state[name]) for name, tensor in other.state_dict().items())
    other.load_state_dict({})
    assert other.state_dict() == {}


@pytest.mark.parametrize(
    ("change", "number"),
    [({"1.exp_avg": torch.zeros(2, 4)}, 1), ({"3.step": torch.zeros(())}, 3), ({"0.step": None}, 0)],
)
def test_moments_of_other_parameters_are_refused(change, number):
    ours = parameters()
    optimiser = adam(ours)
    optimiser.step(losses(ours, 0.0))
    state = {name: t for name, t in {**optimiser.state_dict(), **change}.items() if t is not None}
    with pytest.raises(KeyError, match=f"the moments of parameter {number}"):
        optimiser.load_state_dict(state)
