"""One transform: a turn or mirror of the plane, with or without a permutation of the agents.

Convention, pinned by `tests/symmetry/test_elements.py`: angles are counter-clockwise, `rot90` sends (1, 0) to (0, 1),
so *right* becomes *up*; a product `g @ h` applies h first, hence L_g L_h = L_{gh}. `flip-x` is the mirror in the
x-axis, (x, y) -> (x, -y); `flip-y` the one in the y-axis, (x, y) -> (-x, y).

An element is stored as an exact fraction of a turn, a mirror flag and a permutation, so that closure, products and
inverses are decided without rounding; matrices are derived.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

_MIRROR_NAMES = {
    Fraction(0): "flip-x",
    Fraction(45): "flip-diagonal",
    Fraction(90): "flip-y",
    Fraction(135): "flip-antidiagonal",
}


@lru_cache(maxsize=1024)
def _cos_sin(turn: Fraction) -> tuple[float, float]:
    """Return (cos, sin) of a fraction of a turn, exact at multiples of a quarter and symmetric between quadrants."""
    quarter, rest = divmod(turn * 4, 1)
    angle = float(rest) * math.pi / 2
    cos, sin = (1.0, 0.0) if rest == 0 else (math.cos(angle), math.sin(angle))
    for _ in range(int(quarter)):
        # Adding 0.0 turns the -0.0 of a negated zero into 0.0.
        cos, sin = -sin + 0.0, cos
    return cos, sin


def _number(value: Fraction) -> str:
    """Write degrees exactly where that is short (90, 22.5, 360/7), else rounded."""
    for text in (f"{float(value):g}", str(value)):
        if Fraction(text) == value and len(text) <= 9:
            return text
    return f"{float(value):.3f}"


@dataclass(frozen=True)
class Element:
    """One transform: mirror in the x-axis if `mirrored`, then turn, and let agent i take the place of agent sigma(i).

    Attributes:
        turn: counter-clockwise fraction of a full turn in [0, 1).
        mirrored: whether y changes sign before the turn.
        permutation: sigma, with sigma[i] the place that agent i moves to; None where agents stay.
    """

    turn: Fraction = Fraction(0)
    mirrored: bool = False
    permutation: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "turn", Fraction(self.turn) % 1)
        sigma = self.permutation
        if sigma is None:
            return
        if sorted(sigma) != list(range(len(sigma))):
            raise ValueError(f"{sigma} is no permutation; write each agent number from 0 to {len(sigma) - 1} once")
        if sigma == tuple(range(len(sigma))):
            object.__setattr__(self, "permutation", None)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The orthogonal 2x2 matrix of the planar part, Eq. 1; exact integers at multiples of 90 degrees."""
        cos, sin = _cos_sin(self.turn)
        sign = -1.0 if self.mirrored else 1.0
        return np.array([[cos, -sin * sign + 0.0], [sin, cos * sign + 0.0]])

    @property
    def degrees(self) -> Fraction:
        """The turn in degrees."""
        return self.turn * 360

    @property
    def is_identity(self) -> bool:
        """Whether nothing moves."""
        return self == Element()

    @property
    def planar(self) -> Element:
        """The same element with all agents in their places."""
        return Element(self.turn, self.mirrored)

    @property
    def name(self) -> str:
        """The name that `parse_elements` reads: rot90, flip-x, flip22.5, agents-1-0-2, rot90*agents-1-0-2."""
        parts = []
        if self.mirrored:
            axis = self.degrees / 2
            parts.append(_MIRROR_NAMES.get(axis, f"flip{_number(axis)}"))
        elif self.turn:
            parts.append(f"rot{_number(self.degrees)}")
        if self.permutation is not None:
            parts.append("agents-" + "-".join(map(str, self.permutation)))
        return "*".join(parts) or "identity"

    def __matmul__(self, other: Element) -> Element:
        """Compose: `g @ h` applies h first, then g.

        Raises:
            ValueError: the two permute different numbers of agents.
        """
        # R(a) F R(b) = R(a - b) F: a mirror reverses the sense of the turn that it passes.
        turn = self.turn - other.turn if self.mirrored else self.turn + other.turn
        return Element(turn, self.mirrored != other.mirrored, _compose(self.permutation, other.permutation))

    def inverse(self) -> Element:
        """Return the element that undoes this one."""
        turn = self.turn if self.mirrored else -self.turn
        sigma = self.permutation
        back = None if sigma is None else tuple(sigma.index(i) for i in range(len(sigma)))
        return Element(turn, self.mirrored, back)


def _compose(g: tuple[int, ...] | None, h: tuple[int, ...] | None) -> tuple[int, ...] | None:
    if g is None or h is None:
        return g or h
    if len(g) != len(h):
        raise ValueError(f"permutations of {len(g)} and of {len(h)} agents cannot be composed; give both one length")
    return tuple(g[i] for i in h)


def rotation(degrees: Fraction | int | str) -> Element:
    """Return the counter-clockwise turn by an exact number of degrees."""
    return Element(Fraction(degrees) / 360)


def mirror(axis_degrees: Fraction | int | str = 0) -> Element:
    """Return the mirror in the line through the origin at this angle; 0 is `flip-x`, 90 is `flip-y`."""
    return Element(Fraction(axis_degrees) / 180, mirrored=True)
