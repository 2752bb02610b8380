"""What every transform is, whatever it moves. A new kind of transform is one file beside this one: see `plane`."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from esp_envs.errors import UserError
from esp_envs.spec import Field, Items

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Orders = tuple[tuple[str, tuple[int, ...]], ...]
"""Fields by name, each with the place that each of its items moves to."""


class Element(ABC):
    """One transform of a scene: hashable, composable, invertible, and known by how it acts on each field.

    Everything else follows from these members: groups, L_g and K_g, admission, equivariant networks.
    Convention: a product `g @ h` applies h first, hence L_g L_h = L_{gh}.

    Attributes:
        permutation: sigma, with sigma[i] the place that agent i moves to; None where agents stay.
        items: fields whose like items change places, each with the place that item k moves to; sorted by name.
    """

    permutation: tuple[int, ...] | None
    items: Orders = ()

    @property
    @abstractmethod
    def name(self) -> str:
        """The name that `parse_elements` reads."""

    @property
    @abstractmethod
    def order(self) -> tuple[Any, ...]:
        """What the elements of a group are sorted by; smallest for the identity."""

    @property
    @abstractmethod
    def in_place(self) -> Element:
        """The same element with all agents and items in their places."""

    @property
    def orders(self) -> Orders:
        """All that changes places, agents first: (("agents", (1, 0, 2)), ("landmarks", (2, 0, 1)))."""
        return self.items if self.permutation is None else (("agents", self.permutation), *self.items)

    @property
    def participle(self) -> str:
        """How messages say that something was transformed: "turned by 45 degrees"."""
        return f"under {self.in_place.name}"

    @property
    @abstractmethod
    def is_identity(self) -> bool:
        """Whether nothing moves."""

    @abstractmethod
    def __matmul__(self, other: Any) -> Element:
        """Compose: `g @ h` applies h first, then g."""

    @abstractmethod
    def inverse(self) -> Element:
        """Return the element that undoes this one."""

    @abstractmethod
    def block(self, field: Field) -> Floats:
        """Return how each run of d numbers of a field transforms, d dividing the field's width: [d, d], orthogonal.

        Raises:
            UserError: the field cannot be transformed.
        """

    def gather(self, field: Field) -> tuple[Indices, Floats]:
        """Return `block` as a signed permutation: new number k is sign[k] times old number source[k], [d] each.

        Raises:
            UserError: a new number mixes old ones, as a vector's do under other turns than quarters.
        """
        block = self.block(field)
        if not np.array_equal(np.abs(block).sum(-1), np.ones(len(block))) or not np.isin(block, (-1, 0, 1)).all():
            raise UserError(f"a picture turns by quarters alone, but '{field.name}' is to turn by another angle")
        return np.abs(block).argmax(-1), block.sum(-1)


def places_of(elements: Sequence[Element], num_agents: int) -> Indices | None:
    """Return [G, N] the place that each agent moves to under each element, or None where all stay."""
    if all(element.permutation is None for element in elements):
        return None
    stay = tuple(range(num_agents))
    return np.array([element.permutation or stay for element in elements], dtype=np.int64)


def order_name(name: str, places: Sequence[int]) -> str:
    """Return the name of an order of agents or items: "agents-1-0-2"."""
    return "-".join(map(str, (name, *places)))


def item_places(elements: Sequence[Element], field: Field) -> Indices | None:
    """Return [G, count] the place that each item of a field moves to under each element, or None where all stay.

    Raises:
        UserError: the field has another number of items, is a picture, or its items follow the agents.
    """
    name = re.sub(r"^agent\d+\.", "", field.name)  # a joint layout has one field for each agent: "agent0.landmarks"
    orders = [dict(element.items).get(name) for element in elements]
    moved = [order for order in orders if order is not None]
    if not moved:
        return None
    if field.items is not Items.FIXED or field.pixels is not None:
        raise UserError(f"the items of field '{name}' cannot be exchanged: they are the agents', or pictures")
    if any(len(order) != field.count for order in moved):
        raise UserError(f"field '{name}' has {field.count} items, not {len(moved[0])}")
    stay = tuple(range(field.count))
    return np.array([order or stay for order in orders], dtype=np.int64)


def compose_permutations(g: tuple[int, ...] | None, h: tuple[int, ...] | None) -> tuple[int, ...] | None:
    """Return the permutation that applies h first, then g; None moves nothing.

    Raises:
        UserError: the two are of different length.
    """
    if g is None or h is None:
        return g or h
    if len(g) != len(h):
        raise UserError(f"orders of {len(g)} and of {len(h)} things cannot be composed; give both one length")
    return tuple(g[i] for i in h)
