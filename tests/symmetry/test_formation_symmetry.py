"""Eq. 5 and 6 in formation change, with robots and pillars in each other's way, in every physics.

The worlds start from a jam around the middle, which robots that drive straight at their goals have made.
"""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from esp_cli.symmetry import (
    Transform,
    build_transform,
    carried_groups,
    dihedral,
    mirror,
    parse_elements,
    rotation,
    transform_set,
)
from esp_cli.symmetry.maps import Dense
from esp_envs import Environment, make
from esp_envs.epuck.engines import ENGINES
from tests.symmetry.checks import environment_errors

WORLDS = 6
D4 = dihedral(4).elements[1:]
STEPS = {"mujoco": 100, "mujoco-3d": 15, "pymunk": 100}
BOUND = {"mujoco": 1e-6, "mujoco-3d": 1e-5, "pymunk": 1e-6}
"""What comes out is float32: metres, m/s, rad/s and rewards; measured: 1.4e-14, 6.8e-10 and 1.2e-14."""


def jam(num_seeds: int, **settings: object) -> tuple[Environment, Tensor, list[Tensor]]:
    """Return worlds, the state [S, E, width] of a jam, and actions that keep pushing into it."""
    env = make("formation", WORLDS, range(num_seeds), {"horizon": 200, **settings})
    env.reset()
    for _ in range(70):
        state = env.step(env.heuristic("straight")).next.state
    env.set_state(state)
    actions, collisions = [], 0.0
    for _ in range(STEPS[str(env.spec.settings["physics"])]):
        actions.append(env.heuristic("straight"))
        collisions += env.step(actions[-1]).metrics["collisions"].sum().item()
    assert collisions > 10 * num_seeds, "without contacts the checks below would say little"
    return env, state, actions


@pytest.mark.parametrize("physics", ENGINES)
@pytest.mark.parametrize(
    "settings", [{}, {"actions": "discrete", "num_obstacles": 0, "sight": "nearness", "neighbours": 3}], ids=str
)
def test_quarter_turns_and_mirrors_leave_reward_and_transition_alone(physics: str, settings: dict[str, object]) -> None:
    env, state, actions = jam(len(D4), physics=physics, **settings)
    errors = environment_errors(env, build_transform(D4, env.spec), state, actions)
    assert max(errors.values()) < BOUND[physics], errors


def test_robots_can_change_places() -> None:
    env, state, actions = jam(1)
    errors = environment_errors(
        env, build_transform(parse_elements("agents-1-0-2-3-4-5-7-6", 8), env.spec), state, actions[:5]
    )
    # Contacts are solved in another order, to the solver's tolerance.
    assert max(errors.values()) < 1e-2, errors


def with_wheels_unswapped(env: Environment) -> Transform:
    right = build_transform([mirror(0)], env.spec)
    assert isinstance(right.output_map, Dense)
    return replace(right, output_map=Dense(torch.eye(2).expand_as(right.output_map.matrix)))


def test_a_mirror_that_leaves_the_wheels_alone_is_noticed() -> None:
    env, state, actions = jam(1)
    errors = environment_errors(env, with_wheels_unswapped(env), state, actions)
    assert errors["observation"] < 1e-6
    assert errors["next_state"] > 0.1
    assert errors["reward"] > 0.1


def test_the_walls_break_an_eighth_turn() -> None:
    env = make("formation", WORLDS, [0])
    assert carried_groups(env.spec) == ("c2", "d2", "c4", "d4", "agents")
    with pytest.raises(ValueError, match="rot45 is no symmetry of its dynamics and reward, which carry d4"):
        transform_set("rot45", env.spec)
    state = env.reset().state
    errors = environment_errors(env, build_transform([rotation(45)], env.spec), state, [env.random_action()])
    assert errors["next_state"] > 0.1
