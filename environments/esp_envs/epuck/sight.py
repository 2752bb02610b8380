"""What a robot of the formation sees of near bodies, and what a picture of the formation shows."""

from __future__ import annotations

import torch
from torch import Tensor

from esp_envs.epuck.formation_spec import FormationSettings
from esp_envs.epuck.robot import BODY_RADIUS_M
from esp_envs.scene import COLORS, Body, Scene

FADING_M = 0.2
"""Gap over which the sight `nearness` of a body fades to 1/e."""
_PILLAR_COLOR = "#707070"


def nearest(apart: Tensor, ways: Tensor, count: int) -> Tensor:
    """Return the offsets [W, N, count, 2] of the nearest bodies, nearest first.

    Args:
        apart: [W, N, B] distances of the centres, m.
        ways: [W, N, B, 2] offsets of the centres, m.
        count: of bodies.
    """
    index = apart.argmin(-1, keepdim=True) if count == 1 else apart.argsort(dim=-1, stable=True)[..., :count]
    return ways.gather(2, index.unsqueeze(-1).expand(*index.shape, 2))


def nearness(offset: Tensor, reach_m: float) -> Tensor:
    """Return the direction of a body, of length exp(-gap / 0.2 m): 1 where it touches.

    Args:
        offset: [..., 2] between the centres, m.
        reach_m: distance of the centres where the bodies touch.
    """
    distance = offset.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    return offset / distance * torch.exp(-(distance - reach_m).clamp(min=0) / FADING_M)


def in_sector(offset: Tensor, width_rad: float) -> Tensor:
    """Return which offsets [..., 2] lie in the sector of this width around the direction of x, [..., 1]."""
    return torch.atan2(offset[..., 1:], offset[..., :1]).abs() < width_rad / 2


def within(offset: Tensor, unit_m: float) -> Tensor:
    """Return offsets [..., 2] in a unit of length, those that are longer than one cut to one."""
    return offset / offset.norm(dim=-1, keepdim=True).clamp_min(unit_m)


def formation_scene(
    settings: FormationSettings, goals: Tensor, pillars: Tensor, position: Tensor, heading: Tensor
) -> Scene:
    """Return goals [N, 2], pillars [M, 2] and robots, at positions [N, 2] with headings [N], of one world."""
    bodies = []
    for i, goal in enumerate(goals.tolist()):
        bodies.append(Body(tuple(goal), BODY_RADIUS_M, COLORS[i % len(COLORS)], "ring", model="goal", label="goal"))
    radius = settings.obstacle_radius_m
    bodies += [Body(tuple(place), radius, _PILLAR_COLOR, model="pillar", label="pillar") for place in pillars.tolist()]
    for i, (place, turn) in enumerate(zip(position.tolist(), heading.tolist(), strict=True)):
        color = COLORS[i % len(COLORS)]
        bodies.append(Body(tuple(place), BODY_RADIUS_M, color, "disc", turn, trail=True, model="robot", label="robot"))
    half = settings.arena.side_m / 2
    return Scene(tuple(bodies), (-half, half, -half, half), unit="m")
