"""What elements do to numbers: layouts to L_g, action spaces to K_g, as one operator on rows of numbers.

Everything is stacked over G elements, in float64. All operators are orthogonal, so an inverse is a transpose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from esp_cli.symmetry.elements import Element, Floats, Geometry, Indices, item_places, places_of
from esp_envs.errors import UserError
from esp_envs.spec import Discrete, Field, Items, Layout, Spaces, others_of

_MATCH_TOLERANCE = 1e-6


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
    items, places = item_operator(field, elements).repeated(field.count), item_places(elements, field)
    return items if places is None else items.ordered(_numbers(np.argsort(places, axis=1), field.item_width))


def layout_operator(layout: Layout, elements: Sequence[Element]) -> Operator:
    """Return L_g of a layout of D numbers, field by field, with all agents in their places."""
    return Operator.beside([field_operator(field, elements) for field in layout.fields], len(elements))


def rows_operator(layout: Layout, elements: Sequence[Element], num_agents: int) -> Operator:
    """Return L_g of an agent's row, or where agents move of all rows end to end: row i moves to row sigma(i).

    Inside a row, items that count over OTHERS or over AGENTS are reordered so that each keeps describing the agent
    that it described before.

    Args:
        layout: one agent's row, D numbers.
        elements: G of them.
        num_agents: N.

    Returns:
        An operator on D or on N D numbers.
    """
    row, places = layout_operator(layout, elements), places_of(elements, num_agents)
    return row if places is None else row.repeated(num_agents).ordered(joint_sources(layout, places))


def state_operator(spaces: Spaces, elements: Sequence[Element]) -> Operator:
    """Return L_g of the global state of Ds numbers.

    A state that is `joint_layout` of the observation moves like the joint observation; any other moves its AGENTS
    items.

    Raises:
        UserError: agents move, and a field's items cannot follow them.
    """
    places = places_of(elements, spaces.num_agents)
    if places is not None and spaces.is_joint:
        return rows_operator(spaces.observation, elements, spaces.num_agents)
    state = layout_operator(spaces.state, elements)
    return state if places is None else state.ordered(state_sources(spaces.state, places))


def output_operator(spaces: Spaces, elements: Sequence[Element]) -> Operator:
    """Return K_g of one number per discrete action, or of a continuous action, of all agents where they move."""
    if not isinstance(spaces.action, Discrete):
        return rows_operator(spaces.action.layout, elements, spaces.num_agents)
    row, places = np.argsort(action_map(spaces.action, elements), axis=1), places_of(elements, spaces.num_agents)
    each = Operator.reordering(row)
    if places is None:
        return each
    return each.repeated(spaces.num_agents).ordered(_numbers(np.argsort(places, axis=1), spaces.action.count))


def action_map(action: Discrete, elements: Sequence[Element]) -> Indices:
    """Return K_g of a discrete action space: entry [g, j] is the action that j becomes.

    It is derived by turning each action's physical meaning and looking for the action that means the result. Of
    several actions with one meaning the first goes to the first, the second to the second.

    Returns:
        [G, A].

    Raises:
        UserError: some action's image is no action.
    """
    points = np.array(action.points, dtype=np.float64)
    turned = item_operator(Field("action", action.kind), elements)
    images = np.einsum("gvw,jw->gjv", turned.matrix, points)
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


def field_names(spaces: Spaces) -> list[str]:
    """Return the names of the fields whose items an order may name: those of the observation and of the action."""
    seen = [field.name for field in spaces.observation.fields]
    acted = () if isinstance(spaces.action, Discrete) else spaces.action.layout.fields
    return list(dict.fromkeys((*seen, *(field.name for field in acted))))


def state_sources(layout: Layout, places: Indices) -> Indices:
    """Return [G, Ds]: where each number of a state comes from when its AGENTS items follow the agents.

    Args:
        layout: of the state.
        places: [G, N], places[g, i] = sigma_g(i).

    Raises:
        UserError: a field's items cannot follow the agents.
    """
    came_from = np.argsort(places, axis=1)
    group, num_agents = places.shape
    sources, start = [], 0
    for field in layout.fields:
        slots = np.broadcast_to(np.arange(field.count), (group, field.count))
        if field.items is Items.AGENTS:
            _require_count(field, num_agents)
            slots = came_from
        elif field.items is Items.OTHERS:
            raise UserError(f"state field '{field.name}' counts others, but a state has no observer; count agents")
        sources.append(start + _numbers(slots, field.item_width))
        start += field.width
    return np.concatenate(sources, axis=1)


def joint_sources(layout: Layout, places: Indices) -> Indices:
    """Return [G, N * D]: the old place of each number of all rows end to end when only agents move (to `places`)."""
    group, num_agents = places.shape
    came_from = np.argsort(places, axis=1)
    sources, start = [], 0
    for field in layout.fields:
        slots = _old_slots(field, came_from)
        numbers = _numbers(slots.reshape(group * num_agents, -1), field.item_width)
        sources.append(start + numbers.reshape(group, num_agents, -1))
        start += field.width
    within = np.concatenate(sources, axis=2)
    return (within + came_from[:, :, None] * layout.width).reshape(group, -1)


def _old_slots(field: Field, came_from: Indices) -> Indices:
    """Return [G, N, count]: for each new row and item, the item of the old row that holds the same thing."""
    group, num_agents = came_from.shape
    shape = (group, num_agents, field.count)
    if field.items is Items.FIXED:
        return np.broadcast_to(np.arange(field.count), shape)
    if field.items is Items.AGENTS:
        _require_count(field, num_agents)
        return np.broadcast_to(came_from[:, None, :], shape)
    _require_count(field, num_agents - 1)
    others = np.array(others_of(num_agents), dtype=np.int64)
    described = came_from[:, others.reshape(num_agents, -1)]
    # The observer is left out of its own list, so agents after it sit one slot earlier.
    return described - (described > came_from[:, :, None])


def _numbers(slots: Indices, width: int) -> Indices:
    """Expand item indices [G, count] to number indices [G, count * width]."""
    return (slots[:, :, None] * width + np.arange(width)).reshape(slots.shape[0], -1)


def _require_count(field: Field, expected: int) -> None:
    if field.count != expected:
        what = "other agents" if field.items is Items.OTHERS else "agents"
        raise UserError(f"field '{field.name}' has {field.count} items for {expected} {what}; give it one for each")
