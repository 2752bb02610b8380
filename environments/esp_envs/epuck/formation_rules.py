"""What robots of the formation see, and how hand-written policies steer.

Everything works on all worlds at once. Vectors are in metres in the world frame.
"""

from __future__ import annotations

import math

import numpy as np

from esp_envs.epuck.robot import MAX_SPEED_M_S, MAX_SPIN_RAD_S, Array

FADING_M = 0.2  # gap over which the sight `nearness` of a body fades to 1/e
RISKY_GAP_M = 0.05  # gap between two robots below which a state is risky (supplement of the paper)
CONTACT_GAP_M = 0.001  # gap below which two bodies count as touching
SIGHT_M = 0.25
"""Gap between bodies below which one gives way to the other; this and the weights below were found by search."""
PUSH = 1.0  # weight of moving away from a near body, against 1 for moving to the goal
SWERVE = 1.5  # weight of passing a near body on the right


def length(offset: Array) -> Array:
    """Return the lengths [...] of offsets [..., 2]."""
    return np.hypot(offset[..., 0], offset[..., 1])


def nearest(apart: Array, ways: Array, count: int) -> Array:
    """Return the offsets [W, N, count, 2] of the nearest bodies, by distances [W, N, B] and offsets [W, N, B, 2], m."""
    index = apart.argmin(-1)[..., None] if count == 1 else np.argsort(apart, -1, kind="stable")[..., :count]
    worlds, robots = np.arange(len(apart))[:, None, None], np.arange(apart.shape[1])[:, None]
    return ways[worlds, robots, index]


def nearness(offset: Array, reach_m: float) -> Array:
    """Return the direction of a body [..., 2], of length exp(-gap / 0.2 m): 1 where centres are `reach_m` apart."""
    distance = np.maximum(length(offset), 1e-9)[..., None]
    return offset / distance * np.exp(-np.maximum(distance - reach_m, 0) / FADING_M)


def within(offset: Array, unit_m: float) -> Array:
    """Return offsets [..., 2] in a unit of length, those that are longer than one cut to one."""
    return offset / np.maximum(length(offset), unit_m)[..., None]


def towards(wish: Array, heading: Array, control_period_s: float) -> Array:
    """Return wheel speeds, [W, N, 2] in [-1, 1], that turn to a wish [W, N, 2] m and drive along it."""
    error = np.arctan2(wish[..., 1], wish[..., 0]) - heading
    error = np.remainder(error + math.pi, 2 * math.pi) - math.pi
    reach = length(wish) / (MAX_SPEED_M_S * control_period_s)
    moves = reach > 0.1
    turn = np.clip(error / (MAX_SPIN_RAD_S * control_period_s), -1, 1) * moves
    speed = np.minimum(reach, 1) * np.maximum(np.cos(error), 0) * (1 - np.abs(turn)) * moves
    return np.stack([speed - turn, speed + turn], -1)


def give_way(to_goal: Array, to_bodies: Array, gaps: Array) -> Array:
    """Return the way [W, N, 2] that keeps clear of near bodies: away from them, and past them on the right.

    `to_bodies` [W, N, B, 2] leads to their centres, m; `gaps` [W, N, B] between surfaces, m, are infinite for oneself.
    """
    near = np.maximum(1 - np.maximum(gaps, 0) / SIGHT_M, 0)
    away = -to_bodies / np.maximum(length(to_bodies), 1e-9)[..., None]
    distance = length(to_goal)[..., None]
    ahead = to_goal / np.maximum(distance, 1e-9)
    # Only what lies ahead has to be passed; what lies behind is left by driving on.
    facing = np.maximum(-(away * ahead[:, :, None]).sum(-1), 0)
    right = np.stack([-away[..., 1], away[..., 0]], -1)
    push = PUSH * (np.square(near)[..., None] * away).sum(-2)
    swerve = SWERVE * ((near * facing)[..., None] * right).sum(-2)
    here = np.minimum(distance / SIGHT_M, 1)
    return (ahead * here + push + swerve * here) * SIGHT_M
