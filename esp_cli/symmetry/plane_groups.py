"""Groups of the plane, C_n, D_n, SO(2) and O(2), and how they are written."""

from __future__ import annotations

import math
import re
from fractions import Fraction

import torch

from esp_cli.symmetry.elements import Element
from esp_cli.symmetry.groups import FiniteGroup, Group
from esp_cli.symmetry.plane import PlaneElement, mirror, rotation
from esp_envs.errors import UserError

_NAMED = {
    "identity": Element(),
    "flip-x": mirror(0),
    "flip-diagonal": mirror(45),
    "flip-y": mirror(90),
    "flip-antidiagonal": mirror(135),
}
_DEGREES = r"(\d+(?:\.\d+)?|\d+/0*[1-9]\d*)"
_MAX_FOLD = 360


class PlaneGroup(Group):
    """SO(2), all turns, or O(2), all turns and mirrors; drawn from the uniform (Haar) measure."""

    def __init__(self, mirrors: bool) -> None:
        self.name = "o2" if mirrors else "so2"
        self.mirrors = mirrors

    def draw(self, generator: torch.Generator) -> Element:
        """Draw an angle uniformly, and for O(2) a fair mirror flag."""
        turn = Fraction(float(torch.rand((), generator=generator, dtype=torch.float64)))
        mirrored = self.mirrors and bool(torch.randint(2, (), generator=generator))
        return Element.of(PlaneElement(turn, mirrored))

    def __contains__(self, element: object) -> bool:
        if not isinstance(element, Element) or element.aspects - {PlaneElement}:
            return False
        return self.mirrors or not PlaneElement.of(element).mirrored

    def generators(self) -> tuple[Element, ...]:
        """Return one radian (its multiples come near every turn) and, for O(2), `flip-x`."""
        radian = Element.of(PlaneElement(Fraction(1 / math.tau)))
        return (radian, mirror()) if self.mirrors else (radian,)


def cyclic(n: int) -> FiniteGroup:
    """Return C_n, the turns by multiples of 360/n degrees."""
    return FiniteGroup.generated_by(f"c{n}", [PlaneElement(Fraction(1, n))])


def dihedral(n: int) -> FiniteGroup:
    """Return D_n, the 2n turns and mirrors of a regular n-gon with one corner on the x-axis."""
    return FiniteGroup.generated_by(f"d{n}", [PlaneElement(Fraction(1, n)), mirror()])


def special_orthogonal() -> PlaneGroup:
    """Return SO(2)."""
    return PlaneGroup(mirrors=False)


def orthogonal() -> PlaneGroup:
    """Return O(2)."""
    return PlaneGroup(mirrors=True)


def read_plane(word: str, _: int) -> Element | Group | None:
    """Read a turn, a mirror or a group of these; see `parse_elements`."""
    if word in _NAMED:
        return _NAMED[word]
    if word in ("so2", "o2"):
        return special_orthogonal() if word == "so2" else orthogonal()
    if match := re.fullmatch(r"([cd])(\d{1,3})", word):
        if not 1 <= int(match[2]) <= _MAX_FOLD:
            raise UserError(f"group '{word}' is out of range; take n from 1 to {_MAX_FOLD}, or so2 / o2")
        return cyclic(int(match[2])) if match[1] == "c" else dihedral(int(match[2]))
    if match := re.fullmatch("rot" + _DEGREES, word):
        return rotation(Fraction(match[1]))
    if match := re.fullmatch("flip-?" + _DEGREES, word):
        return mirror(Fraction(match[1]))
    return None
