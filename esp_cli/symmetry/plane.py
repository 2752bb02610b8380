"""Turns and mirrors of the plane, their groups C_n, D_n, SO(2) and O(2), and how they act on each kind of field.

Convention, pinned by `tests/symmetry/test_elements.py`: angles are counter-clockwise, `rot90` sends (1, 0) to (0, 1),
so *right* becomes *up*; a product `g @ h` applies h first, hence L_g L_h = L_{gh}. `flip-x` is the mirror in the
x-axis, (x, y) -> (x, -y); `flip-y` the one in the y-axis, (x, y) -> (-x, y).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import cache, cached_property, lru_cache

import numpy as np
import torch

from esp_cli.symmetry.elements import Element, Floats, Geometry, Indices
from esp_cli.symmetry.groups import FiniteGroup, Group
from esp_envs.errors import UserError
from esp_envs.spec import Field, Kind

_PIXEL_TOLERANCE = 1e-6
_MIRRORS = {"flip-x": 0, "flip-diagonal": 45, "flip-y": 90, "flip-antidiagonal": 135}  # axis in degrees
_DEGREES = r"(\d{1,99}(?:\.\d{1,99})?|\d{1,99}/0{0,99}[1-9]\d{0,99})"
_MAX_FOLD = 360


@dataclass(frozen=True)
class PlaneElement(Geometry):
    """Mirror in the x-axis if `mirrored`, then turn. Products and inverses are exact; matrices are derived.

    PlaneElement(Fraction(1, 4)).block(Field("way", Kind.VECTOR))  # [[0, -1], [1, 0]]
    """

    turn: Fraction = Fraction(0)  # counter-clockwise fraction of a full turn in [0, 1)
    mirrored: bool = False  # whether y changes sign before the turn

    def __post_init__(self) -> None:
        object.__setattr__(self, "turn", Fraction(self.turn) % 1)

    @staticmethod
    def of(element: Element) -> PlaneElement:
        """Return what an element does to the plane."""
        return next((g for g in element.geometry if isinstance(g, PlaneElement)), PlaneElement())

    @cached_property
    def matrix(self) -> Floats:
        """The orthogonal 2x2 matrix, Eq. 1; exact integers at multiples of 90 degrees."""
        cos, sin = _cos_sin(self.turn)
        sign = -1.0 if self.mirrored else 1.0
        return np.array([[cos, -sin * sign + 0.0], [sin, cos * sign + 0.0]])

    @property
    def degrees(self) -> Fraction:
        return self.turn * 360

    @property
    def is_identity(self) -> bool:
        return not (self.turn or self.mirrored)

    @property
    def sort_key(self) -> tuple[bool, Fraction]:
        return self.mirrored, self.turn

    @property
    def participle(self) -> str:
        return f"mirrored by {self.name}" if self.mirrored else f"turned by {float(self.degrees):g} degrees"

    @property
    def name(self) -> str:
        if self.mirrored:
            axis = self.degrees / 2
            return next((name for name, named in _MIRRORS.items() if named == axis), f"flip{_number(axis)}")
        return f"rot{_number(self.degrees)}" if self.turn else "identity"

    def __matmul__(self, other: PlaneElement) -> PlaneElement:
        # R(a) F R(b) = R(a - b) F: a mirror reverses the sense of the turn that it passes.
        turn = self.turn - other.turn if self.mirrored else self.turn + other.turn
        return PlaneElement(turn, self.mirrored != other.mirrored)

    def inverse(self) -> PlaneElement:
        return self if self.mirrored else PlaneElement(-self.turn)

    def block(self, field: Field) -> Floats | Indices:
        if field.pixels is not None:
            return picture_sources(field.pixels, self.matrix)
        if field.rays:
            return ring_sources(field.rays, self.matrix)
        matrix = getattr(field.kind, "matrix", None) or KIND_MATRICES.get(field.kind)
        if matrix is None:
            raise UserError(f"a planar transform does not say how field '{field.name}' of kind {field.kind.name} turns")
        return matrix(self.matrix)


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


def _pseudoscalar(planar: Floats) -> Floats:
    # Round: the determinant of an orthogonal matrix is +1 or -1.
    return np.rint(np.linalg.det(planar)).reshape(1, 1)


def _wheels(planar: Floats) -> Floats:
    return np.eye(2) if _pseudoscalar(planar) > 0 else np.array([[0.0, 1.0], [1.0, 0.0]])


KIND_MATRICES: dict[Kind, Callable[[Floats], Floats]] = {
    Kind.SCALAR: lambda _: np.ones((1, 1)),
    Kind.PSEUDOSCALAR: _pseudoscalar,
    Kind.VECTOR: lambda planar: planar,
    Kind.WHEELS: _wheels,
}
"""One representation per field kind, pictures and rings apart: a planar matrix [2, 2] to [width, width].

A kind that turns and mirrors leave alone, such as one of another geometry, says so here with a unit matrix.
"""


def picture_sources(pixels: tuple[int, int], planar: Floats) -> Indices:
    """Return [rows * columns]: the index of the old pixel that shows in each pixel of a transformed picture."""
    rows, columns = pixels
    row, column = np.divmod(np.arange(rows * columns), columns)
    place = np.stack([column - (columns - 1) / 2, (rows - 1) / 2 - row], -1)
    origin = place @ planar  # the inverse is the transpose
    old = np.stack([(rows - 1) / 2 - origin[:, 1], origin[:, 0] + (columns - 1) / 2], -1)
    whole = np.rint(old)
    if np.abs(whole - old).max() >= _PIXEL_TOLERANCE or (whole < 0).any() or (whole >= [rows, columns]).any():
        raise UserError(f"the pixels of a picture of {rows} x {columns} do not come to lie on pixels")
    return (whole[:, 0] * columns + whole[:, 1]).astype(np.int64)


def ring_sources(rays: int, planar: Floats) -> Indices:
    """Return [rays]: the index of the old ray that shows in each ray of a transformed ring."""
    angle = 2 * np.pi * np.arange(rays) / rays
    origin = np.stack([np.cos(angle), np.sin(angle)], -1) @ planar  # the inverse is the transpose
    old = np.arctan2(origin[:, 1], origin[:, 0]) * rays / (2 * np.pi)
    whole = np.rint(old)
    if np.abs(whole - old).max() >= _PIXEL_TOLERANCE:
        within = [f"d{fold}" for fold in range(3, rays) if rays % fold == 0][:3]
        fits = ", ".join([f"d{rays}", *within])
        raise UserError(f"the rays of a ring of {rays} do not come to lie on rays, as they do under {fits}")
    return whole.astype(np.int64) % rays


def rotation(degrees: Fraction | int | str) -> Element:
    """Return the counter-clockwise turn by an exact number of degrees."""
    return Element.of(PlaneElement(Fraction(degrees) / 360))


def mirror(axis_degrees: Fraction | int | str = 0) -> Element:
    """Return the mirror in the line through the origin at this angle; 0 is `flip-x`, 90 is `flip-y`."""
    return Element.of(PlaneElement(Fraction(axis_degrees) / 180, mirrored=True))


class PlaneGroup(Group):
    """SO(2), all turns, or O(2), all turns and mirrors; drawn from the uniform (Haar) measure."""

    def __init__(self, mirrors: bool) -> None:
        self.name = "o2" if mirrors else "so2"
        self.mirrors = mirrors

    def draw(self, generator: torch.Generator) -> Element:
        turn = Fraction(float(torch.rand((), generator=generator, dtype=torch.float64)))
        mirrored = self.mirrors and bool(torch.randint(2, (), generator=generator))
        return Element.of(PlaneElement(turn, mirrored))

    def __contains__(self, element: object) -> bool:
        if not isinstance(element, Element) or element.aspects - {PlaneElement}:
            return False
        return self.mirrors or not PlaneElement.of(element).mirrored

    def generators(self) -> tuple[Element, ...]:
        radian = Element.of(PlaneElement(Fraction(1 / math.tau)))  # its multiples come near every turn
        return (radian, mirror()) if self.mirrors else (radian,)


@cache
def cyclic(n: int) -> FiniteGroup:
    """Return C_n, the turns by multiples of 360/n degrees."""
    return FiniteGroup.generated_by(f"c{n}", [PlaneElement(Fraction(1, n))])


@cache
def dihedral(n: int) -> FiniteGroup:
    """Return D_n, the 2n turns and mirrors of a regular n-gon with one corner on the x-axis."""
    return FiniteGroup.generated_by(f"d{n}", [PlaneElement(Fraction(1, n)), mirror()])


BODY_NAMES = {"left-right": "flip-x", "front-back": "flip-y", "half-turn": "rot180", "quarter-turn": "rot90"}
"""What a robot that faces x calls elements."""


def read_plane(word: str, _: int) -> Element | Group | None:
    """Read a turn, a mirror or a group of these; see `parse_elements`."""
    word = BODY_NAMES.get(word, word)
    if word == "identity":
        return Element()
    if word in _MIRRORS:
        return mirror(_MIRRORS[word])
    if word in ("so2", "o2"):
        return PlaneGroup(mirrors=word == "o2")
    if match := re.fullmatch(r"([cd])(\d{1,3})", word):
        if not 1 <= int(match[2]) <= _MAX_FOLD:
            raise UserError(f"group '{word}' is out of range; take n from 1 to {_MAX_FOLD}, or so2 / o2")
        return cyclic(int(match[2])) if match[1] == "c" else dihedral(int(match[2]))
    if match := re.fullmatch("rot" + _DEGREES, word):
        return rotation(Fraction(match[1]))
    if match := re.fullmatch("flip-?" + _DEGREES, word):
        return mirror(Fraction(match[1]))
    return None
