"""What a robot of the formation sees of near bodies, and what a picture of the formation shows."""

from __future__ import annotations

import numpy as np

from esp_envs.epuck.formation_spec import FormationSettings
from esp_envs.epuck.robot import BODY_RADIUS_M, Array, Flags
from esp_envs.scene import COLORS, Body, Scene

FADING_M = 0.2
"""Gap over which the sight `nearness` of a body fades to 1/e."""
_PILLAR_COLOR = "#707070"


def length(offset: Array) -> Array:
    """Return the lengths [...] of offsets [..., 2]."""
    return np.hypot(offset[..., 0], offset[..., 1])


def nearest(apart: Array, ways: Array, count: int) -> Array:
    """Return the offsets [W, N, count, 2] of the nearest bodies, nearest first.

    Args:
        apart: [W, N, B] distances of the centres, m.
        ways: [W, N, B, 2] offsets of the centres, m.
        count: of bodies.
    """
    index = apart.argmin(-1)[..., None] if count == 1 else np.argsort(apart, -1, kind="stable")[..., :count]
    worlds, robots = np.arange(len(apart))[:, None, None], np.arange(apart.shape[1])[:, None]
    return ways[worlds, robots, index]


def nearness(offset: Array, reach_m: float) -> Array:
    """Return the direction of a body, of length exp(-gap / 0.2 m): 1 where it touches.

    Args:
        offset: [..., 2] between the centres, m.
        reach_m: distance of the centres where the bodies touch.
    """
    distance = np.maximum(length(offset), 1e-9)[..., None]
    return offset / distance * np.exp(-np.maximum(distance - reach_m, 0) / FADING_M)


def in_sector(offset: Array, width_rad: float) -> Flags:
    """Return which offsets [..., 2] lie in the sector of this width around the direction of x, [...]."""
    return np.abs(np.arctan2(offset[..., 1], offset[..., 0])) < width_rad / 2


def within(offset: Array, unit_m: float) -> Array:
    """Return offsets [..., 2] in a unit of length, those that are longer than one cut to one."""
    return offset / np.maximum(length(offset), unit_m)[..., None]


def formation_scene(
    settings: FormationSettings, goals: Array, pillars: Array, position: Array, heading: Array
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
