"""Policies whose agents exchange messages: a loaded one takes whole worlds, and no export takes one."""

import numpy as np
import pytest

from esp_cli.export.program import program_of
from esp_cli.policies.loaded import LoadedPolicy
from tests.export.policies import drawn_policy

WIDTH = 445
"""Of an observation of wildlife monitoring: 21 x 21 pixels, and the way to two others."""


@pytest.mark.parametrize("lead", [(3,), (2, 3), (0, 3)])
def test_a_loaded_team_acts_world_by_world(lead: tuple[int, ...]) -> None:
    policy = LoadedPolicy(drawn_policy("team"))
    obs = np.random.default_rng(0).standard_normal((*lead, WIDTH))
    action = policy.act(obs)
    assert action.shape == lead
    if lead == (2, 3):
        assert np.array_equal(action, [policy.act(world) for world in obs])


@pytest.mark.parametrize("shape", [(WIDTH,), (2, WIDTH), (3, 2, WIDTH), (6, WIDTH)])
def test_a_loaded_team_refuses_rows_that_are_no_world(shape: tuple[int, ...]) -> None:
    with pytest.raises(
        ValueError, match=r"exchange messages: give \(\.\.\., 3, 445\), one row for each agent of a world"
    ):
        LoadedPolicy(drawn_policy("team")).act(np.zeros(shape))


@pytest.mark.parametrize("kind", ["team", "team, values, equivariant"])
def test_no_export_takes_a_team(kind: str) -> None:
    with pytest.raises(ValueError, match=r"of the kind MessagePassing cannot be exported; mlp, gru, set and"):
        program_of(drawn_policy(kind).policy)
