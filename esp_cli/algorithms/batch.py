"""On-policy experience shaped for gradient steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass
class Batch:
    """Experience ready for gradient steps: B sequences of tau steps (tau = 1 unless the network is recurrent).

    Shape:
        obs [S, B, tau, N, D], state [S, B, tau, state width], action [S, B, tau, N(, width)],
        log_prob and advantage [S, B, tau, N], target and value [S, B, tau, C] in normalised units.
    """

    obs: Tensor
    state: Tensor
    action: Tensor
    log_prob: Tensor
    advantage: Tensor
    target: Tensor
    value: Tensor

    def select(self, rows: Tensor) -> Batch:
        """Return the sequences `rows`: [S, m]."""
        num_seeds, count = self.obs.shape[:2]
        flat = (rows + count * torch.arange(num_seeds, device=rows.device).unsqueeze(1)).flatten()
        return self._map(lambda x: x.flatten(0, 1).index_select(0, flat).unflatten(0, rows.shape))

    def chunks(self, size: int) -> list[Batch]:
        """Cut the batch axis into pieces of at most `size`; views, no copies."""
        split = {name: tensor.split(size, 1) for name, tensor in vars(self).items()}
        return [Batch(**dict(zip(split, pieces, strict=True))) for pieces in zip(*split.values(), strict=True)]

    @staticmethod
    def concatenate(parts: list[Batch]) -> Batch:
        """Put batches behind each other along the batch axis."""
        return Batch(**{name: torch.cat([getattr(part, name) for part in parts], 1) for name in vars(parts[0])})

    def _map(self, function: Callable[[Tensor], Tensor]) -> Batch:
        return Batch(**{name: function(tensor) for name, tensor in vars(self).items()})
