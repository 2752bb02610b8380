"""Elements of a symmetry group: geometry x order of agents x orders of items.

A new kind of geometry is one file beside this one: see `plane`. Orders of agents and items multiply with any of them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from esp_envs.errors import UserError
from esp_envs.spec import Field

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Order = tuple[int, ...]  # thing i moves to place order[i]
Orders = tuple[tuple[str, Order], ...]  # fields by name, each with the order of its items
AGENTS = "agents"  # stands for the agents where orders are named


class Geometry(ABC):
    """What one transform does to the scene: hashable, composable, invertible, and known by how it acts on each field.

    Groups, L_g and K_g, admission, the prior and equivariant networks follow from these members. Convention: a product
    `g @ h` applies h first, hence L_g L_h = L_{gh}.
    """

    @property
    @abstractmethod
    def name(self) -> str:
        """The name that `parse_elements` reads."""

    @property
    @abstractmethod
    def sort_key(self) -> tuple[Any, ...]:
        """What the elements of a group are sorted by; smallest for the identity."""

    @property
    @abstractmethod
    def is_identity(self) -> bool:
        """Whether nothing moves."""

    @property
    def participle(self) -> str:
        """How messages say that something was transformed: "turned by 45 degrees"."""
        return f"under {self.name}"

    @abstractmethod
    def __matmul__(self, other: Any) -> Geometry:
        """Compose with another of the same kind: `g @ h` applies h first, then g."""

    @abstractmethod
    def inverse(self) -> Geometry:
        """Return the geometry that undoes this one."""

    @abstractmethod
    def block(self, field: Field) -> Floats | Indices:
        """Return how the d numbers of one item of a field transform: an orthogonal matrix [d, d].

        Or, where numbers only change places, [d] integers: new number k is the old number block[k].

        Raises:
            UserError: the field cannot be transformed.
        """


@dataclass(frozen=True)
class Element:
    """One transform of a task: what it does to the scene, and how agents and items change places.

    swap = Element(permutation=(1, 0))
    both = mirror() @ swap  # the parts act on different things, so they commute
    both.name  # "flip-x*agents-1-0"


    Raises:
        UserError: two geometries are of one kind, or an order names a place twice.
    """

    geometry: tuple[Geometry, ...] = ()  # at most one of each kind of `Geometry`; empty where the scene stays
    permutation: Order | None = None  # sigma, with sigma[i] the place that agent i moves to; None where agents stay
    # fields whose like items change places, each with the place that item k moves to; sorted by name
    items: Orders = ()

    def __post_init__(self) -> None:
        acting = sorted((g for g in self.geometry if not g.is_identity), key=lambda g: type(g).__name__)
        if len({type(g) for g in acting}) < len(acting):
            raise UserError(f"{' and '.join(g.name for g in acting)} are of one kind; multiply them")
        object.__setattr__(self, "geometry", tuple(acting))
        if self.permutation is not None and not _moves(self.permutation):
            object.__setattr__(self, "permutation", None)
        object.__setattr__(self, "items", tuple(sorted((name, order) for name, order in self.items if _moves(order))))

    @staticmethod
    def of(found: Geometry | Element) -> Element:
        """Return an element, or the one that a geometry is by itself."""
        return Element((found,)) if isinstance(found, Geometry) else found

    @property
    def orders(self) -> Orders:
        """All that changes places, agents first: (("agents", (1, 0, 2)), ("landmarks", (2, 0, 1)))."""
        return self.items if self.permutation is None else ((AGENTS, self.permutation), *self.items)

    @property
    def name(self) -> str:
        """The name that `parse_elements` reads: rot90, flip-x, rot90*agents-1-0-2*landmarks-1-0."""
        words = [*(g.name for g in self.geometry), *(order_name(*order) for order in self.orders)]
        return "*".join(words) or "identity"

    @property
    def participle(self) -> str:
        """How messages say that something was transformed."""
        return " and ".join(g.participle for g in self.geometry) or f"under {self.name}"

    @property
    def sort_key(self) -> tuple[Any, ...]:
        """What the elements of a group are sorted by: items, permutation, geometry."""
        return self.items, self.permutation or (), tuple((type(g).__name__, g.sort_key) for g in self.geometry)

    @property
    def is_identity(self) -> bool:
        """Whether nothing moves."""
        return not (self.geometry or self.orders)

    @property
    def in_place(self) -> Element:
        """The same element with all agents and items in their places."""
        return Element(self.geometry)

    @property
    def aspects(self) -> frozenset[Any]:
        """What it acts on: kinds of geometry, "agents", names of fields. Elements without a common one commute."""
        return frozenset([*map(type, self.geometry), *(name for name, _ in self.orders)])

    def restricted(self, aspects: frozenset[Any]) -> Element:
        """Return what it does to some aspects, all else left alone."""
        return Element(
            tuple(g for g in self.geometry if type(g) in aspects),
            self.permutation if AGENTS in aspects else None,
            tuple(order for order in self.items if order[0] in aspects),
        )

    def __matmul__(self, other: Element) -> Element:
        """Compose: `g @ h` applies h first, then g."""
        geometry: dict[type, Geometry] = {type(g): g for g in other.geometry}
        for g in self.geometry:
            geometry[type(g)] = g @ geometry[type(g)] if type(g) in geometry else g
        mine, others = dict(self.items), dict(other.items)
        items = {name: _composed(mine.get(name), others.get(name)) or () for name in mine | others}
        permutation = _composed(self.permutation, other.permutation)
        return Element(tuple(geometry.values()), permutation, tuple(items.items()))

    def inverse(self) -> Element:
        """Return the element that undoes this one."""
        permutation = None if self.permutation is None else _undone(self.permutation)
        items = tuple((name, _undone(order)) for name, order in self.items)
        return Element(tuple(g.inverse() for g in self.geometry), permutation, items)


def order_name(name: str, order: Sequence[int]) -> str:
    """Return the name of an order of agents or items: "agents-1-0-2"."""
    return "-".join(map(str, (name, *order)))


def _moves(order: Order) -> bool:
    """Return whether an order moves something, and refuse what is no order."""
    stay = tuple(range(len(order)))
    if tuple(sorted(order)) != stay:
        raise UserError(f"{order} is not a permutation; write each number from 0 to {len(order) - 1} once")
    return order != stay


def _composed(g: Order | None, h: Order | None) -> Order | None:
    if g is None or h is None:
        return g or h
    if len(g) != len(h):
        raise UserError(f"orders of {len(g)} and of {len(h)} things cannot be composed; give both one length")
    return tuple(g[i] for i in h)


def _undone(order: Order) -> Order:
    return tuple(order.index(i) for i in range(len(order)))
