"""Robots, walls and pillars stop each other, and nobody gains energy by it."""

import numpy as np
import pytest

from esp_envs.epuck.engines import ENGINES
from esp_envs.epuck.robot import BODY_RADIUS_M, MASS_KG, MAX_SPEED_M_S, MAX_WHEEL_SPEED, Arena, Array
from tests.envs.epuck.driving import (
    PERIOD_S,
    at_posts,
    at_random,
    engine,
    gap_between_robots,
    gap_to_pillars,
    gap_to_walls,
    to_the_middle,
)

DEEPEST_M = 3e-3
"""No two things ever overlap by more."""

every_engine = pytest.mark.parametrize("name", ENGINES)


def full_ahead(robots: int) -> Array:
    return np.full((1, robots, 2), MAX_WHEEL_SPEED)


def contest(name: str, **others: Array) -> float:
    """Let two robots drive into each other; return how far the second is pushed beyond the middle, m."""
    start = BODY_RADIUS_M + 0.05
    pose = np.array([[[-start, 0.0, 0.0], [start, 0.0, np.pi]]])
    physics = engine(name, Arena(2.0, 2, 0, 0.1), pose, **others)
    for _ in range(20):
        physics.advance(full_ahead(2))
    return float(physics.pose[0, 1, 0] - BODY_RADIUS_M)


@every_engine
def test_two_robots_head_on_stop_each_other(name: str) -> None:
    pose = np.array([[[-0.3, 0.0, 0.0], [0.3, 0.0, np.pi]]])
    physics = engine(name, Arena(2.0, 2, 0, 0.1), pose)
    gaps = []
    for _ in range(60):
        physics.advance(full_ahead(2))
        gaps.append(gap_between_robots(physics.pose))
    assert -DEEPEST_M < min(gaps) < 1e-3
    # they meet in the middle and stay: neither bounces, wins nor slides past
    np.testing.assert_allclose(physics.pose[0, :, 0], [-BODY_RADIUS_M, BODY_RADIUS_M], atol=DEEPEST_M)
    np.testing.assert_allclose(physics.pose[0, :, 1], 0.0, atol=1e-9)
    assert np.abs(physics.velocity[..., :2]).max() < 0.02 * MAX_SPEED_M_S


@every_engine
@pytest.mark.parametrize("quarter", range(4))
def test_a_wall_stops_a_robot(name: str, quarter: int) -> None:
    heading = quarter * np.pi / 2
    towards = np.round([np.cos(heading), np.sin(heading)])
    physics = engine(name, Arena(2.0, 1, 0, 0.1), np.array([[[*(0.7 * towards), heading]]]))
    for _ in range(40):
        physics.advance(full_ahead(1))
        assert gap_to_walls(physics.pose, 2.0) > -DEEPEST_M
    np.testing.assert_allclose(physics.pose[0, 0, :2], (1 - BODY_RADIUS_M) * towards, atol=DEEPEST_M)


@every_engine
def test_a_pillar_stops_a_robot_where_it_was_placed(name: str) -> None:
    pillars = np.array([[[0.5, 0.1], [-0.5, 0.5]]])
    physics = engine(name, Arena(2.0, 1, 2, 0.1), np.array([[[0.0, 0.1, 0.0]]]), pillars=pillars)
    for _ in range(60):
        physics.advance(full_ahead(1))
        assert gap_to_pillars(physics.pose, pillars, 0.1) > -DEEPEST_M
    np.testing.assert_allclose(physics.pose[0, 0, :2], [0.5 - 0.1 - BODY_RADIUS_M, 0.1], atol=DEEPEST_M)


@every_engine
def test_eight_robots_in_one_heap_keep_their_bodies_to_themselves_and_gain_no_energy(name: str) -> None:
    rng = np.random.default_rng(0)
    arena = Arena(2.0, 8, 0, 0.1)
    physics = engine(name, arena, at_posts(arena, 6, rng))
    gaps, energies = [], []
    for _ in range(140):
        physics.advance(to_the_middle(physics.pose))
        gaps.append(gap_between_robots(physics.pose))
        energies.append(MASS_KG / 2 * (physics.velocity[..., :2] ** 2).sum((1, 2)).max())
    assert -DEEPEST_M < min(gaps) < 0
    assert max(energies) < 1.02 * 8 * MASS_KG * MAX_SPEED_M_S**2 / 2
    # a heap indeed: seven bodies round one reach 2 x 37 mm from the middle, and the eighth finds no better place
    assert np.linalg.norm(physics.pose[..., :2], axis=-1).max() < 4 * BODY_RADIUS_M
    for _ in range(10):
        physics.advance(np.zeros((6, 8, 2)))
    assert np.abs(physics.velocity[..., :2]).max() < 0.03 * MAX_SPEED_M_S


@every_engine
def test_nobody_leaves_or_passes_through_anything_in_300_random_steps(name: str) -> None:
    arena, rng = Arena(0.8, 8, 2, 0.03), np.random.default_rng(1)
    physics = engine(name, arena, at_posts(arena, 4, rng))
    pillars = np.tile(arena.pillars(), (4, 1, 1))
    gaps, energy = [], []
    for step in range(300):
        if step % 10 == 0:
            wheels = at_random((4, 8), rng)
        before = physics.pose
        physics.advance(wheels)
        pose = physics.pose
        gaps.append((gap_between_robots(pose), gap_to_pillars(pose, pillars, 0.03), gap_to_walls(pose, 0.8)))
        moved = np.linalg.norm((pose - before)[..., :2], axis=-1)
        energy.append((moved**2).sum(-1).max())
        assert np.isfinite(pose).all()
        assert np.isfinite(physics.velocity).all()
    assert np.min(gaps) > -DEEPEST_M
    assert (np.min(gaps, axis=0) < 1e-4).all(), "robots, pillars and walls were all touched"
    # nobody is thrown: together they never move faster than eight robots at full speed
    assert max(energy) < 8 * (MAX_SPEED_M_S * PERIOD_S) ** 2


@every_engine
def test_the_heavier_robot_pushes_the_other_away(name: str) -> None:
    assert abs(contest(name)) < 2e-3
    assert contest(name, mass=np.array([[2.0, 1.0]])) > 0.01
    assert contest(name, mass=np.array([[1.0, 2.0]])) < -0.01


@every_engine
def test_the_slippery_robot_is_pushed_away(name: str) -> None:
    assert contest(name, friction=np.array([[1.0, 0.05]])) > 0.01
