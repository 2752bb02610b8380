"""What a task tells a renderer: the bodies in a window, not how to paint them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

COLORS = ("#3f6fd8", "#d8703f", "#3fa86a", "#a04fc0", "#c0a030", "#30a0b8", "#c04070", "#607080")
"""Of agents, in their order."""


@dataclass(frozen=True)
class Body:
    """One thing to draw.

    Attributes:
        position: (x, y) in world units.
        radius: in world units.
        color: "#rrggbb".
        shape: "disc", "ring", "cross" or "square".
        heading: direction of a nose mark in radians, or None.
        trail: whether a renderer may draw its path.
        model: what a renderer in space builds of it ("robot", "pillar", "goal"); flat pictures ignore it.
        label: what a legend calls it, or None for no entry.
        reach: distance within which a body that leaves a trail covers it, in world units; None for what nobody covers.
    """

    position: tuple[float, float]
    radius: float
    color: str
    shape: str = "disc"
    heading: float | None = None
    trail: bool = False
    model: str | None = None
    label: str | None = None
    reach: float | None = None


GRID_SPACING = 0.5  # distance of the lines behind a scene, unless it says otherwise


@dataclass(frozen=True)
class Scene:
    """A drawable snapshot of one world: bodies in the window (x_min, x_max, y_min, y_max), drawn in order.

    `grid` is the distance of the lines behind them and where one of them lies, along either axis; `unit` is that of
    positions. An environment of others that draws itself gives its own `picture` [H, W, 3] instead.
    """

    bodies: tuple[Body, ...]
    window: tuple[float, float, float, float]
    grid: tuple[float, float] = (GRID_SPACING, 0.0)
    unit: str = ""
    picture: NDArray[np.uint8] | None = field(default=None, compare=False)


class Painter(Protocol):
    """What draws scenes.

    Attributes:
        note: a sentence for the user about how it draws, or None.
    """

    note: str | None

    def draw(self, scene: Scene, trail: Sequence[Scene] = ()) -> NDArray[np.uint8]:
        """Draw one scene with the trails of earlier ones, oldest first: [H, W, 3] uint8, RGB, the top row first."""
