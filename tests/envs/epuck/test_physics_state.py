"""A world's future depends on its state alone: not on its past, its neighbours, or the number of threads."""

from functools import partial

import numpy as np
import pytest
import torch

from esp_envs.epuck.engines import ENGINES, make_physics
from esp_envs.epuck.physics import Physics
from esp_envs.epuck.robot import Arena, Array
from tests.envs.epuck.driving import PERIOD_S, at_posts, at_random, bodies, engine, gap_between_robots, to_the_middle

ARENA = Arena(1.0, 8, 2, 0.06)
WORLDS = 3

every_engine = pytest.mark.parametrize("name", ENGINES)


def made_of(rng: np.random.Generator) -> dict[str, Array]:
    return {name: rng.uniform(0.7, 1.4, (WORLDS, 8)) for name in ("mass", "friction")}


def heap(physics: Physics, steps: int) -> Array:
    """Drive to the middle; return all poses and velocities [steps, W, N, 6]."""
    record = []
    for _ in range(steps):
        physics.advance(to_the_middle(physics.pose))
        record.append(np.concatenate([physics.pose, physics.velocity], -1))
    return np.array(record)


@every_engine
@pytest.mark.parametrize("in_contact", [False, True])
def test_place_forgets_the_past(name: str, in_contact: bool) -> None:
    rng = np.random.default_rng(0)
    used = engine(name, ARENA, at_posts(ARENA, WORLDS, rng), **made_of(rng))
    heap(used, 35)
    assert gap_between_robots(used.pose) < 0, "there are contacts to forget"
    if in_contact:
        start = bodies(ARENA, used.pose, velocity=used.velocity)
    else:
        start = bodies(ARENA, at_posts(ARENA, WORLDS, rng), **made_of(rng))
    fresh = make_physics(name, ARENA, WORLDS, PERIOD_S)
    for physics in (fresh, used):
        physics.place(**start)
    np.testing.assert_array_equal(heap(used, 50), heap(fresh, 50))


@every_engine
@pytest.mark.parametrize("steps", [0, 35])
def test_a_restored_state_goes_on_bit_for_bit(name: str, steps: int) -> None:
    rng = np.random.default_rng(2)
    physics = engine(name, ARENA, at_posts(ARENA, WORLDS, rng), **made_of(rng))
    heap(physics, steps)
    state = physics.state_dict()
    want = heap(physics, 50)
    assert gap_between_robots(want[-1]) < 0
    physics.load_state_dict(state)
    np.testing.assert_array_equal(heap(physics, 50), want)
    other = engine(name, ARENA, at_posts(ARENA, WORLDS, rng), **made_of(rng))
    heap(other, 7)
    other.load_state_dict(state)
    for key, array in other.state_dict().items():
        np.testing.assert_array_equal(array, state[key], err_msg=key)
    np.testing.assert_array_equal(heap(other, 50), want)


@every_engine
def test_a_world_is_the_same_alone_and_among_others(name: str) -> None:
    rng = np.random.default_rng(3)
    pose, made = at_posts(ARENA, WORLDS, rng), made_of(rng)
    together = heap(engine(name, ARENA, pose, **made), 50)
    assert gap_between_robots(together[-1]) < 0
    for world in range(WORLDS):
        own = slice(world, world + 1)
        alone = heap(engine(name, ARENA, pose[own], **{key: value[own] for key, value in made.items()}), 50)
        np.testing.assert_array_equal(alone, together[:, own])


@every_engine
def test_the_number_of_threads_changes_nothing(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    start = bodies(ARENA, at_posts(ARENA, WORLDS, rng))
    records = []
    for threads in (1, 2):
        monkeypatch.setattr(torch, "get_num_threads", partial(int, threads))
        physics = make_physics(name, ARENA, WORLDS, PERIOD_S)
        physics.place(**start)
        records.append(heap(physics, 40))
    np.testing.assert_array_equal(*records)


@every_engine
def test_pillars_move_with_the_state(name: str) -> None:
    arena, rng = Arena(1.0, 1, 2, 0.06), np.random.default_rng(5)
    pose = np.array([[[0.0, 0.0, 0.0]]])
    physics = engine(name, arena, pose, pillars=np.array([[[0.2, 0.0], [-0.2, 0.0]]]))
    state = physics.state_dict()
    physics.place(**bodies(arena, pose))
    for _ in range(30):
        physics.advance(np.full((1, 1, 2), 6.28))
    assert physics.pose[0, 0, 0] > 0.3, "no pillar in the way"
    physics.load_state_dict(state)
    for _ in range(30):
        physics.advance(np.full((1, 1, 2), 6.28))
    assert 0.09 < physics.pose[0, 0, 0] < 0.11
    physics.advance(at_random((1, 1), rng))
    assert np.isfinite(physics.pose).all()
