"""What elements do to fields and layouts: linear maps of rows of numbers, stacked over G elements, in float64.

They are sparse, so that a permutation of the pixels of a picture is no matrix of their square. All are orthogonal: an
inverse is a transpose.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from esp_cli.symmetry.elements import Element, Floats, Geometry, Indices, Order
from esp_envs.errors import UserError
from esp_envs.spec import Field, Items, Layout


@dataclass(frozen=True)
class Operator:
    """A linear map of rows of D numbers for each of G elements: new[k] = sum_j weight[k, j] old[source[k, j]].

    Attributes:
        source: [G, D, m] int64; a new number is made of m old ones.
        weight: [G, D, m].
    """

    source: Indices
    weight: Floats

    @classmethod
    def of_block(cls, block: Floats | Indices) -> Operator:
        """Return the operator of one block, as `Geometry.block` gives it."""
        if block.ndim == 1:
            return cls.reordering(np.asarray(block, dtype=np.int64)[None])
        most = max(1, np.count_nonzero(block, axis=1).max(initial=0))
        source = np.argsort(block == 0, axis=1, kind="stable")[None, :, :most]
        return cls(source, np.take_along_axis(np.asarray(block, dtype=np.float64)[None], source, 2))

    @classmethod
    def reordering(cls, order: Indices) -> Operator:
        """Return the operator that puts old number order[g, k] at place k: [G, D]."""
        return cls(order[:, :, None], np.ones((*order.shape, 1)))

    @classmethod
    def beside(cls, parts: Sequence[Operator], num_elements: int) -> Operator:
        """Return the operator of rows laid end to end, each with its own."""
        starts = np.cumsum([0, *(part.width for part in parts)])
        shape = (num_elements, starts[-1], max((part.terms for part in parts), default=1))
        source, weight = np.zeros(shape, dtype=np.int64), np.zeros(shape)
        for part, start in zip(parts, starts, strict=False):
            where = np.s_[:, start : start + part.width, : part.terms]
            source[where], weight[where] = part.source + start, part.weight
        return cls(source, weight)

    @classmethod
    def stacked(cls, parts: Sequence[Operator]) -> Operator:
        """Return the operators of some elements, one after the other."""
        shape = (len(parts), parts[0].width, max(part.terms for part in parts))
        source, weight = np.zeros(shape, dtype=np.int64), np.zeros(shape)
        for g, part in enumerate(parts):
            source[g, :, : part.terms], weight[g, :, : part.terms] = part.source[0], part.weight[0]
        return cls(source, weight)

    @property
    def terms(self) -> int:
        """m; 1 where numbers only change places and signs."""
        return self.source.shape[2]

    @property
    def width(self) -> int:
        """D."""
        return self.source.shape[1]

    @property
    def matrix(self) -> Floats:
        """The same as matrices [G, D, D]."""
        out = np.zeros((len(self.source), self.width, self.width))
        elements, rows = np.arange(len(self.source))[:, None, None], np.arange(self.width)[:, None]
        np.add.at(out, (elements, rows, self.source), self.weight)
        return out

    def push(self, rows: Floats) -> Floats:
        """Apply it to rows [D]: [G, D]."""
        return (self.weight * rows[self.source]).sum(-1)

    def after(self, first: Operator) -> Operator:
        """Return the product that applies `first`, then this."""
        elements, shape = np.arange(len(self.source))[:, None, None], (len(self.source), self.width, -1)
        source, weight = first.source[elements, self.source], first.weight[elements, self.source]
        return Operator(source.reshape(shape), (self.weight[..., None] * weight).reshape(shape))

    def ordered(self, order: Indices) -> Operator:
        """Return this operator followed by another order of its results: place k takes result order[g, k]."""
        index = order[:, :, None]
        return Operator(np.take_along_axis(self.source, index, 1), np.take_along_axis(self.weight, index, 1))

    def repeated(self, count: int) -> Operator:
        """Return the operator of `count` rows laid end to end, all with this one."""
        starts = self.width * np.arange(count)[:, None, None]
        shape = (len(self.source), count * self.width, self.terms)
        return Operator((self.source[:, None] + starts).reshape(shape), np.tile(self.weight, (1, count, 1)))

    def selected(self, index: Sequence[int]) -> Operator:
        """Return the operators at some places of the stack."""
        return Operator(self.source[index], self.weight[index])


def item_operator(field: Field, elements: Sequence[Element]) -> Operator:
    """Return how the numbers of one item of a field transform, with all things in their places.

    Raises:
        UserError: a geometry cannot transform the field, or two do not commute on it.
    """
    geometries = list(dict.fromkeys(element.geometry for element in elements))
    index = [geometries.index(element.geometry) for element in elements]
    if field.parts:
        return layout_operator(Layout(field.parts), [Element(geometry) for geometry in geometries]).selected(index)
    return Operator.stacked([_item_operator(field, geometry) for geometry in geometries]).selected(index)


def _item_operator(field: Field, geometry: tuple[Geometry, ...]) -> Operator:
    """Return how one item transforms under one of each kind of geometry, G = 1."""
    whole = Operator.reordering(np.arange(field.item_width)[None])
    for one in geometry:
        part = Operator.of_block(one.block(field))
        if part.width != field.item_width:
            raise UserError(
                f"{one.name} transforms {part.width} numbers of field '{field.name}', but an item of it has "
                f"{field.item_width}"
            )
        probe = np.random.default_rng(0).normal(size=field.item_width)
        if not np.allclose(part.push(whole.push(probe)[0]), whole.push(part.push(probe)[0])):
            names = " and ".join(g.name for g in geometry)
            raise UserError(f"{names} do not commute on field '{field.name}', so their product is no symmetry")
        whole = part.after(whole)
    return whole


def field_operator(field: Field, elements: Sequence[Element]) -> Operator:
    """Return how a field transforms: each of its items, and their order.

    Raises:
        UserError: an element cannot transform it.
    """
    items, places = item_operator(field, elements).repeated(field.count), item_places(field, elements)
    return items if places is None else items.ordered(numbers_of(np.argsort(places, axis=1), field.item_width))


def layout_operator(layout: Layout, elements: Sequence[Element]) -> Operator:
    """Return L_g of a layout of D numbers, field by field, with all agents in their places."""
    return Operator.beside([field_operator(field, elements) for field in layout.fields], len(elements))


def item_places(field: Field, elements: Sequence[Element]) -> Indices | None:
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
    return order_array(orders, field.count)


def order_array(orders: Sequence[Order | None], count: int) -> Indices:
    """Return orders of so many things as an array; None moves nothing."""
    return np.array([order or tuple(range(count)) for order in orders], dtype=np.int64)


def numbers_of(slots: Indices, width: int) -> Indices:
    """Expand item indices [..., count] to number indices [..., count * width]."""
    return (slots[..., None] * width + np.arange(width)).reshape(*slots.shape[:-1], -1)
