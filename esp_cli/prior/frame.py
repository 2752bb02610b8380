"""What networks return for originals and copies, brought back to the originals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from esp_cli.symmetry import Transform
from esp_cli.symmetry.maps import Gather


class Frame:
    """The originals' frame: what is returned for a copy is pulled back by the transform that made the copy.

    There a copy is learned from as its original is: it has the original's action and target (Prop. 1), and its policy
    and value compare with those of the original (Eq. 8, 9).

    Args:
        transforms: K, with which copies were made that follow the B originals along the batch axis.
    """

    def __init__(self, transforms: Sequence[Transform]) -> None:
        self._transforms = list(transforms)
        self._moves_agents = any(g.agents is not None for g in self._transforms)
        maps = [g.output_map for g in self._transforms if g.is_uniform and g.action_index is not None]
        self._orders = [m for m in maps if isinstance(m, Gather)]
        self._reorders = not self._moves_agents and len(self._orders) == len(self._transforms)

    def pull_outputs(self, outputs: Tensor) -> Tensor:
        """Return a policy's outputs [S, (1 + K) B, ..., N, A] in the frame: [S, 1 + K, B, ..., N, A]."""
        parts = self._parts(outputs)
        if self._reorders:
            return _reordered(parts, [m.back for m in self._orders])
        return self._each(parts, lambda g: g.pull_back)

    def push_outputs(self, outputs: Tensor) -> Tensor:
        """Undo `pull_outputs`; a slope goes the same way, since the maps are orthogonal."""
        if self._reorders:
            return _reordered(outputs, [m.source for m in self._orders]).flatten(1, 2)
        return self._each(outputs, lambda g: g.push_outputs).flatten(1, 2)

    def pull_values(self, values: Tensor) -> Tensor:
        """Return values [S, (1 + K) B, ..., C] in the frame: [S, 1 + K, B, ..., C]."""
        parts = self._parts(values)
        return self._each(parts, lambda g: g.values) if self._moves_agents else parts

    def push_values(self, values: Tensor) -> Tensor:
        """Undo `pull_values`, likewise."""
        return (self._each(values, lambda g: g.per_agent) if self._moves_agents else values).flatten(1, 2)

    def _parts(self, x: Tensor) -> Tensor:
        return x.unflatten(1, (1 + len(self._transforms), -1))

    def _each(self, parts: Tensor, move: Callable[[Transform], Callable[[Tensor], Tensor]]) -> Tensor:
        here, *copies = parts.unbind(1)
        return torch.stack([here, *(move(g)(copy) for g, copy in zip(self._transforms, copies, strict=True))], 1)


class Values:
    """What a critic outputs for originals and copies; a slope is by `rows`.

    Attributes:
        count: C.
        rows: [S, 1 + K, B T C] in the frame.
    """

    def __init__(self, values: Any, frame: Frame) -> None:
        self._values, self._frame = values, frame
        pulled = frame.pull_values(values.tensor)
        self._shape, self.count, self.rows = pulled.shape, pulled.shape[-1], pulled.flatten(2)

    def back(self, slope: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return the values and the slope by them."""
        return [(self._values, self._frame.push_values(slope.view(self._shape)))]


def _reordered(x: Tensor, orders: Sequence[Tensor]) -> Tensor:
    """Give the numbers of every copy another order; whole columns are moved.

    Args:
        x: [S, 1 + K, ..., A], whose first part, the originals, stays as it is.
        orders: K, [S or 1, A] each: which number comes to each place.
    """
    if not orders:
        return x
    columns = x.movedim(-1, 1)
    num_seeds, width, parts = columns.shape[:3]
    stays, below = _places(num_seeds, width, parts, x.device)
    order = torch.stack([stays, *(order.expand(num_seeds, -1) for order in orders)], 2)  # [S, A, 1 + K]
    index = torch.add(below, order, alpha=parts).view(-1)
    moved = columns.reshape(num_seeds * width * parts, -1).index_select(0, index)
    return moved.view(columns.shape).movedim(1, -1)


@lru_cache
def _places(num_seeds: int, width: int, parts: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return each number's own place [S, A], and where the columns [S, 1, parts] of number 0 begin."""
    own = torch.arange(width, device=device).expand(num_seeds, -1)
    first = torch.arange(num_seeds, device=device).view(-1, 1, 1) * (width * parts)
    return own, first + torch.arange(parts, device=device)
