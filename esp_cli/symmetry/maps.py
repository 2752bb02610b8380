"""Orthogonal linear maps of rows of numbers, one per seed: a matrix, or a signed permutation that costs one gather.

`pull` undoes `push`. A stack of one map acts on any rows; results are new tensors of the rows' own type, inside
autocast too, and gradients flow through. An inf or NaN reaches only the numbers that it is mixed into.

Shape:
    rows [S, B, width] to the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from math import isfinite

import numpy as np
import torch
from torch import Tensor

from esp_cli.symmetry.elements import Floats
from esp_cli.symmetry.groups import FiniteGroup
from esp_cli.symmetry.representation import Operator, action_map, field_operator, item_operator, item_places
from esp_envs.errors import UserError
from esp_envs.spec import ActionSpace, Discrete, Field, Kind, Layout

_GATHERED_WIDTH = 128  # numbers in a row from which a gather is faster than a matrix on a CPU; elsewhere it always is
_LARGEST_MATRIX = 4096  # numbers in a row beyond which no matrix is built


@dataclass(frozen=True)
class Dense:
    """Multiply by a matrix."""

    matrix: Tensor  # [S, width, width], orthogonal

    @property
    def width(self) -> int:
        return self.matrix.shape[-1]

    def push(self, rows: Tensor) -> Tensor:
        return _product(rows, self.matrix.transpose(1, 2))

    def pull(self, rows: Tensor) -> Tensor:
        return _product(rows, self.matrix)

    @property
    def squared(self) -> Dense:
        """The map whose entries are squared: how variances of independent numbers move."""
        return Dense(self.matrix.square())

    def apply(self, function: Callable[[Tensor], Tensor]) -> Dense:
        """Return the map whose tensors went through a function, which selects some of the stack or moves all."""
        return Dense(function(self.matrix))


def _product(rows: Tensor, matrix: Tensor) -> Tensor:
    """Return rows [S, B, width] times matrices, where 0 times inf or NaN is 0, in the type of the rows."""
    kind = rows.device.type
    with torch.autocast(kind, enabled=False) if torch.is_autocast_enabled(kind) else nullcontext():
        matrix = matrix.to(rows.dtype)
        if rows.is_cpu and not torch.compiler.is_compiling():  # a GPU would be waited for
            product = torch.bmm(rows, matrix)
            if isfinite(product.sum().item()):
                return product
        product = torch.bmm(rows.where(rows.isfinite(), 0.0), matrix)
        high, low = (~(rows < torch.inf)).to(matrix), (~(rows > -torch.inf)).to(matrix)  # NaN, as inf - inf, is both
        plus, minus = matrix.clamp_min(0.0), (-matrix).clamp_min(0.0)
        above, below = high @ plus + low @ minus, high @ minus + low @ plus
        return product + above.masked_fill(above > 0, torch.inf) - below.masked_fill(below > 0, torch.inf)


@dataclass(frozen=True)
class Gather:
    """Reorder the numbers and change some signs; its members are those of `Dense`."""

    source: Tensor  # [S, width] int64, where each pushed number comes from
    back: Tensor  # [S, width] int64, the inverse: where each pulled number comes from
    sign: Tensor | None = None  # [S, width] what each pushed number is multiplied by; None changes no sign

    @property
    def width(self) -> int:
        return self.source.shape[-1]

    def push(self, rows: Tensor) -> Tensor:
        moved = rows.gather(2, self.source[:, None, :].expand(rows.shape))
        return moved if self.sign is None else moved * self.sign[:, None, :].to(rows.dtype)

    def pull(self, rows: Tensor) -> Tensor:
        signed = rows if self.sign is None else rows * self.sign[:, None, :].to(rows.dtype)
        return signed.gather(2, self.back[:, None, :].expand(rows.shape))

    @property
    def squared(self) -> Gather:
        return Gather(self.source, self.back)

    def apply(self, function: Callable[[Tensor], Tensor]) -> Gather:
        return Gather(function(self.source), function(self.back), None if self.sign is None else function(self.sign))


Map = Dense | Gather


def map_of(operator: Operator, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> Map:
    """Return what computes an operator: a gather where one is possible, and faster on a CPU, else a matrix product."""
    if operator.terms == 1 and (operator.width >= _GATHERED_WIDTH or torch.device(device).type != "cpu"):
        return gather_of(operator, device)
    if operator.width > _LARGEST_MATRIX:
        raise UserError(
            f"{operator.width} numbers are too many for a map that mixes them; with pictures of this size, use quarter "
            "turns and mirrors"
        )
    return Dense(torch.as_tensor(operator.matrix, dtype=dtype, device=device))


def gather_of(operator: Operator, device: torch.device | str = "cpu") -> Gather:
    """Return the gather of an operator that is a signed permutation."""
    source, sign = operator.source[:, :, 0], operator.weight[:, :, 0]
    signs = None if (sign == 1).all() else torch.as_tensor(sign, dtype=torch.float32, device=device)
    return Gather(torch.as_tensor(source, device=device), torch.as_tensor(np.argsort(source, 1), device=device), signs)


_INDEPENDENT = 1e-6  # length of what is new in a map, of those that are averaged, below which it is rounding


@dataclass(frozen=True)
class Block:
    """Equal runs of numbers, one after the other, which transform by the same matrices."""

    matrices: Floats  # [G, d, d] how each element acts on one copy, orthogonal
    copies: int  # how many

    @property
    def size(self) -> int:
        return self.matrices.shape[-1]

    @property
    def width(self) -> int:
        return self.copies * self.size


def trivial(group: FiniteGroup, copies: int) -> Block:
    """Return invariant numbers."""
    return Block(np.ones((group.order, 1, 1)), copies)


def regular(group: FiniteGroup, copies: int) -> Block:
    """Return features of one number per element h, which g moves from h to g h: a group convolution's channels."""
    return Block(Operator.moving(group.product).matrix, copies)


def layout_blocks(layout: Layout, group: FiniteGroup) -> list[Block]:
    """Return one block per field of a layout: a copy is an item, or the whole field where its items change places.

    A field without items has none.
    """
    elements, moves = group.elements, [item_places(field, group.elements) is not None for field in layout.fields]
    return [
        Block(field_operator(f, elements).matrix, 1) if moved else Block(item_operator(f, elements).matrix, f.count)
        for f, moved in zip(layout.fields, moves, strict=True)
        if f.width
    ]


def action_blocks(action: ActionSpace, group: FiniteGroup) -> list[Block]:
    """Return how one number per discrete action, or the numbers of a continuous one, transform."""
    if not isinstance(action, Discrete):
        return layout_blocks(action.layout, group)
    return [Block(Operator.moving(action_map(action, group.elements)).matrix, 1)]


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
