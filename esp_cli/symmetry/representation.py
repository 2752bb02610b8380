"""What elements do to the numbers of a task: observations and states to L_g, actions to K_g.

Layouts say how the numbers of one row transform; here agents change places too. What cannot is refused.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from esp_cli.symmetry.elements import Element, Floats, Geometry, Indices, Order
from esp_envs.errors import UserError
from esp_envs.spec import Discrete, Field, Items, Layout, Spaces, others_of

_MATCH_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Operator:
    """A linear map of rows of D numbers for each of G elements: new[k] = sum_j weight[k, j] old[source[k, j]]."""

    source: Indices  # [G, D, m] int64; a new number is made of m old ones
    weight: Floats  # [G, D, m]

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
    def moving(cls, places: Indices) -> Operator:
        """Return the operator that puts old number k at place places[g, k]: [G, D]."""
        return cls.reordering(np.argsort(places, axis=1))

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

    @property
    def terms(self) -> int:
        """m; 1 where numbers only change places and signs."""
        return self.source.shape[2]

    @property
    def width(self) -> int:
        return self.source.shape[1]

    @property
    def matrix(self) -> Floats:
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
        return Operator.beside([self] * count, len(self.source))

    def selected(self, index: Sequence[int]) -> Operator:
        return Operator(self.source[index], self.weight[index])

    @property
    def is_identity(self) -> bool:
        """Whether every number stays as it is, for all elements."""
        stays = self.source == np.arange(self.width)[:, None]
        return bool((np.where(stays, self.weight, 0).sum(2) == 1).all()) and not self.weight[~stays].any()


def rows_operator(layout: Layout, elements: Sequence[Element], num_agents: int) -> Operator:
    """Return L_g of an agent's row of D numbers, or where agents move of all N rows end to end.

    Row i moves to row sigma(i). Inside a row, items that count over OTHERS or over AGENTS are reordered so that each
    keeps describing the agent that it described before.
    """
    row, places = layout_operator(layout, elements), agent_places(elements, num_agents)
    return row if places is None else row.repeated(num_agents).ordered(joint_sources(layout, places))


def state_operator(spaces: Spaces, elements: Sequence[Element]) -> Operator:
    """Return L_g of the global state of Ds numbers."""
    places = agent_places(elements, spaces.num_agents)
    rows = spaces.joint_fields
    if places is None or rows is None:
        return _numbers_operator(spaces.state, elements, places)
    around = [Layout(spaces.state.fields[part]) for part in (slice(rows.start), slice(rows.stop, None))]
    before, after = (_numbers_operator(part, elements, places) for part in around)
    own = rows_operator(spaces.observation, elements, spaces.num_agents)
    return Operator.beside([before, own, after], len(elements))


def _numbers_operator(layout: Layout, elements: Sequence[Element], places: Indices | None) -> Operator:
    """Return L_g of numbers of a state that are not the agents' rows; items of AGENTS follow them."""
    part = layout_operator(layout, elements)
    if places is None or not layout.fields:
        return part
    if field := next((field for field in layout.fields if field.items is Items.OTHERS), None):
        raise UserError(f"state field '{field.name}' counts others, but a state has no observer; count agents")
    return part.ordered(_sources(layout, np.argsort(places, axis=1)[:, None])[:, 0])


def output_operator(spaces: Spaces, elements: Sequence[Element]) -> Operator:
    """Return K_g of one number per discrete action, or of a continuous action, of all agents where they move."""
    action, places = spaces.action, agent_places(elements, spaces.num_agents)
    if not isinstance(action, Discrete):
        return rows_operator(action.layout, elements, spaces.num_agents)
    row = Operator.moving(action_map(action, elements))
    if places is None:
        return row
    return row.repeated(spaces.num_agents).ordered(numbers_of(np.argsort(places, axis=1), action.count))


def action_map(action: Discrete, elements: Sequence[Element]) -> Indices:
    """Return K_g of a discrete action space [G, A]: entry [g, j] is the action that means what j means, turned.

    Of several actions with one meaning the first goes to the first, the second to the second.
    """
    points = np.array(action.points, dtype=np.float64)
    images = np.einsum("gvw,jw->gjv", item_operator(Field("action", action.kind), elements).matrix, points)
    same = np.abs(points[:, None, :] - points).max(axis=-1) <= _MATCH_TOLERANCE
    place = np.tril(same, -1).sum(axis=1)  # among the actions of its meaning
    distance = np.abs(images[:, :, None, :] - points).max(axis=-1)
    distance += np.where(place[:, None] == place, 0.0, np.inf)
    nearest: Indices = distance.argmin(axis=-1)
    missed = np.argwhere(distance.min(axis=-1) > _MATCH_TOLERANCE)
    if len(missed):
        g, j = missed[0]
        raise UserError(f"action '{action.names[j]}' {elements[g].participle} is no action")
    return nearest


def layout_operator(layout: Layout, elements: Sequence[Element]) -> Operator:
    """Return L_g of a layout of D numbers, field by field, with all agents in their places."""
    return Operator.beside([field_operator(field, elements) for field in layout.fields], len(elements))


def field_operator(field: Field, elements: Sequence[Element]) -> Operator:
    """Return how a field transforms: each of its items, and their order; refuse one that cannot."""
    items, places = item_operator(field, elements).repeated(field.count), item_places(field, elements)
    return items if places is None else items.ordered(numbers_of(np.argsort(places, axis=1), field.item_width))


def item_operator(field: Field, elements: Sequence[Element]) -> Operator:
    """Return how the numbers of one item of a field transform, with all things in their places."""
    geometries = dict.fromkeys(element.geometry for element in elements)
    place = {geometry: i for i, geometry in enumerate(geometries)}
    index = [place[element.geometry] for element in elements]
    if field.parts:
        parts = layout_operator(Layout(field.parts), [Element(geometry) for geometry in geometries]).selected(index)
        if field.pixels is None:
            return parts
        pixels = item_operator(replace(field, parts=()), elements).source[..., 0]
        return parts.repeated(pixels.shape[1]).ordered(numbers_of(pixels, parts.width))
    each = [_item_operator(field, geometry) for geometry in geometries]
    shape = (len(each), field.item_width, max(one.terms for one in each))
    source, weight = np.zeros(shape, dtype=np.int64), np.zeros(shape)
    for k, one in enumerate(each):
        source[k, :, : one.terms], weight[k, :, : one.terms] = one.source[0], one.weight[0]
    return Operator(source, weight).selected(index)


@lru_cache(maxsize=4096)  # building a learner asks for the same few again and again
def _item_operator(field: Field, geometry: tuple[Geometry, ...]) -> Operator:
    stays = whole = Operator.reordering(np.arange(field.item_width)[None])
    for one in geometry:
        part = Operator.of_block(one.block(field))
        if part.width != field.item_width:
            raise UserError(
                f"{one.name} transforms {part.width} numbers of field '{field.name}', but an item of it has "
                f"{field.item_width}"
            )
        if whole is stays:
            whole = part
            continue
        probe = np.random.default_rng(0).normal(size=field.item_width)
        if not np.allclose(part.push(whole.push(probe)[0]), whole.push(part.push(probe)[0])):
            names = " and ".join(g.name for g in geometry)
            raise UserError(f"{names} do not commute on field '{field.name}', so their product is no symmetry")
        whole = part.after(whole)
    return whole


def item_places(field: Field, elements: Sequence[Element]) -> Indices | None:
    """Return [G, count] the place that each item of a field moves to under each element, or None where all stay."""
    # a joint layout has one field for each agent: "agent0.landmarks", of another role "prey.agent0.landmarks"
    name = re.sub(r"^(\w+\.)?agent\d+\.", "", field.name)
    orders = [dict(element.items).get(name) for element in elements]
    moved = [order for order in orders if order is not None]
    if moved and (field.items is not Items.FIXED or field.pixels is not None):
        raise UserError(f"the items of field '{name}' cannot be exchanged: they are the agents', or pictures")
    if any(len(order) != field.count for order in moved):
        raise UserError(f"field '{name}' has {field.count} items, not {len(moved[0])}")
    return _order_array(orders, field.count)


def agent_places(elements: Sequence[Element], num_agents: int) -> Indices | None:
    """Return [G, N] the place that each agent moves to under each element, or None where all stay."""
    orders = [element.permutation for element in elements]
    if any(order and len(order) != num_agents for order in orders):
        raise UserError(f"the permutation is not one of its {num_agents} agents")
    return _order_array(orders, num_agents)


def _order_array(orders: Sequence[Order | None], count: int) -> Indices | None:
    return np.array([order or range(count) for order in orders], dtype=np.int64) if any(orders) else None


def require_items(elements: Sequence[Element], spaces: Spaces) -> None:
    """Refuse orders of the items of fields that neither an observation nor an action has."""
    acted = () if isinstance(spaces.action, Discrete) else spaces.action.layout.fields
    known = list(dict.fromkeys(field.name for field in (*spaces.observation.fields, *acted)))
    for name in dict.fromkeys(name for element in elements for name, _ in element.items):
        if name not in known:
            raise UserError(f"{spaces.label} has no field '{name}', but {', '.join(known)}")


def joint_sources(layout: Layout, places: Indices) -> Indices:
    """Return [G, N * D]: the old place of each number of all rows end to end when only agents move (to `places`)."""
    came_from = np.argsort(places, axis=1)
    observers = np.broadcast_to(came_from[:, None], (*came_from.shape, came_from.shape[1]))
    within = _sources(layout, observers)
    return (within + came_from[:, :, None] * layout.width).reshape(len(places), -1)


def _sources(layout: Layout, came_from: Indices) -> Indices:
    """Return [G, R, D]: the old place of each number in its row, see `_old_slots`."""
    starts = np.cumsum([0, *(field.width for field in layout.fields)])
    slots = [(field, _old_slots(field, came_from)) for field in layout.fields]
    numbers = [start + numbers_of(old, field.item_width) for start, (field, old) in zip(starts, slots, strict=False)]
    return np.concatenate(numbers, axis=-1)


def _old_slots(field: Field, came_from: Indices) -> Indices:
    """Return [G, R, count]: for each new row and item, the item of the old row that holds the same thing.

    `came_from` [G, R, N] says who stood where each agent now stands, for each row; of OTHERS, row i is agent i's.
    """
    num_agents = came_from.shape[2]
    if field.items is Items.FIXED:
        return np.broadcast_to(np.arange(field.count), (*came_from.shape[:2], field.count))
    what, expected = ("agents", num_agents) if field.items is Items.AGENTS else ("other agents", num_agents - 1)
    if field.count != expected:
        raise UserError(f"field '{field.name}' has {field.count} items for {expected} {what}; give it one for each")
    if field.items is Items.AGENTS:
        return came_from
    others = np.array(others_of(num_agents), dtype=np.int64).reshape(num_agents, -1)
    described = np.take_along_axis(came_from, np.broadcast_to(others, (len(came_from), *others.shape)), 2)
    # The observer is left out of its own list, so agents after it sit one slot earlier.
    return described - (described > np.diagonal(came_from, axis1=1, axis2=2)[:, :, None])


def numbers_of(slots: Indices, width: int) -> Indices:
    """Expand item indices [..., count] to number indices [..., count * width]."""
    return (slots[..., None] * width + np.arange(width)).reshape(*slots.shape[:-1], -1)
