"""What elements do to the numbers of a task: observations and states to L_g, actions to K_g.

Layouts say how the numbers of one row transform; here agents change places too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from esp_cli.symmetry.elements import Element, Indices
from esp_cli.symmetry.operators import Operator, item_operator, layout_operator, numbers_of, order_array
from esp_envs.errors import UserError
from esp_envs.spec import Discrete, Field, Items, Layout, Spaces, others_of

_MATCH_TOLERANCE = 1e-6


def agent_places(elements: Sequence[Element], num_agents: int) -> Indices | None:
    """Return [G, N] the place that each agent moves to under each element, or None where all stay."""
    orders = [element.permutation for element in elements]
    return None if not any(orders) else order_array(orders, num_agents)


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
    row, places = layout_operator(layout, elements), agent_places(elements, num_agents)
    return row if places is None else _reordered(row.repeated(num_agents), joint_sources(layout, places))


def state_operator(spaces: Spaces, elements: Sequence[Element]) -> Operator:
    """Return L_g of the global state of Ds numbers.

    A state that is `joint_layout` of the observation moves like the joint observation; any other moves its AGENTS
    items.

    Raises:
        UserError: agents move, and a field's items cannot follow them.
    """
    places = agent_places(elements, spaces.num_agents)
    if places is not None and spaces.is_joint:
        return rows_operator(spaces.observation, elements, spaces.num_agents)
    state = layout_operator(spaces.state, elements)
    return state if places is None else _reordered(state, state_sources(spaces.state, places))


def output_operator(spaces: Spaces, elements: Sequence[Element]) -> Operator:
    """Return K_g of one number per discrete action, or of a continuous action, of all agents where they move."""
    action, places = spaces.action, agent_places(elements, spaces.num_agents)
    if not isinstance(action, Discrete):
        return rows_operator(action.layout, elements, spaces.num_agents)
    row = Operator.reordering(np.argsort(action_map(action, elements), axis=1))
    if places is None:
        return row
    return _reordered(row.repeated(spaces.num_agents), numbers_of(np.argsort(places, axis=1), action.count))


def _reordered(rows: Operator, sources: Indices) -> Operator:
    """Return an operator whose results then change places as agents do."""
    return rows.ordered(sources)


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


def field_names(spaces: Spaces) -> list[str]:
    """Return the names of the fields whose items an order may name: those of the observation and of the action."""
    acted = () if isinstance(spaces.action, Discrete) else spaces.action.layout.fields
    return list(dict.fromkeys(field.name for field in (*spaces.observation.fields, *acted)))


def state_sources(layout: Layout, places: Indices) -> Indices:
    """Return [G, Ds]: where each number of a state comes from when its AGENTS items follow the agents.

    Args:
        layout: of the state.
        places: [G, N], places[g, i] = sigma_g(i).

    Raises:
        UserError: a field's items cannot follow the agents.
    """
    came_from = np.argsort(places, axis=1)
    for field in layout.fields:
        if field.items is Items.OTHERS:
            raise UserError(f"state field '{field.name}' counts others, but a state has no observer; count agents")
    return _sources(layout, [_old_slots(field, came_from[:, None])[:, 0] for field in layout.fields])


def joint_sources(layout: Layout, places: Indices) -> Indices:
    """Return [G, N * D]: the old place of each number of all rows end to end when only agents move (to `places`)."""
    came_from = np.argsort(places, axis=1)
    observers = np.broadcast_to(came_from[:, None], (*came_from.shape, came_from.shape[1]))
    within = _sources(layout, [_old_slots(field, observers) for field in layout.fields])
    return (within + came_from[:, :, None] * layout.width).reshape(len(places), -1)


def _sources(layout: Layout, slots: Sequence[Indices]) -> Indices:
    """Return [..., D] the old place of each number, of each field's old items [..., count]."""
    numbers, start = [], 0
    for field, old in zip(layout.fields, slots, strict=True):
        numbers.append(start + numbers_of(old, field.item_width))
        start += field.width
    return np.concatenate(numbers, axis=-1)


def _old_slots(field: Field, came_from: Indices) -> Indices:
    """Return [G, R, count]: for each new row and item, the item of the old row that holds the same thing.

    Args:
        field: of a row.
        came_from: [G, R, N] who stood where each agent now stands, for each row; of OTHERS, row i is agent i's.
    """
    num_agents = came_from.shape[2]
    if field.items is Items.FIXED:
        return np.broadcast_to(np.arange(field.count), (*came_from.shape[:2], field.count))
    if field.items is Items.AGENTS:
        _require_count(field, num_agents)
        return came_from
    _require_count(field, num_agents - 1)
    others = np.array(others_of(num_agents), dtype=np.int64).reshape(num_agents, -1)
    described = np.take_along_axis(came_from, np.broadcast_to(others, (len(came_from), *others.shape)), 2)
    # The observer is left out of its own list, so agents after it sit one slot earlier.
    return described - (described > np.diagonal(came_from, axis1=1, axis2=2)[:, :, None])


def _require_count(field: Field, expected: int) -> None:
    if field.count != expected:
        what = "other agents" if field.items is Items.OTHERS else "agents"
        raise UserError(f"field '{field.name}' has {field.count} items for {expected} {what}; give it one for each")
