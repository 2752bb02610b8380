"""What elements do to numbers: layouts to L_g, action spaces to K_g, as matrices or as signed permutations.

Everything is stacked over G elements; float64 throughout. All matrices are orthogonal, so an inverse is a transpose.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from esp_cli.symmetry.elements import Element, Floats, Indices, item_places, places_of
from esp_envs.errors import UserError
from esp_envs.spec import Discrete, Field, Items, Layout, Spaces, others_of

_MATCH_TOLERANCE = 1e-6


def block_matrix(field: Field, elements: Sequence[Element]) -> Floats:
    """Return how each run of d numbers of a field transforms, d dividing its width: [G, d, d].

    Where items change places, the run is the whole field.
    """
    if field.parts:
        item = layout_matrix(Layout(field.parts), [element.in_place for element in elements])
    else:
        item = np.stack([element.block(field) for element in elements])
    places = item_places(elements, field)
    if places is None:
        return item
    came_from = np.eye(field.count)[np.argsort(places, axis=1)]
    each = np.kron(np.eye(field.item_width // item.shape[-1]), item)  # one item may be several runs
    return np.einsum("gkm,gde->gkdme", came_from, each).reshape(len(elements), field.width, field.width)


def layout_matrix(layout: Layout, elements: Sequence[Element]) -> Floats:
    """Return L_g of a layout of D numbers, block by block, with all agents in their places: [G, D, D]."""
    out = np.zeros((len(elements), layout.width, layout.width))
    start = 0
    for field in layout.fields:
        block = block_matrix(field, elements)
        width, end = block.shape[-1], start + field.width
        for first in range(start, end, width):
            out[:, first : first + width, first : first + width] = block
        start = end
    return out


def joint_matrix(layout: Layout, elements: Sequence[Element], places: Indices) -> Floats:
    """Return L_g of all agents' rows laid end to end: row i is transformed and moves to row sigma(i).

    Inside a row, items that count over OTHERS or over AGENTS are reordered so that each keeps describing the agent
    that it described before.

    Args:
        layout: one agent's row, D numbers.
        elements: G of them.
        places: [G, N], places[g, i] = sigma_g(i).

    Returns:
        [G, N * D, N * D].
    """
    num_agents = places.shape[1]
    row = layout_matrix(layout, elements)
    blocks = np.einsum("nm,gde->gndme", np.eye(num_agents), row)
    width = num_agents * layout.width
    source = joint_sources(layout, places)
    return np.take_along_axis(blocks.reshape(-1, width, width), source[:, :, None], axis=1)


def rows_matrix(layout: Layout, elements: Sequence[Element], num_agents: int) -> Floats:
    """Return `joint_matrix` where agents move, else `layout_matrix`, the same for every agent's row."""
    places = places_of(elements, num_agents)
    return layout_matrix(layout, elements) if places is None else joint_matrix(layout, elements, places)


def layout_permutation(layout: Layout, elements: Sequence[Element]) -> tuple[Indices, Floats]:
    """Return `layout_matrix` as a signed permutation: source and sign, [G, D] each; see `rows_permutation`."""
    sources, signs, start = [], [], 0
    for field in layout.fields:
        source, sign = _signed_permutations(field, elements)
        runs = field.width // source.shape[1]
        first = start + source.shape[1] * np.arange(runs)[:, None]
        sources.append((source[:, None, :] + first).reshape(len(elements), -1))
        signs.append(np.tile(sign, (1, runs)))
        start += field.width
    return np.concatenate(sources, 1), np.concatenate(signs, 1)


def rows_permutation(layout: Layout, elements: Sequence[Element], num_agents: int) -> tuple[Indices, Floats]:
    """Return L_g as a signed permutation: the new number k is sign[k] times the old number source[k].

    The same as `rows_matrix`, whose square grows too large with pictures.

    Returns:
        source and sign, [G, D] each, or [G, N * D] where agents move.

    Raises:
        UserError: an item mixes its numbers, as a vector does under other turns than quarters.
    """
    within, sign = layout_permutation(layout, elements)
    places = places_of(elements, num_agents)
    if places is None:
        return within, sign
    joint = (within[:, None, :] + layout.width * np.arange(num_agents)[:, None]).reshape(len(elements), -1)
    return _reordered(joint, np.tile(sign, (1, num_agents)), joint_sources(layout, places))


def _reordered(source: Indices, sign: Floats, order: Indices) -> tuple[Indices, Floats]:
    """Return a signed permutation [G, D] followed by another order of its results."""
    return np.take_along_axis(source, order, 1), np.take_along_axis(sign, order, 1)


def _signed_permutations(field: Field, elements: Sequence[Element]) -> tuple[Indices, Floats]:
    """Return source and sign of each run of d numbers of a field, [G, d] each; see `block_matrix`."""
    if field.parts:
        source, sign = layout_permutation(Layout(field.parts), [element.in_place for element in elements])
    else:
        gathered = zip(*(element.gather(field) for element in elements), strict=True)
        source, sign = (np.stack(part) for part in gathered)
    places = item_places(elements, field)
    if places is None:
        return source, sign
    first = field.item_width * np.argsort(places, axis=1)
    runs = np.arange(0, field.item_width, source.shape[1])
    item = (source[:, None, :] + runs[:, None]).reshape(len(elements), -1)
    whole = (first[:, :, None] + item[:, None, :]).reshape(len(elements), -1)
    return whole, np.tile(sign, (1, field.width // sign.shape[1]))


def state_matrix(spaces: Spaces, elements: Sequence[Element]) -> Floats:
    """Return L_g of the global state [G, Ds, Ds].

    A state that is `joint_layout` of the observation moves like the joint observation; any other moves its AGENTS
    items.

    Raises:
        UserError: agents move, and a field's items cannot follow them.
    """
    places = places_of(elements, spaces.num_agents)
    if places is None:
        return layout_matrix(spaces.state, elements)
    if spaces.is_joint:
        return joint_matrix(spaces.observation, elements, places)
    order = state_sources(spaces.state, places)
    return np.take_along_axis(layout_matrix(spaces.state, elements), order[:, :, None], axis=1)


def state_permutation(spaces: Spaces, elements: Sequence[Element]) -> tuple[Indices, Floats]:
    """Return `state_matrix` as a signed permutation: source and sign, [G, Ds] each; see `rows_permutation`."""
    places = places_of(elements, spaces.num_agents)
    if places is not None and spaces.is_joint:
        return rows_permutation(spaces.observation, elements, spaces.num_agents)
    source, sign = layout_permutation(spaces.state, elements)
    return (source, sign) if places is None else _reordered(source, sign, state_sources(spaces.state, places))


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
    images = np.einsum(
        "gvw,jw->gjv", block_matrix(Field("action", action.kind), [e.in_place for e in elements]), points
    )
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
