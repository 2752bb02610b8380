"""Put robots into worlds, drive them into each other, and measure how near they come."""

import numpy as np

from esp_envs.epuck.engines import make_physics
from esp_envs.epuck.physics import Physics
from esp_envs.epuck.robot import BODY_RADIUS_M, MAX_WHEEL_SPEED, Arena, Array

PERIOD_S = 0.1


def bodies(arena: Arena, pose: Array, **others: Array) -> dict[str, Array]:
    """Return worlds with the robots at `pose` [W, N, 3], at rest and as heavy and grippy as any e-puck."""
    worlds, robots = pose.shape[:2]
    usual = {
        "velocity": np.zeros_like(pose),
        "pillars": np.tile(arena.pillars(), (worlds, 1, 1)),
        "mass": np.ones((worlds, robots)),
        "friction": np.ones((worlds, robots)),
    }
    return {"pose": pose} | usual | others


def at_posts(arena: Arena, worlds: int, rng: np.random.Generator) -> Array:
    """Return poses [W, N, 3] on the posts with random headings."""
    heading = rng.uniform(-np.pi, np.pi, (worlds, arena.num_robots, 1))
    return np.concatenate([np.tile(arena.posts(), (worlds, 1, 1)), heading], -1)


def engine(name: str, arena: Arena, pose: Array, **others: Array) -> Physics:
    physics = make_physics(name, arena, len(pose), PERIOD_S)
    physics.place(**bodies(arena, pose, **others))
    return physics


def to_the_middle(pose: Array) -> Array:
    """Return wheel speeds [W, N, 2] that drive everybody to the middle of the arena."""
    error = np.arctan2(-pose[..., 1], -pose[..., 0]) - pose[..., 2]
    error = np.arctan2(np.sin(error), np.cos(error))
    forward, turning = np.cos(error), 1.5 * error
    return MAX_WHEEL_SPEED * np.clip(np.stack([forward - turning, forward + turning], -1), -1, 1)


def at_random(shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Return random wheel speeds [..., 2], most of them full ahead or full astern."""
    return MAX_WHEEL_SPEED * np.clip(rng.uniform(-2, 2, (*shape, 2)), -1, 1)


def gap_between_robots(pose: Array) -> float:
    """Return the least distance between two bodies in any world, m; overlap is negative."""
    distance = np.linalg.norm(pose[:, :, None, :2] - pose[:, None, :, :2], axis=-1)
    return float((distance + 1e3 * np.eye(pose.shape[1])).min() - 2 * BODY_RADIUS_M)


def gap_to_pillars(pose: Array, pillars: Array, radius: float) -> float:
    """Return the least distance between a body and a pillar, m."""
    distance = np.linalg.norm(pose[:, :, None, :2] - pillars[:, None], axis=-1)
    return float(distance.min() - BODY_RADIUS_M - radius)


def gap_to_walls(pose: Array, side: float) -> float:
    return float(side / 2 - BODY_RADIUS_M - np.abs(pose[..., :2]).max())
