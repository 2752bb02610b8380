"""Hand-written policies for e-pucks: drive straight at the goal, or give way to each other on the right.

Everything works on all worlds at once. Vectors are in metres in the world frame.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from esp_envs.epuck.robot import MAX_SPEED_M_S, MAX_SPIN_RAD_S

SIGHT_M = 0.25
"""Gap between bodies below which one gives way to the other; this and the weights below were found by search."""
PUSH = 1.0
"""Weight of moving away from a near body, against 1 for moving to the goal."""
SWERVE = 1.5
"""Weight of passing a near body on the right."""


def towards(wish: Tensor, heading: Tensor, control_period_s: float) -> Tensor:
    """Return wheel speeds that turn to a wished way and drive along it.

    Args:
        wish: [W, N, 2] m; shorter ones than a control period's full speed are driven more slowly.
        heading: [W, N] rad.
        control_period_s: time until the next choice.

    Returns:
        [W, N, 2] left and right in [-1, 1].
    """
    error = torch.atan2(wish[..., 1], wish[..., 0]) - heading
    error = torch.remainder(error + math.pi, 2 * math.pi) - math.pi
    length = wish.norm(dim=-1) / (MAX_SPEED_M_S * control_period_s)
    moves = length > 0.1
    turn = (error / (MAX_SPIN_RAD_S * control_period_s)).clamp(-1, 1) * moves
    speed = length.clamp(max=1) * error.cos().clamp(min=0) * (1 - turn.abs()) * moves
    return torch.stack([speed - turn, speed + turn], -1)


def give_way(to_goal: Tensor, to_bodies: Tensor, gaps: Tensor) -> Tensor:
    """Return the way [W, N, 2] that keeps clear of near bodies: away from them, and past them on the right.

    Args:
        to_goal: [W, N, 2] m.
        to_bodies: [W, N, B, 2] from each robot's centre to the centre of every other body, m.
        gaps: [W, N, B] between their surfaces, m; infinite for a robot and itself.
    """
    nearness = (1 - gaps.clamp(min=0) / SIGHT_M).clamp(min=0)
    away = -to_bodies / to_bodies.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    distance = to_goal.norm(dim=-1, keepdim=True)
    ahead = to_goal / distance.clamp_min(1e-9)
    # Only what lies ahead has to be passed; what lies behind is left by driving on.
    facing = (-(away * ahead.unsqueeze(-2)).sum(-1)).clamp(min=0)
    right = torch.stack([-away[..., 1], away[..., 0]], -1)
    push = PUSH * (nearness.square().unsqueeze(-1) * away).sum(-2)
    swerve = SWERVE * ((nearness * facing).unsqueeze(-1) * right).sum(-2)
    pull = ahead * (distance / SIGHT_M).clamp(max=1)
    wish = pull + push + swerve * (distance / SIGHT_M).clamp(max=1)
    return wish * SIGHT_M
