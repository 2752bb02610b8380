"""The network check passes what was made equivariant and fails what was not."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from esp_cli.symmetry import transform_set
from tests.symmetry.checks import network_equivariance_error
from tests.symmetry.toy_actions import EVERYTHING

SEEDS, WORLDS, HIDDEN = 2, 5, 16


def random_mlp(width: int, outputs: int):
    """Return a plain seed-batched network [S, ..., width] to [S, ..., outputs] in float64."""
    g = torch.Generator().manual_seed(0)
    first = torch.randn(SEEDS, width, HIDDEN, generator=g, dtype=torch.float64)
    second = torch.randn(SEEDS, HIDDEN, outputs, generator=g, dtype=torch.float64) / HIDDEN

    def network(x: Tensor) -> Tensor:
        hidden = torch.tanh(x.reshape(SEEDS, -1, width) @ first)
        return (hidden @ second).reshape(*x.shape[:-1], outputs)

    return network


def symmetrised(network, transforms, push, pull):
    """Average pull(network(push(x))) over a group: equivariant by construction."""

    def average(x: Tensor) -> Tensor:
        total = network(x)
        for t in transforms:
            total = total + pull(t)(network(push(t)(x)))
        return total / (len(transforms) + 1)

    return average


@pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])
@pytest.mark.parametrize("text", ["c4", "d4", "d4*agents"])
def test_a_plain_network_fails_and_a_symmetrised_one_passes(make_spec, generators, text, continuous) -> None:
    spec = make_spec(action=EVERYTHING) if continuous else make_spec()
    outputs = EVERYTHING.width if continuous else 5
    g = torch.Generator().manual_seed(1)
    obs = torch.randn(SEEDS, WORLDS, 3, spec.observation.width, generator=g, dtype=torch.float64)
    state = torch.randn(SEEDS, WORLDS, spec.state.width, generator=g, dtype=torch.float64)
    policy, value = random_mlp(spec.observation.width, outputs), random_mlp(spec.state.width, 3)
    transforms = transform_set(text, spec)
    drawn = transforms.draw(generators[:SEEDS])
    plain = network_equivariance_error(policy, value, obs, state, drawn)
    assert min(plain.values()) > 1e-2

    even_policy = symmetrised(policy, transforms.each(), lambda t: t.obs, lambda t: t.pull_back)
    even_value = symmetrised(value, transforms.each(), lambda t: t.state, lambda t: t.values)
    even = network_equivariance_error(even_policy, even_value, obs, state, drawn)
    assert max(even.values()) < 1e-12
