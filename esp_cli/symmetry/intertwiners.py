"""All linear maps that commute with a group: solved from how the group acts on either side, for any representation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from esp_cli.symmetry.elements import Floats
from esp_cli.symmetry.groups import FiniteGroup
from esp_cli.symmetry.representation import action_map, field_operator, item_operator, item_places
from esp_envs.spec import ActionSpace, Discrete, Field, Kind, Layout

_INDEPENDENT = 1e-6  # length of what is new in a map, of those that are averaged, below which it is rounding


@dataclass(frozen=True)
class Block:
    """Equal runs of numbers, one after the other, which transform by the same matrices."""

    matrices: Floats  # [G, d, d] how each element acts on one copy, orthogonal
    copies: int  # how many

    @property
    def size(self) -> int:
        """d, numbers in one copy."""
        return self.matrices.shape[-1]

    @property
    def width(self) -> int:
        """Numbers in all copies."""
        return self.copies * self.size


def trivial(group: FiniteGroup, copies: int) -> Block:
    """Return invariant numbers."""
    return Block(np.ones((group.order, 1, 1)), copies)


def regular(group: FiniteGroup, copies: int) -> Block:
    """Return features of one number per element h, which g moves from h to g h: a group convolution's channels."""
    columns = np.arange(group.order)
    matrices = np.zeros((group.order,) * 3)
    for g, row in enumerate(group.product):
        matrices[g, row, columns] = 1.0
    return Block(matrices, copies)


def layout_blocks(layout: Layout, group: FiniteGroup) -> list[Block]:
    """Return one block per field of a layout: a copy is an item, or the whole field where its items change places."""
    return [_field_block(field, group) for field in layout.fields]


def _field_block(field: Field, group: FiniteGroup) -> Block:
    if item_places(field, group.elements) is None:
        return Block(item_operator(field, group.elements).matrix, field.count)
    return Block(field_operator(field, group.elements).matrix, 1)


def action_blocks(action: ActionSpace, group: FiniteGroup) -> list[Block]:
    """Return how one number per discrete action, or the numbers of a continuous one, transform."""
    if not isinstance(action, Discrete):
        return layout_blocks(action.layout, group)
    places = action_map(action, group.elements)
    matrices = np.zeros((group.order, action.count, action.count))
    np.put_along_axis(matrices, places[:, None, :], 1.0, axis=1)
    return [Block(matrices, 1)]


def with_pixels(block: Block, side: int, group: FiniteGroup) -> Block:
    """Return how a square patch of pixels, each holding one copy of a block, transforms: number, then pixel."""
    pixels = item_operator(Field("patch", Kind.PICTURE, pixels=(side, side)), group.elements).matrix
    size = block.size * side * side
    return Block(np.einsum("gij,gkl->gikjl", block.matrices, pixels).reshape(-1, size, size), block.copies)


def intertwiners(inputs: Block, outputs: Block) -> Floats:
    """Return an orthonormal basis [K, d_in, d_out] of all W with W = rho_in(g) W rho_out(g)', for rows x W.

    The average of any matrix over the group satisfies it, and every solution is such an average. The number of
    independent solutions is the mean over the group of the product of both characters. One copy of a block counts.
    """
    rows, columns = inputs.matrices, outputs.matrices
    traces = np.trace(rows, axis1=1, axis2=2) * np.trace(columns, axis1=1, axis2=2)
    wanted = round(float(traces.mean()))
    basis = np.zeros((wanted, inputs.size * outputs.size))
    found = 0
    for i, j in np.ndindex(inputs.size, outputs.size):
        if found == wanted:
            break
        average = np.einsum("ga,gb->ab", rows[:, :, i], columns[:, :, j]).flatten() / len(rows)
        for _ in range(2):  # twice, against rounding
            average -= (basis[:found] @ average) @ basis[:found]
        length = np.linalg.norm(average)
        if length > _INDEPENDENT:
            basis[found] = average / length
            found += 1
    return basis.reshape(wanted, inputs.size, outputs.size)


def block_width(blocks: Sequence[Block]) -> int:
    """Return how many numbers blocks hold together."""
    return sum(block.width for block in blocks)
