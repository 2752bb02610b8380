"""Hand-written policies for e-pucks: drive straight at the goal, or give way to each other on the right.

Everything works on all worlds at once. Vectors are in metres in the world frame.
"""

from __future__ import annotations

import math

import numpy as np

from esp_envs.epuck.robot import MAX_SPEED_M_S, MAX_SPIN_RAD_S, Array
from esp_envs.epuck.sight import length

SIGHT_M = 0.25
"""Gap between bodies below which one gives way to the other; this and the weights below were found by search."""
PUSH = 1.0
"""Weight of moving away from a near body, against 1 for moving to the goal."""
SWERVE = 1.5
"""Weight of passing a near body on the right."""


def towards(wish: Array, heading: Array, control_period_s: float) -> Array:
    """Return wheel speeds that turn to a wished way and drive along it.

    Args:
        wish: [W, N, 2] m; shorter ones than a control period's full speed are driven more slowly.
        heading: [W, N] rad.
        control_period_s: time until the next choice.

    Returns:
        [W, N, 2] left and right in [-1, 1].
    """
    error = np.arctan2(wish[..., 1], wish[..., 0]) - heading
    error = np.remainder(error + math.pi, 2 * math.pi) - math.pi
    reach = length(wish) / (MAX_SPEED_M_S * control_period_s)
    moves = reach > 0.1
    turn = np.clip(error / (MAX_SPIN_RAD_S * control_period_s), -1, 1) * moves
    speed = np.minimum(reach, 1) * np.maximum(np.cos(error), 0) * (1 - np.abs(turn)) * moves
    return np.stack([speed - turn, speed + turn], -1)


def give_way(to_goal: Array, to_bodies: Array, gaps: Array) -> Array:
    """Return the way [W, N, 2] that keeps clear of near bodies: away from them, and past them on the right.

    Args:
        to_goal: [W, N, 2] m.
        to_bodies: [W, N, B, 2] from each robot's centre to the centre of every other body, m.
        gaps: [W, N, B] between their surfaces, m; infinite for a robot and itself.
    """
    nearness = np.maximum(1 - np.maximum(gaps, 0) / SIGHT_M, 0)
    away = -to_bodies / np.maximum(length(to_bodies), 1e-9)[..., None]
    distance = length(to_goal)[..., None]
    ahead = to_goal / np.maximum(distance, 1e-9)
    # Only what lies ahead has to be passed; what lies behind is left by driving on.
    facing = np.maximum(-(away * ahead[:, :, None]).sum(-1), 0)
    right = np.stack([-away[..., 1], away[..., 0]], -1)
    push = PUSH * (np.square(nearness)[..., None] * away).sum(-2)
    swerve = SWERVE * ((nearness * facing)[..., None] * right).sum(-2)
    here = np.minimum(distance / SIGHT_M, 1)
    return (ahead * here + push + swerve * here) * SIGHT_M
