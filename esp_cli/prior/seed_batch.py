"""Experience of S seeds that a symmetry can act on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, TypeVar

import torch
from torch import Tensor

from esp_cli.symmetry import Transform

Rows = TypeVar("Rows", bound="SeedBatch")


@dataclass
class SeedBatch:
    """Tensors [S, B, ...] of what was seen and done; a subclass adds fields and names those that count per agent."""

    # names of fields [S, B, ..., N] that move with their agents; those with one number per world stay
    per_agent: ClassVar[tuple[str, ...]] = ()
    # whether one agent with a reward of its own is all there is, so that even a single value is that agent's
    lone: ClassVar[bool] = False

    obs: Tensor  # [S, B, ..., N, D]
    state: Tensor  # [S, B, ..., Ds]
    action: Tensor  # [S, B, ..., N(, width)]
    # [S, B, ..., N, A] bool, the allowed actions; None allows all
    action_mask: Tensor | None = field(default=None, kw_only=True)
    # [S, B, ..., N] bool, the agents that have not ended; None where none ever ends
    alive: Tensor | None = field(default=None, kw_only=True)

    @property
    def tensors(self) -> dict[str, Tensor]:
        return {name: tensor for name, tensor in vars(self).items() if tensor is not None}

    @property
    def count(self) -> int:
        return self.obs.shape[1]

    @property
    def mask(self) -> Tensor | None:
        """[S, B, T] which rows count, or [S, B, T, N] of which agents; None where all do."""
        return self.played if self.alive is None else self.alive

    @property
    def played(self) -> Tensor | None:
        """[S, B, T] which rows belong to an episode; None where all do."""
        return None

    def own(self, count: int) -> bool:
        """Return whether C = `count` values of each row are the agents' own, not one of the world."""
        return count > 1 or self.lone

    def valued(self, count: int) -> Tensor | None:
        """Return which of C = `count` values of each row count.

        A value per agent counts up to the agent's end. That of a world counts in every row of the episode: the reward
        that its agents share goes on behind the end of the last, and what is bootstrapped has to be learned.
        """
        return self.mask if self.own(count) else self.played

    def map(self: Rows, function: Callable[[Tensor], Tensor]) -> Rows:
        """Return the batch with every tensor put through a function."""
        return type(self)(**{name: function(tensor) for name, tensor in self.tensors.items()})

    def first(self: Rows, count: int) -> Rows:
        """Return the first `count` rows of each seed; views."""
        return self.map(lambda x: x[:, :count])

    def select(self: Rows, rows: Tensor) -> Rows:
        """Return the rows [S, m] of each seed."""
        flat = (rows + self.count * torch.arange(rows.shape[0], device=rows.device).unsqueeze(1)).flatten()
        return self.map(lambda x: x.flatten(0, 1).index_select(0, flat).unflatten(0, rows.shape))

    def chunks(self: Rows, size: int) -> list[Rows]:
        """Cut the batch axis into pieces of at most `size`; views."""
        tensors = self.tensors
        pieces = zip(*(tensor.split(size, 1) for tensor in tensors.values()), strict=True)
        return [type(self)(**dict(zip(tensors, piece, strict=True))) for piece in pieces]

    def transformed(self: Rows, g: Transform) -> Rows:
        """Return (L_g s, K_g a); all else stays (Eq. 5, Prop. 1), or moves with its agents."""
        moved = {name: g.per_agent(getattr(self, name)) for name in self.per_agent}
        if self.action_mask is not None:
            moved["action_mask"] = g.push_outputs(self.action_mask)
        if self.alive is not None:
            moved["alive"] = g.per_agent(self.alive)
        return replace(self, obs=g.obs(self.obs), state=g.state(self.state), action=g.action(self.action), **moved)

    @classmethod
    def concatenate(cls: type[Rows], parts: Sequence[Rows]) -> Rows:
        if len(parts) == 1:
            return parts[0]
        return cls(**{name: torch.cat([getattr(part, name) for part in parts], 1) for name in parts[0].tensors})


def mean_per_seed(x: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean [S] of x [S, B, T, ...] (without a mask [S, ...]) over what counts; 0 where nothing does.

    The mask [S, B, T(, N)] is of rows or agents. A number per world, x [S, B, T, 1], counts while an agent of it does.
    """
    if mask is None:
        return x.flatten(1).mean(1)
    if mask.dim() > 3 and x.shape[-1] != mask.shape[-1]:
        mask = mask.any(-1, keepdim=True)
    elif x.dim() > mask.dim():
        x = x.flatten(mask.dim()).mean(-1)
    return torch.where(mask, x, 0.0).flatten(1).sum(1) / mask.flatten(1).sum(1).clamp_min(1)


def shares(mask: Tensor | None, shape: Sequence[int]) -> Tensor | float:
    """Return the share of each number of x [S, P, R] in the mean of each seed over parts and over what counts."""
    if mask is None:
        return 1.0 / (shape[1] * shape[2])
    numbers = shape[2] // mask[0, ..., 0].numel() if mask.dim() > 3 else shape[2] // mask[0].numel()
    if mask.dim() == 3:
        mask = mask.unsqueeze(-1).expand(-1, -1, -1, numbers)
    elif numbers != mask.shape[-1]:
        mask = mask.any(-1, keepdim=True)
    mask = mask.flatten(1).unsqueeze(1)
    return mask / (mask.sum(2, keepdim=True).clamp_min(1) * shape[1])


def average(x: Tensor, share: Tensor | float) -> Tensor:
    """Return the mean [S] of x [S, P, R] with these shares; 0 where nothing counts."""
    return mean_per_seed(x, None if isinstance(share, float) else (share > 0).expand_as(x))
