"""Hand-written policies of predator-prey: chasing, and fleeing within bounds.

Everything works on all worlds at once, with the worlds on the last axis W. Both rules are equivariant under every
rotation and reflection as vectors; turned into one of five moves they keep the symmetries of the square.
"""

from __future__ import annotations

import torch
from torch import Tensor

PREY_LEAD_S, OWN_LEAD_S = 0.25, 0.15
"""A predator aims from where it will be in OWN_LEAD_S at where the prey will be in PREY_LEAD_S; found by search."""
URGENCY = 10.0
"""Full force beyond 1 / URGENCY lengths of aiming error."""
BOUND = 0.9
"""The fleeing prey heads for the origin when farther from it than this (lengths)."""
_FAR = 1e3
_TINY = 1e-12


def chase(predator: Tensor, predator_velocity: Tensor, prey: Tensor, prey_velocity: Tensor) -> Tensor:
    """Return the wishes [N, 2, W] of predators that run at the prey.

    Args:
        predator: [N, 2, W].
        predator_velocity: [N, 2, W].
        prey: [2, W].
        prey_velocity: [2, W].
    """
    return URGENCY * (prey + PREY_LEAD_S * prey_velocity - predator - OWN_LEAD_S * predator_velocity)


def flee(predator: Tensor, prey: Tensor) -> Tensor:
    """Return the wish [2, W] of a prey that runs from the nearest predator, and back when it is out of bounds.

    Args:
        predator: [N, 2, W].
        prey: [2, W].
    """
    away = prey - predator
    squared = away.square().sum(1, keepdim=True)
    nearest = squared.argmin(0, keepdim=True).expand(1, 2, -1)
    direction = away.gather(0, nearest)[0] / squared.amin(0).clamp_min(_TINY).sqrt()
    outside = prey.square().sum(0) > BOUND**2
    return _FAR * torch.where(outside, -prey, direction)
