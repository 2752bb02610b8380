"""Linear maps, one per seed, on rows of numbers: a matrix, or a signed permutation that costs one gather.

All are orthogonal: `pull` undoes `push`. A stack of one map acts on any rows; results are new tensors, and gradients
flow through.

Shape:
    rows [S, B, width] to the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from esp_cli.symmetry.elements import Element, Floats, Indices
from esp_cli.symmetry.representation import rows_matrix, rows_permutation, state_matrix, state_permutation
from esp_envs.spec import Layout, Spaces


@dataclass(frozen=True)
class Dense:
    """Multiply by a matrix.

    Attributes:
        matrix: [S, width, width], orthogonal.
    """

    matrix: Tensor

    @property
    def width(self) -> int:
        """Numbers in a row."""
        return self.matrix.shape[-1]

    def push(self, rows: Tensor) -> Tensor:
        """Return M x."""
        return torch.bmm(rows, self.matrix.to(rows.dtype).transpose(1, 2))

    def pull(self, rows: Tensor) -> Tensor:
        """Return M^-1 x."""
        return torch.bmm(rows, self.matrix.to(rows.dtype))

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


@dataclass(frozen=True)
class Gather:
    """Reorder the numbers and change some signs.

    Attributes:
        source: [S, width] int64, where each pushed number comes from.
        back: [S, width] int64, the inverse: where each pulled number comes from.
        sign: [S, width] what each pushed number is multiplied by; None changes no sign.
    """

    source: Tensor
    back: Tensor
    sign: Tensor | None = None

    @property
    def width(self) -> int:
        """Numbers in a row."""
        return self.source.shape[-1]

    def push(self, rows: Tensor) -> Tensor:
        """Return the rows reordered, then signed."""
        moved = rows.gather(2, self.source[:, None, :].expand(rows.shape))
        return moved if self.sign is None else moved * self.sign[:, None, :].to(rows.dtype)

    def pull(self, rows: Tensor) -> Tensor:
        """Return the rows signed, then in their old order."""
        signed = rows if self.sign is None else rows * self.sign[:, None, :].to(rows.dtype)
        return signed.gather(2, self.back[:, None, :].expand(rows.shape))

    @property
    def is_identity(self) -> bool:
        """Whether it leaves every row as it is."""
        stays = torch.equal(self.source, torch.arange(self.width).to(self.source).expand_as(self.source))
        return stays and (self.sign is None or bool((self.sign == 1).all()))

    @property
    def squared(self) -> Gather:
        """The map whose entries are squared: how variances of independent numbers move."""
        return Gather(self.source, self.back)

    def inverse(self) -> Gather:
        """Return the unsigned map that undoes this one."""
        return Gather(self.back, self.source)

    def apply(self, function: Callable[[Tensor], Tensor]) -> Gather:
        """Return the map whose tensors went through a function, which selects some of the stack or moves all."""
        return Gather(function(self.source), function(self.back), None if self.sign is None else function(self.sign))


Map = Dense | Gather


def dense(matrix: Floats, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> Dense:
    """Return the map of matrices [S, width, width]."""
    return Dense(torch.as_tensor(matrix, dtype=dtype, device=device))


def gather(source: Indices, sign: Floats | None = None, device: torch.device | str = "cpu") -> Gather:
    """Return the map of permutations [S, width] with signs [S, width]."""
    index = torch.as_tensor(source, device=device)
    signs = None if sign is None else torch.as_tensor(sign, dtype=torch.float32, device=device)
    return Gather(index, index.argsort(1), signs)


def rows_map(
    layout: Layout,
    elements: tuple[Element, ...],
    num_agents: int,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> Map:
    """Return L_g on an agent's row, or on all agents' rows end to end where agents move.

    Raises:
        UserError: the layout cannot be transformed.
    """
    if _holds_pictures(layout):
        return gather(*rows_permutation(layout, elements, num_agents), device)
    return dense(rows_matrix(layout, elements, num_agents), device, dtype)


def state_map(
    spaces: Spaces,
    elements: tuple[Element, ...],
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> Map:
    """Return L_g on the global state.

    Raises:
        UserError: the state cannot be transformed.
    """
    if _holds_pictures(spaces.state):
        return gather(*state_permutation(spaces, elements), device)
    return dense(state_matrix(spaces, elements), device, dtype)


def _holds_pictures(layout: Layout) -> bool:
    """Return whether a matrix of a layout's numbers would grow with the square of its pixels."""
    return any(field.pixels is not None for field in layout.fields)
