"""Orthogonal linear maps of rows of numbers, one per seed: a matrix, or a signed permutation that costs one gather.

`pull` undoes `push`. A stack of one map acts on any rows; results are new tensors of the rows' own type, inside
autocast too, and gradients flow through. An inf or NaN reaches only the numbers that it is mixed into.

Shape:
    rows [S, B, width] to the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from esp_cli.symmetry.representation import Operator
from esp_envs.errors import UserError

_GATHERED_WIDTH = 128  # numbers in a row from which a gather is faster than a matrix on a CPU; elsewhere it always is
_LARGEST_MATRIX = 4096  # numbers in a row beyond which no matrix is built


@dataclass(frozen=True)
class Dense:
    """Multiply by a matrix."""

    matrix: Tensor  # [S, width, width], orthogonal

    @property
    def width(self) -> int:
        """Numbers in a row."""
        return self.matrix.shape[-1]

    def push(self, rows: Tensor) -> Tensor:
        """Return M x."""
        return _product(rows, self.matrix.transpose(1, 2))

    def pull(self, rows: Tensor) -> Tensor:
        """Return M^-1 x."""
        return _product(rows, self.matrix)

    @property
    def is_identity(self) -> bool:
        """Whether it leaves every row as it is."""
        return torch.equal(self.matrix, torch.eye(self.width).to(self.matrix).expand_as(self.matrix))

    @property
    def squared(self) -> Dense:
        """The map whose entries are squared: how variances of independent numbers move."""
        return Dense(self.matrix.square())

    def apply(self, function: Callable[[Tensor], Tensor]) -> Dense:
        """Return the map whose tensors went through a function, which selects some of the stack or moves all."""
        return Dense(function(self.matrix))


def _product(rows: Tensor, matrix: Tensor) -> Tensor:
    """Return rows [S, B, width] times matrices, where 0 times inf or NaN is 0, in the type of the rows."""
    with torch.autocast(rows.device.type, enabled=False):
        matrix = matrix.to(rows.dtype)
        if rows.is_cpu and not torch.compiler.is_compiling():  # a GPU would be waited for
            product = torch.bmm(rows, matrix)
            if product.detach().sum().isfinite():
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
    def is_identity(self) -> bool:
        stays = torch.equal(self.source, torch.arange(self.width).to(self.source).expand_as(self.source))
        return stays and (self.sign is None or bool((self.sign == 1).all()))

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
