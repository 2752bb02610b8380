"""What a task tells a renderer: the bodies in a window, not how to paint them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

COLORS = ("#0072B2", "#E69F00", "#c3576f", "#4e3200", "#86c5fd", "#aa7532", "#0b2697", "#e3ce94")
"""Of agents and of curves, in their order: any two differ by 30 CIE76 or more, also without red or green cones."""
DARK, PALE = "#202020", "#d4d4d4"
"""Of what agents look for, and of what is in their way; as far from those above and from each other."""


def look(index: int) -> dict[str, Any]:
    """Return color and name of the agent with this index, as arguments of a `Body`; there are 26 letters."""
    return {"color": COLORS[index % len(COLORS)], "name": chr(ord("A") + index) if index < 26 else ""}


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
        held: what a legend calls that; a renderer rings the body while it is so.
        name: a letter that is written on it, or beside it where it is small or has a nose.
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
    held: str = "covered"
    name: str = ""


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


def holders(scene: Scene) -> dict[int, int]:
    """Return which body is covered by which: for the index of each body within reach of others, that of the nearest."""
    able = [k for k, body in enumerate(scene.bodies) if body.trail]
    wanted = [k for k, body in enumerate(scene.bodies) if body.reach is not None]
    if not able or not wanted:
        return {}
    theirs, places = (np.array([scene.bodies[k].position for k in group]) for group in (able, wanted))
    distance = np.hypot(*np.moveaxis(places[:, None] - theirs, -1, 0))
    distance[np.equal.outer(wanted, able)] = np.inf  # none covers itself
    found = zip(wanted, distance.argmin(1).tolist(), distance.min(1).tolist(), strict=True)
    return {k: able[nearest] for k, nearest, apart in found if apart < (scene.bodies[k].reach or 0.0)}


class Painter(Protocol):
    """What draws scenes."""

    note: str | None  # a sentence for the user about how it draws, or None

    def draw(self, scene: Scene, trail: Sequence[Scene] = ()) -> NDArray[np.uint8]:
        """Draw one scene with the trails of earlier ones, oldest first: [H, W, 3] uint8, RGB, the top row first."""
