"""What networks return for originals and copies, brought back to the originals."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from esp_cli.symmetry.transforms import Transform


class Frame:
    """The originals' frame: what is returned for a copy is pulled back by the transform that made the copy.

    There a copy is learned from as its original is: it has the original's action and target (Prop. 1), and its policy
    and value compare with those of the original (Eq. 8, 9). The K copies follow the B originals along the batch axis;
    `parts` is 1 + K, and `moves_agents` says whether any exchanges agents.
    """

    def __init__(self, transforms: Sequence[Transform]) -> None:
        self._transforms = list(transforms)
        self.parts = 1 + len(self._transforms)
        self.moves_agents = any(g.agents is not None for g in self._transforms)

    def pull_outputs(self, outputs: Tensor) -> Tensor:
        """Return a policy's outputs [S, (1 + K) B, ..., N, A] in the frame: [S, 1 + K, B, ..., N, A]."""
        return self._each(self._parts(outputs), lambda g: g.pull_back)

    def push_outputs(self, outputs: Tensor) -> Tensor:
        """Undo `pull_outputs`; a slope goes the same way, since the maps are orthogonal."""
        return self._each(outputs, lambda g: g.push_outputs).flatten(1, 2)

    def pull_items(self, item: Tensor, outputs: Tensor) -> Tensor | None:
        """Return for each number of `pull_outputs` its copy's item, from `item` [W] of actions; None if none moves."""
        if not any(element.items for g in self._transforms for element in g.elements):
            return None
        parts = self._parts(item.to(outputs.dtype).expand_as(outputs))
        return self._each(parts, lambda g: g.pull_back_variance).round().long()

    def orders(self, num_actions: int) -> Tensor | None:
        """Return which output of each part is the original's action [S or 1, 1 + K, A]."""
        if not self._transforms:
            return torch.arange(num_actions).view(1, 1, -1)
        orders = [order for g in self._transforms if (order := g.orders) is not None]
        if len(orders) < len(self._transforms):
            return None
        if len(orders) == 1:
            return orders[0]
        orders = [order.expand(max(map(len, orders)), -1, -1) for order in orders]
        return torch.cat([orders[0][:, :1], *(order[:, 1:] for order in orders)], 1)

    def pull_values(self, values: Tensor) -> Tensor:
        """Return values [S, (1 + K) B, ..., C] in the frame: [S, 1 + K, B, ..., C]."""
        parts = self._parts(values)
        return self._each(parts, lambda g: g.values) if self.moves_agents else parts

    def push_values(self, values: Tensor) -> Tensor:
        """Undo `pull_values`, likewise."""
        return (self._each(values, lambda g: g.per_agent) if self.moves_agents else values).flatten(1, 2)

    def _parts(self, x: Tensor) -> Tensor:
        return x.unflatten(1, (self.parts, -1))

    def _each(self, parts: Tensor, move: Callable[[Transform], Callable[[Tensor], Tensor]]) -> Tensor:
        if not self._transforms:
            return parts
        here, *copies = parts.unbind(1)
        return torch.stack([here, *(move(g)(copy) for g, copy in zip(self._transforms, copies, strict=True))], 1)
