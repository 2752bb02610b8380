"""A batch with its transformed copies: what a learner's own loss takes, and the penalty of Eq. 10."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Generic, Protocol

import torch
from torch import Tensor

from esp_cli.prior.losses import policy_consistency_loss, value_consistency_loss
from esp_cli.prior.seed_batch import Rows, mean_per_seed
from esp_cli.symmetry import Transform

if TYPE_CHECKING:
    from esp_cli.prior.config import PriorConfig


class Divergent(Protocol):
    """A policy's head: it says how far two policies, given by their outputs, are apart."""

    def divergence(self, p: Tensor, q: Tensor) -> Tensor:
        """Return how far the policy with outputs p is from that with outputs q: [S, B, ..., N]."""


class Copies(Generic[Rows]):
    """B rows for each seed and, behind them, one copy of all of them for each transform.

    Args:
        config: what the user chose of the prior.
        originals: the rows.
        transforms: one per copy.
        augments: whether copies enter the learner's own loss.
        adapt: what a learner changes in a copy that transforming alone leaves wrong.
    """

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

    @cached_property
    def rows(self) -> Rows:
        """Originals and copies, along the batch axis: what networks are asked about."""
        made = (self.originals.transformed(g) for g in self.transforms)
        parts = [self.originals, *(copy if self.adapt is None else self.adapt(copy) for copy in made)]
        return type(self.originals).concatenate(parts)

    @cached_property
    def obs(self) -> Tensor:
        """The observations of `rows` alone."""
        return self._pushed(self.originals.obs, lambda g: g.obs)

    @cached_property
    def state(self) -> Tensor:
        """The states of `rows` alone."""
        return self._pushed(self.originals.state, lambda g: g.state)

    @cached_property
    def action(self) -> Tensor:
        """The actions of `rows` alone."""
        return self._pushed(self.originals.action, lambda g: g.action)

    def chunks(self, size: int) -> list[Copies[Rows]]:
        """Cut the originals into pieces of at most `size`, each with its own copies."""
        if size >= self.originals.count:
            return [self]
        parts, starts = self.originals.chunks(size), range(0, self.originals.count, size)
        return [
            Copies(self.config, part, [g.part(at, at + size) for g in self.transforms], self.augments, self.adapt)
            for at, part in zip(starts, parts, strict=True)
        ]

    @property
    def batch(self) -> Rows:
        """The rows that the learner's own loss takes: with the copies, or the originals alone."""
        return self.rows if self.augments else self.originals

    def learned(self, x: Tensor) -> Tensor:
        """Return the part of x [S, B (1 + copies), ...] that the learner's own loss takes."""
        return x if self.augments else self.original(x)

    def original(self, x: Tensor) -> Tensor:
        """Return the part of x [S, B (1 + copies), ...] that belongs to the originals."""
        return x[:, : self.originals.count] if self.transforms else x

    def inherited(self, target: Tensor) -> Tensor:
        """Return targets [S, B, ..., C] for all that is learned: a copy keeps that of its original (Prop. 1)."""
        if not self.augments:
            return target
        return torch.cat([target, *(g.per_agent(target) for g in self.transforms)], 1)

    def repeated(self, x: Tensor) -> Tensor:
        """Return x [S, B, ...] once for each part of what is learned."""
        return torch.cat([x] * (1 + len(self.transforms)), 1) if self.augments else x

    def penalty(self, policy: tuple[Divergent, Tensor] | None = None, value: Tensor | None = None) -> Tensor:
        """Return c times the sum of the consistency terms that are on (Eq. 10): [S], or 0 where the loss is off.

        Args:
            policy: a head and its outputs for all rows [S, B (1 + copies), ..., N, A]; None leaves S_pi out.
            value: values of all rows [S, B (1 + copies), ..., C]; None leaves S_V (S_Q) out.
        """
        coefficient, terms = self.config.coefficient, self.config.terms
        if not self.transforms or coefficient == 0:
            return torch.zeros(())
        gaps = self.gaps(policy if terms != "value" else None, value if terms != "policy" else None)
        return coefficient * sum(gaps.values(), start=torch.zeros(()))

    def gaps(self, policy: tuple[Divergent, Tensor] | None = None, value: Tensor | None = None) -> dict[str, Tensor]:
        """Return S_pi (Eq. 8) under "policy" and S_V (Eq. 9) or S_Q (supplement eq. 19) under "value".

        Each is averaged over the copies and the rows that count, [S]; arguments as of `penalty`.
        """
        stop, gaps = self.config.stop_gradient, dict[str, Tensor]()
        if policy is not None:
            head, outputs = policy
            gaps["policy"] = self._mean(
                outputs,
                lambda g, moved, here: policy_consistency_loss(head.divergence, g.pull_back(moved), here, stop),
                self.originals.mask,
            )
        if value is not None:
            gaps["value"] = self._mean(
                value,
                lambda g, moved, here: value_consistency_loss(g.values(moved), here, stop),
                self.originals.valued(value.shape[-1]),
            )
        return gaps

    def _pushed(self, x: Tensor, push: Callable[[Transform], Callable[[Tensor], Tensor]]) -> Tensor:
        return torch.cat([x, *(push(g)(x) for g in self.transforms)], 1) if self.transforms else x

    def _mean(self, x: Tensor, gap: Callable[[Transform, Tensor, Tensor], Tensor], mask: Tensor | None) -> Tensor:
        """Return the mean [S], over the copies and what a mask counts, of the gap between each and the originals."""
        here, *moved = x.split(self.originals.count, 1)
        parts = zip(self.transforms, moved, strict=True)
        return torch.stack([mean_per_seed(gap(g, copy, here), mask) for g, copy in parts]).mean(0)
