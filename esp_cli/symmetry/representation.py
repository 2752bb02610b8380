"""What an element does to numbers: field kinds to matrices, layouts to L_g, action spaces to K_g.

Everything is batched over a stack of G elements, given by their planar matrices [G, 2, 2] and the places that their
agents move to [G, N]; float64 throughout. All matrices are orthogonal, so an inverse is a transpose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from esp_cli.symmetry.elements import Element
from esp_envs.spec import Discrete, Field, Items, Kind, Layout, TaskSpec, joint_layout

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

_MATCH_TOLERANCE = 1e-6


def _scalar(planar: Floats) -> Floats:
    return np.ones((*planar.shape[:-2], 1, 1))


def _pseudoscalar(planar: Floats) -> Floats:
    # Round: the determinant of an orthogonal matrix is +1 or -1.
    sign: Floats = np.rint(np.linalg.det(planar))
    return sign[..., None, None]


def _vector(planar: Floats) -> Floats:
    return planar


def _wheels(planar: Floats) -> Floats:
    kept = (_pseudoscalar(planar) + 1) / 2
    swapped = np.array([[0.0, 1.0], [1.0, 0.0]])
    return np.asarray(kept * np.eye(2) + (1 - kept) * swapped)


KIND_MATRICES: dict[Kind, Callable[[Floats], Floats]] = {
    Kind.SCALAR: _scalar,
    Kind.PSEUDOSCALAR: _pseudoscalar,
    Kind.VECTOR: _vector,
    Kind.WHEELS: _wheels,
}
"""One representation per field kind, pictures apart: planar matrices [G, 2, 2] to [G, width, width]."""


def kind_matrix(kind: Kind, planar: Floats) -> Floats:
    """Return how one item of a kind transforms.

    Args:
        kind: what the item is.
        planar: orthogonal matrices [..., 2, 2].

    Returns:
        [..., kind.width, kind.width].
    """
    return KIND_MATRICES[kind](planar)


def picture_sources(pixels: tuple[int, int], planar: Floats) -> Indices:
    """Return where each pixel of a transformed picture comes from.

    A pixel's place is its middle's (x, y), seen from the picture's: the first row is the top, the first column left.

    Args:
        pixels: rows and columns.
        planar: [G, 2, 2].

    Returns:
        [G, rows * columns], the index of the old pixel that shows in each new one.

    Raises:
        ValueError: some pixel would come to lie between others, or outside.
    """
    rows, columns = pixels
    row, column = np.divmod(np.arange(rows * columns), columns)
    place = np.stack([column - (columns - 1) / 2, (rows - 1) / 2 - row], -1)
    origin = np.einsum("gji,pj->gpi", planar, place)  # the inverse is the transpose
    old_column, old_row = origin[..., 0] + (columns - 1) / 2, (rows - 1) / 2 - origin[..., 1]
    whole = np.rint(np.stack([old_row, old_column], -1))
    fits = np.abs(whole - np.stack([old_row, old_column], -1)).max() < _MATCH_TOLERANCE
    if not fits or (whole < 0).any() or (whole >= [rows, columns]).any():
        raise ValueError(f"the pixels of a picture of {rows} x {columns} do not come to lie on pixels")
    return (whole[..., 0] * columns + whole[..., 1]).astype(np.int64)


def item_matrix(field: Field, planar: Floats) -> Floats:
    """Return how one item of a field transforms: [G, item width, item width]."""
    if field.pixels is None:
        return kind_matrix(field.kind, planar)
    sources = picture_sources(field.pixels, planar)
    return np.take(np.eye(field.item_width), sources, axis=0)


def layout_matrix(layout: Layout, planar: Floats) -> Floats:
    """Return L_g of a layout, one block per item, with all agents in their places.

    Args:
        layout: D numbers.
        planar: [G, 2, 2].

    Returns:
        [G, D, D].
    """
    out = np.zeros((planar.shape[0], layout.width, layout.width))
    start = 0
    for field in layout.fields:
        block, width = item_matrix(field, planar), field.item_width
        for _ in range(field.count):
            out[:, start : start + width, start : start + width] = block
            start += width
    return out


def joint_matrix(layout: Layout, planar: Floats, places: Indices) -> Floats:
    """Return L_g of all agents' rows laid end to end: row i is transformed and moves to row sigma(i).

    Inside a row, items that count over OTHERS or over AGENTS are reordered so that each keeps describing the agent
    that it described before.

    Args:
        layout: one agent's row, D numbers.
        planar: [G, 2, 2].
        places: [G, N], places[g, i] = sigma_g(i).

    Returns:
        [G, N * D, N * D].
    """
    num_agents = places.shape[1]
    row = layout_matrix(layout, planar)
    blocks = np.einsum("nm,gde->gndme", np.eye(num_agents), row)
    width = num_agents * layout.width
    source = joint_sources(layout, places)
    return np.take_along_axis(blocks.reshape(-1, width, width), source[:, :, None], axis=1)


def rows_matrix(layout: Layout, planar: Floats, places: Indices | None) -> Floats:
    """Return `joint_matrix` where agents move, else `layout_matrix`, which acts on each agent's row alike."""
    return layout_matrix(layout, planar) if places is None else joint_matrix(layout, planar, places)


def rows_permutation(layout: Layout, planar: Floats, places: Indices | None) -> tuple[Indices, Floats]:
    """Return L_g as a signed permutation: the new number k is sign[k] times the old number source[k].

    The same as `rows_matrix`, whose square grows too large with pictures.

    Args:
        layout: one agent's row, D numbers.
        planar: [G, 2, 2].
        places: [G, N], or None where agents stay.

    Returns:
        source and sign, [G, D] each, or [G, N * D] where agents move.

    Raises:
        ValueError: an item mixes its numbers, as a vector does under other turns than quarters.
    """
    sources, signs, start = [], [], 0
    for field in layout.fields:
        if field.pixels is None:
            block = kind_matrix(field.kind, planar)
            if (
                not np.array_equal(np.abs(block).sum(-1), np.ones(block.shape[:-1]))
                or not np.isin(block, (-1, 0, 1)).all()
            ):
                raise ValueError(f"a picture turns by quarters alone, but '{field.name}' is to turn by another angle")
            source, sign = np.abs(block).argmax(-1), block.sum(-1)
        else:
            source = picture_sources(field.pixels, planar)
            sign = np.ones(source.shape)
        first = start + field.item_width * np.arange(field.count)[:, None]
        sources.append((source[:, None, :] + first).reshape(len(planar), -1))
        signs.append(np.tile(sign, (1, field.count)))
        start += field.width
    within, sign = np.concatenate(sources, 1), np.concatenate(signs, 1)
    if places is None:
        return within, sign
    num_agents = places.shape[1]
    joint = (within[:, None, :] + layout.width * np.arange(num_agents)[:, None]).reshape(len(planar), -1)
    order = joint_sources(layout, places)
    joint_sign = np.tile(sign, (1, num_agents))
    return np.take_along_axis(joint, order, 1), np.take_along_axis(joint_sign, order, 1)


def state_matrix(spec: TaskSpec, planar: Floats, places: Indices | None) -> Floats:
    """Return L_g of the global state [G, Ds, Ds].

    A state that is `joint_layout` of the observation moves like the joint observation; any other moves its AGENTS
    items.

    Raises:
        ValueError: agents move, and a field's items cannot follow them.
    """
    if places is None:
        return layout_matrix(spec.state, planar)
    if spec.state == joint_layout(spec.observation, spec.num_agents):
        return joint_matrix(spec.observation, planar, places)
    came_from = np.argsort(places, axis=1)
    group, num_agents = places.shape
    sources, start = [], 0
    for field in spec.state.fields:
        slots = np.broadcast_to(np.arange(field.count), (group, field.count))
        if field.items is Items.AGENTS:
            _require_count(field, num_agents)
            slots = came_from
        elif field.items is Items.OTHERS:
            raise ValueError(f"state field '{field.name}' counts others, but a state has no observer; count agents")
        sources.append(start + _numbers(slots, field.item_width))
        start += field.width
    whole = layout_matrix(spec.state, planar)
    return np.take_along_axis(whole, np.concatenate(sources, axis=1)[:, :, None], axis=1)


def action_map(action: Discrete, elements: Sequence[Element]) -> Indices:
    """Return K_g of a discrete action space: entry [g, j] is the action that j becomes.

    It is derived by turning each action's physical meaning and looking for the action that means the result.

    Returns:
        [G, A].

    Raises:
        ValueError: some action's image is no action.
    """
    points = np.array(action.points, dtype=np.float64)
    planar = np.stack([e.matrix for e in elements])
    images = np.einsum("gvw,jw->gjv", kind_matrix(action.kind, planar), points)
    distance = np.abs(images[:, :, None, :] - points).max(axis=-1)
    nearest: Indices = distance.argmin(axis=-1)
    missed = np.argwhere(distance.min(axis=-1) > _MATCH_TOLERANCE)
    if len(missed):
        g, j = missed[0]
        raise ValueError(f"action '{action.names[j]}' {_participle(elements[g])} is no action")
    return nearest


def _participle(element: Element) -> str:
    if element.mirrored:
        return f"mirrored by {element.planar.name}"
    return f"turned by {float(element.degrees):g} degrees"


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
    others = np.array([[j for j in range(num_agents) if j != i] for i in range(num_agents)], dtype=np.int64)
    described = came_from[:, others.reshape(num_agents, -1)]
    # The observer is left out of its own list, so agents after it sit one slot earlier.
    return described - (described > came_from[:, :, None])


def _numbers(slots: Indices, width: int) -> Indices:
    """Expand item indices [G, count] to number indices [G, count * width]."""
    return (slots[:, :, None] * width + np.arange(width)).reshape(slots.shape[0], -1)


def _require_count(field: Field, expected: int) -> None:
    if field.count != expected:
        what = "other agents" if field.items is Items.OTHERS else "agents"
        raise ValueError(f"field '{field.name}' has {field.count} items for {expected} {what}; give it one for each")
