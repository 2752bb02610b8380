"""The mixer never falls when an agent's value rises, and what makes it so is its absolute values."""

import pytest
import torch
from torch.nn.functional import elu

from esp_cli.networks import joint_q as mixing
from esp_cli.networks.joint_q import MonotonicMixer
from esp_cli.training.build import generators
from tests.networks.gradients import assert_same_gradients

SEEDS, AGENTS, STATE, WIDTH = (0, 1), 3, 5, 8


def mixer(seeds=SEEDS) -> MonotonicMixer:
    return MonotonicMixer(generators(seeds, "mixer"), AGENTS, STATE, WIDTH, 16)


def by_formula(mix, values, state, bound=torch.abs):
    """The team's value by torch's own operations: [S, B]."""
    first, bias, second, offset = mix.hypernetwork(state).split((AGENTS * WIDTH, WIDTH, WIDTH, 1), -1)
    hidden = elu((values.unsqueeze(-2) @ bound(first.unflatten(-1, (AGENTS, WIDTH)))).squeeze(-2) + bias)
    return (hidden * bound(second)).sum(-1) + offset.squeeze(-1)


def slopes(function) -> torch.Tensor:
    """Gradients of the team's value in each agent's, at random places: [S, B, N]."""
    g = torch.Generator().manual_seed(0)
    values = torch.randn(len(SEEDS), 200, AGENTS, generator=g, requires_grad=True)
    state = 3 * torch.randn(len(SEEDS), 200, STATE, generator=g)
    return torch.autograd.grad(function(values, state).sum(), values)[0]


def test_the_team_value_rises_with_every_agents_value():
    gradient = slopes(mixer())
    assert (gradient >= 0).all()
    assert (gradient > 0).float().mean() > 0.99


def test_without_absolute_values_it_would_not():
    mix = mixer()
    assert (slopes(lambda values, state: by_formula(mix, values, state, lambda x: x)) < 0).float().mean() > 0.1


@pytest.mark.parametrize("cached", [4096, 8])  # at once, and in pieces of four, four and two rows
def test_values_and_gradients_are_those_of_the_formula(cached, monkeypatch):
    monkeypatch.setattr(mixing, "CACHED_ROWS", cached)
    mix, weight = mixer(), torch.randn(2, 10)
    values, state = torch.randn(2, 10, AGENTS, requires_grad=True), torch.randn(2, 10, STATE, requires_grad=True)
    ours, theirs = mix(values, state), by_formula(mix, values, state)
    torch.testing.assert_close(ours, theirs)
    assert_same_gradients(ours, theirs, weight, [values, state, *mix.parameters()])


def test_a_seed_mixes_the_same_alone_and_among_others():
    values, state = torch.randn(2, 40, AGENTS), torch.randn(2, 40, STATE)
    torch.testing.assert_close(mixer()(values, state)[1:], mixer((1,))(values[1:], state[1:]))
