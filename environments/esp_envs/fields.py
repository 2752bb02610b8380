"""What numbers are: kinds, fields and layouts.

A task never says how it transforms under a rotation. It says what each number *is* (a scalar, a planar
vector, a pair of wheel speeds, ...); how a group element acts on that kind is known once, elsewhere.

Shape letters, used in every docstring of this project:
    S seeds, T steps, E worlds per seed, B batch, N agents, D observation width, A discrete actions, G group elements.

Axes and signs: x points right, y points up, angles are counter-clockwise in radians.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from itertools import accumulate, pairwise
from typing import ClassVar, NamedTuple

from esp_envs.errors import UserError


@dataclass(frozen=True)
class Kind:
    """What one item of a field is. These are known; a task may define more, beside elements that act on them.

    SCALAR        unchanged by every planar transform (a distance, a flag, a mass).
    PSEUDOSCALAR  changes sign under reflection, unchanged by rotation (a turning rate).
    VECTOR        (x, y), turned by the 2x2 matrix of the element (a position, a velocity, a heading given as
                  the unit vector (cos, sin)).
    WHEELS        (left, right) wheel pair: unchanged by rotation, swapped by reflection.
    PICTURE       one channel of a picture of the plane, of as many pixels as its field says, row after row from the
                  top, in each from the left. A transform moves pixels about the picture's middle, and changes none.
                  With `parts` each pixel holds several numbers, pixel after pixel, which transform too (directions).
    RING          one number for each of n rays around a body, counter-clockwise from the x-axis (a lidar). A turn by
                  360 / n shifts them, a mirror in the x-axis reverses them; other turns are refused.
    RECORD        several numbers of several kinds, as the field's `parts` say (another agent's position and its speed).

    Attributes:
        name: one word.
        width: numbers per item; of a picture, per pixel, of a ring, per ray.
        is_vector: whether the length of an action's item is bounded by 1, and not each of its numbers.
    """

    SCALAR: ClassVar[Kind]
    PSEUDOSCALAR: ClassVar[Kind]
    VECTOR: ClassVar[Kind]
    WHEELS: ClassVar[Kind]
    PICTURE: ClassVar[Kind]
    RING: ClassVar[Kind]
    RECORD: ClassVar[Kind]

    name: str
    width: int
    is_vector: bool = False


Kind.SCALAR, Kind.PSEUDOSCALAR, Kind.PICTURE = Kind("scalar", 1), Kind("pseudoscalar", 1), Kind("picture", 1)
Kind.VECTOR, Kind.WHEELS = Kind("vector", 2, is_vector=True), Kind("wheels", 2)
Kind.RING, Kind.RECORD = Kind("ring", 1), Kind("record", 0)


class Items(Enum):
    """What the items of a field count over, which orders of agents and of items look at.

    FIXED   things that no agent permutation moves (landmarks, the own body).
    OTHERS  the other agents in index order, the observer left out.
    AGENTS  all agents in index order.
    """

    FIXED = "fixed"
    OTHERS = "others"
    AGENTS = "agents"


def others_of(num_agents: int) -> list[list[int]]:
    """Return for each agent the others, in the order of `Items.OTHERS`: N lists of N - 1."""
    return [[other for other in range(num_agents) if other != agent] for agent in range(num_agents)]


@dataclass(frozen=True)
class Field:
    """A run of numbers of one kind: `count` items of `item_width` numbers each, item after item.

    Only a picture has `pixels`, its rows and columns; its items are its channels. Only a ring has `rays`. A record has
    `parts`, the fields of one item in their order; a picture may have them, those of one pixel.

    Attributes:
        family: what its items are, as "landmarks": a set of like things, in whose order nothing lies. Fields of one
            family are joined item by item. Items that count over agents are the family "others" or "agents".
        is_point: whether its vectors are places in the scene, which move when the scene is shifted, and not ways
            between places, velocities or directions.
        sorted_by: numbers of an item by which the environment sorts items, the first one first: 1 is an item's first
            number, -1 the same with the largest first. Transformed items are sorted anew.
    """

    name: str
    kind: Kind
    count: int = 1
    unit: str = ""
    items: Items = Items.FIXED
    pixels: tuple[int, int] | None = None
    rays: int = 0
    parts: tuple[Field, ...] = ()
    family: str = ""
    is_point: bool = False
    sorted_by: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for name, kind, example in _FIELD_TYPES:
            if not isinstance(getattr(self, name), kind):
                raise UserError(f"field '{self.name}': {name} is {getattr(self, name)!r}; give {example}")
        if self.count < 0:
            raise UserError(f"field '{self.name}': count is {self.count}; give how many items it has")
        if (self.kind == Kind.PICTURE) != (self.pixels is not None):
            raise UserError(f"field '{self.name}': a picture, and nothing else, says how many rows and columns it has")
        if self.pixels is not None and min(self.pixels) < 1:
            raise UserError(f"field '{self.name}': pixels are {self.pixels}; give at least one row and one column")
        if (self.kind == Kind.RING) != (self.rays > 0) or self.rays < 0:
            raise UserError(f"field '{self.name}': a ring, and nothing else, says how many rays it has")
        if (self.kind not in (Kind.RECORD, Kind.PICTURE)) if self.parts else self.kind == Kind.RECORD:
            raise UserError(f"field '{self.name}': a record, and nothing else but a picture, says what parts it has")
        if any(part.items is not Items.FIXED or part.pixels is not None for part in self.parts):
            raise UserError(f"field '{self.name}': a record's parts hold no pictures and count over no agents")
        if self.family and self.kind == Kind.PICTURE:
            raise UserError(f"field '{self.name}': the channels of a picture are no like things; leave family out")
        if self.is_point and self.kind != Kind.VECTOR:
            raise UserError(f"field '{self.name}': a {self.kind.name} is no place; leave is_point out")
        known = range(1, self.item_width + 1) if self.items is Items.FIXED else ()
        if any(abs(number) not in known for number in self.sorted_by):
            raise UserError(
                f"field '{self.name}': sorted_by is {self.sorted_by}; give which numbers of an item decide, counted "
                "from 1, negative ones for the largest first, of items that are no agents"
            )

    @property
    def family_name(self) -> str:
        """Name of the family of its items, where they are one."""
        return self.family or ("" if self.items is Items.FIXED else self.items.value)

    @property
    def item_width(self) -> int:
        """Numbers per item."""
        each = sum(part.width for part in self.parts) or self.kind.width
        return each * (self.rays or math.prod(self.pixels or (1,)))

    @property
    def width(self) -> int:
        """Numbers in the whole field."""
        return self.count * self.item_width

    @property
    def described(self) -> str:
        """What it holds, in words: "vector x 2", "picture of 21 x 21 x 1"."""
        size = "" if self.pixels is None else f" of {self.pixels[0]} x {self.pixels[1]}"
        if self.rays:
            size = f" of {self.rays} rays"
        if self.parts:
            size += f" of {', '.join(f'{part.name} ({part.described})' for part in self.parts)}"
        return f"{self.kind.name}{size} x {self.count}"


_FIELD_TYPES = (
    ("name", str, "a text"),
    ("kind", Kind, "a kind, as Kind.VECTOR"),
    ("count", int, "a number of items"),
    ("unit", str, "a text, as unit='m'"),
    ("items", Items, "what items count over, as items=Items.OTHERS"),
    ("family", str, "a text, as family='landmarks'"),
)
"""What attributes of a field have to be; the fourth and fifth are easily confused."""


class Placed(NamedTuple):
    """A field and where it lies in a row."""

    field: Field
    where: slice


@dataclass(frozen=True)
class Family:
    """A set of like things in a row: `count` items, each the numbers of several fields side by side.

    Family("others", 2, (Placed(position, slice(10, 14)), Placed(velocity, slice(14, 18)))) has two items of four
    numbers: 10, 11, 14, 15 and 12, 13, 16, 17 of the row.
    """

    name: str
    count: int
    parts: tuple[Placed, ...]

    @property
    def width(self) -> int:
        """Numbers of one item."""
        return sum(part.field.item_width for part in self.parts)


@dataclass(frozen=True)
class Layout:
    """A sequence of fields: the whole meaning of an observation, a state or a continuous action vector."""

    fields: tuple[Field, ...]

    def __post_init__(self) -> None:
        if stranger := next((repr(f) for f in self.fields if not isinstance(f, Field)), None):
            raise UserError(f"a layout is made of fields, and {stranger} is none; write layout(Field(...), ...)")
        names = [f.name for f in self.fields]
        if len(set(names)) != len(names):
            raise UserError(f"field names must differ, got {names}")

    @cached_property
    def width(self) -> int:
        """Numbers in one row."""
        return sum(f.width for f in self.fields)

    def slices(self) -> dict[str, slice]:
        """Where each field lies in a row."""
        stops = accumulate((f.width for f in self.fields), initial=0)
        return {f.name: slice(*ends) for f, ends in zip(self.fields, pairwise(stops), strict=True)}

    @property
    def own(self) -> tuple[Placed, ...]:
        """The fields that belong to no family."""
        return tuple(Placed(f, s) for f, s in self._placed if f.width and not f.family_name)

    @cached_property
    def families(self) -> tuple[Family, ...]:
        """The sets of like things, in the order of their first fields; items of one family have to be as many."""
        joined: dict[str, list[Placed]] = {}
        for field, where in self._placed:
            if field.width and field.family_name:
                joined.setdefault(field.family_name, []).append(Placed(field, where))
        for name, parts in joined.items():
            if other := next((p.field for p in parts if p.field.count != parts[0].field.count), None):
                first = parts[0].field
                raise UserError(
                    f"the {name} of a family are joined item by item, but '{first.name}' has {first.count} items and "
                    f"'{other.name}' {other.count}; give them one number, or another family"
                )
        return tuple(Family(name, parts[0].field.count, tuple(parts)) for name, parts in joined.items())

    @property
    def without_counts(self) -> Layout:
        """The same with one thing in each family, which tells layouts apart up to how many there are, in any order."""
        return Layout(
            tuple(
                replace(f, name=f"{f.family_name} {k}", count=1, items=Items.FIXED, family=f.family_name)
                if f.family_name and f.count
                else f
                for k, f in enumerate(self.fields)
            )
        )

    @property
    def _placed(self) -> Iterator[tuple[Field, slice]]:
        return zip(self.fields, self.slices().values(), strict=True)

    @property
    def summary(self) -> str:
        """The fields in a few words: "heading 2, goal 2 (m)"."""
        return ", ".join(f"{f.name} {f.width}" + (f" ({f.unit})" if f.unit else "") for f in self.fields)

    def table(self) -> list[tuple[str, str, str, str]]:
        """Rows (index range, name, kind x count, unit) for environment cards and export manifests."""
        spans = (str(s.start) if f.width == 1 else f"{s.start}..{s.stop - 1}" for f, s in self._placed)
        return [(span, f.name, f.described, f.unit) for span, f in zip(spans, self.fields, strict=True)]


def layout(*fields: Field) -> Layout:
    """Build a layout from its fields."""
    return Layout(tuple(fields))


def filled_layout(*fields: Field) -> Layout:
    """Build a layout from those of the fields that have items."""
    return layout(*(field for field in fields if field.count))


def joint_layout(observation: Layout, num_agents: int) -> Layout:
    """Return the layout of all agents' observations one after the other (width N * D)."""
    return Layout(tuple(replace(f, name=f"agent{i}.{f.name}") for i in range(num_agents) for f in observation.fields))
