"""A turned or mirrored world stays the turned or mirrored world, through a hundred control steps full of contacts.

Rounding differs between the worlds, contacts magnify it, and robots that push each other in a heap magnify it most.
"""

import numpy as np
import pytest

from esp_envs.epuck.engines import ENGINES
from esp_envs.epuck.robot import Arena, Array
from tests.envs.epuck.driving import (
    at_posts,
    at_random,
    engine,
    gap_between_robots,
    gap_to_pillars,
    gap_to_walls,
    to_the_middle,
)

ARENA = Arena(1.0, 8, 2, 0.06)
ELEMENTS = [(quarters, mirrored) for mirrored in (False, True) for quarters in range(4)]
"""Of D4: mirror about the x axis or not, then turn by quarters."""
STEPS = 100
WORST_M = {"mujoco": 1e-9, "mujoco-3d": 1e-8, "pymunk": 1e-7}
"""In a heap; the worst of six seeds were 1e-11, 5e-12 and 1e-9."""
WORST_LOOSE_M = {"mujoco": 1e-10, "mujoco-3d": 1e-10, "pymunk": 1e-10}
"""In a crowd that jostles; the worst of six seeds were 2e-13, 2e-14 and 2e-12."""

every_engine = pytest.mark.parametrize("name", ENGINES)


def moved(points: Array, quarters: int, mirrored: bool) -> Array:
    """Mirror and turn points [..., 2 or 3], where the third number is a heading; positions without rounding."""
    points = points.copy()
    if mirrored:
        points[..., 1:] *= -1
    for _ in range(quarters):
        points[..., 0], points[..., 1] = -points[..., 1], points[..., 0].copy()
    points[..., 2:] += quarters * np.pi / 2
    return points


def play(name: str, seed: int, noise: float, swap: bool = True) -> tuple[Array, float, float]:
    """Run a world beside its seven images for a hundred steps.

    Returns:
        The largest error of position (m) and heading (rad) of each image [8, 2], and the least gap between robots and
        between a robot and a pillar or wall, m.
    """
    rng = np.random.default_rng(seed)
    pose = at_posts(ARENA, 1, rng)[0]
    pillars = ARENA.pillars() + rng.uniform(-0.05, 0.05, (2, 2))
    images = np.stack([moved(pillars, *element) for element in ELEMENTS])
    physics = engine(name, ARENA, np.stack([moved(pose, *element) for element in ELEMENTS]), pillars=images)
    worst, robots, others = np.zeros((8, 2)), np.inf, np.inf
    for _ in range(STEPS):
        first = physics.pose[:1]
        wheels = ((1 - noise) * to_the_middle(first) + noise * at_random((1, 8), rng))[0]
        physics.advance(np.stack([wheels[:, ::-1] if mirrored and swap else wheels for _, mirrored in ELEMENTS]))
        after = physics.pose
        error = after - np.stack([moved(after[0], *element) for element in ELEMENTS])
        turn = np.abs(np.arctan2(np.sin(error[..., 2]), np.cos(error[..., 2])))
        worst = np.maximum(worst, np.stack([np.abs(error[..., :2]).max((1, 2)), turn.max(1)], -1))
        robots = min(robots, gap_between_robots(after))
        others = min(others, gap_to_pillars(after, images, 0.06), gap_to_walls(after, ARENA.side_m))
    return worst, robots, others


@every_engine
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(("noise", "most_m"), [(0.0, WORST_M), (0.3, WORST_LOOSE_M)], ids=["heap", "crowd"])
def test_turned_and_mirrored_worlds_stay_alike(name: str, seed: int, noise: float, most_m: dict[str, float]) -> None:
    worst, robots, others = play(name, seed, noise)
    assert robots < 1e-3, "robots touched"
    assert noise or others < 1e-3, "something else, too"
    assert worst[:, 0].max() < most_m[name]
    assert worst[:, 1].max() < 100 * most_m[name]


@every_engine
def test_a_mirror_that_does_not_swap_the_wheels_is_no_symmetry(name: str) -> None:
    worst, _, _ = play(name, seed=0, noise=0.3, swap=False)
    assert worst[4:, 0].min() > 0.01
    assert worst[:4, 0].max() < WORST_LOOSE_M[name], "turns swap nothing"
