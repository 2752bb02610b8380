"""A batch with its transformed copies: what a learner's own loss takes, and the penalty of Eq. 10."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic

import torch
from torch import Tensor

from esp_cli.prior.losses import Loss, OfGraph, Term, Values, consistency_gap
from esp_cli.prior.seed_batch import Rows, average, shares
from esp_cli.symmetry import Transform
from esp_cli.symmetry.frame import Frame

if TYPE_CHECKING:
    from esp_cli.prior.config import PriorConfig


class Copies(Generic[Rows]):
    """B rows for each seed and, behind them, one copy of all of them for each transform."""

    def __init__(
        self,
        config: PriorConfig,
        originals: Rows,
        transforms: Sequence[Transform],
        augments: bool,
        adapt: Callable[[Rows], Rows] | None = None,
    ) -> None:
        self.config, self.originals, self.transforms = config, originals, list(transforms)
        self.augments, self.adapt = augments and bool(self.transforms), adapt
        self._made: dict[int, Any] = {}

    @cached_property
    def rows(self) -> Rows:
        """Originals and copies, along the batch axis: what networks are asked about."""
        made = (self.originals.transformed(g) for g in self.transforms)
        parts = [self.originals, *(copy if self.adapt is None else self.adapt(copy) for copy in made)]
        return type(self.originals).concatenate(parts)

    @cached_property
    def obs(self) -> Tensor:
        return self._pushed(self.originals.obs, lambda g: g.obs)

    @cached_property
    def state(self) -> Tensor:
        return self._pushed(self.originals.state, lambda g: g.state)

    @cached_property
    def action_mask(self) -> Tensor | None:
        mask = self.originals.action_mask
        return None if mask is None else self._pushed(mask, lambda g: g.push_outputs)

    def _pushed(self, x: Tensor, push: Callable[[Transform], Callable[[Tensor], Tensor]]) -> Tensor:
        return torch.cat([x, *(push(g)(x) for g in self.transforms)], 1) if self.transforms else x

    def chunks(self, size: int) -> list[Copies[Rows]]:
        """Cut the originals into pieces of at most `size`, each with its own copies."""
        if size >= self.originals.count:
            return [self]
        parts = self.originals.chunks(size)
        return [Copies(self.config, part, self.transforms, self.augments, self.adapt) for part in parts]

    @property
    def loss_rows(self) -> Rows:
        """The rows that the learner's own loss takes: with the copies, or the originals alone."""
        return self.rows if self.augments else self.originals

    def for_loss(self, x: Tensor) -> Tensor:
        """Return the part of x [S, B (1 + copies), ...] that belongs to `loss_rows`."""
        return x if self.augments else self.original(x)

    def original(self, x: Tensor) -> Tensor:
        """Return the part of x [S, B (1 + copies), ...] that belongs to the originals."""
        return x[:, : self.originals.count] if self.transforms else x

    def tiled(self, x: Tensor) -> Tensor:
        """Return x [S, B, ...] of the originals for all `loss_rows`, the same for each copy."""
        return torch.cat([x] * (1 + len(self.transforms)), 1) if self.augments else x

    @cached_property
    def frame(self) -> Frame:
        return Frame(self.transforms)

    @property
    def learned(self) -> int:
        """How many parts of the rows, originals and copies, the learner's own loss takes."""
        return 1 + len(self.transforms) if self.augments else 1

    def in_frame(self, name: str) -> Tensor:
        """Return a field of numbers per agent or per world of what is learned from: [S, 1 or 1 + copies, R]."""
        if self.adapt is None or not self.augments:
            return getattr(self.originals, name).flatten(1).unsqueeze(1)
        return self.frame.pull_values(getattr(self.rows, name)).flatten(2)

    def policies(self, head: Any, outputs: Any) -> Any:
        """Return outputs for all rows [S, B (1 + copies), ...] as policies, made once; see `networks.policies`."""
        return self._once(outputs, lambda: head.policies(_returned(outputs), self.frame))

    def values(self, values: Any) -> Values:
        """Return values for all rows [S, B (1 + copies), ..., C] in the frame, made once."""
        return self._once(values, lambda: Values(_returned(values), self.frame))

    def _once(self, tensor: Any, make: Callable[[], Any]) -> Any:
        if id(tensor) not in self._made:
            self._made[id(tensor)] = make()
        return self._made[id(tensor)]

    def penalty(self, policy: tuple[Any, Any] | None = None, value: Any = None) -> Loss:
        """Return c times the sum of the consistency terms (Eq. 10), or nothing where the loss is off.

        Args:
            policy: a head and its outputs for all rows [S, B (1 + copies), ..., N, A]; None leaves S_pi out.
            value: values of all rows [S, B (1 + copies), ..., C]; None leaves S_V (S_Q) out.
        """
        if not self.transforms or self.config.coefficient == 0:
            return Loss()
        return self.config.coefficient * Loss(*(t for gap in self._gaps(policy, value).values() for t in gap.terms))

    def gaps(self, policy: tuple[Any, Any] | None = None, value: Any = None) -> dict[str, Tensor]:
        """Return S_pi (Eq. 8) under "policy" and S_V (Eq. 9) or S_Q (supplement eq. 19) under "value".

        Each is averaged over the copies and the rows that count, [S]; arguments as of `penalty`.
        """
        return {name: gap.value for name, gap in self._gaps(policy, value).items()}

    def _gaps(self, policy: tuple[Any, Any] | None, value: Any) -> dict[str, Loss]:
        gaps, rows = dict[str, Loss](), self.originals
        if policy is not None and hasattr(policy[0], "policies"):
            gaps["policy"] = Loss(Term(self.policies(*policy), 1.0, consistency_gap(rows.mask)))
        elif policy is not None:
            head, outputs = policy[0], self.frame.pull_outputs(policy[1])
            gap = head.divergence(outputs[:, 1:], outputs[:, :1]).flatten(2)
            gaps["policy"] = Loss.of(average(gap, shares(rows.mask, gap.shape)))
        if value is not None:
            gaps["value"] = Loss(Term(self.values(value), 1.0, consistency_gap(rows.valued(_returned(value).size[-1]))))
        return gaps


def _returned(x: Any) -> Any:
    return OfGraph(x) if isinstance(x, Tensor) else x
