"""Which element to copy with, learned while training: a bandit whose arms are the elements and, the last one, none."""

from __future__ import annotations

import torch
from torch import Tensor, nn

WINDOW = 50
"""Iterations that count: what helped early need not help late."""


class Bandit:
    """Sliding-window upper confidence bounds for each seed, as AdaptAUG chooses augmentations (Yu et al., ICRA 2024).

    An arm's score is the mean training return of the iterations that follow its use, in standard deviations over the
    window, plus sqrt(2 ln t / n) for n of t iterations. That returns rise anyway is not taken out.

    Attributes:
        arm: [S] int64, in use.
        before: [S] int64, used in the iteration before, whose return this one brings; -1 at the start.
        arms: [S, WINDOW] int64, those whose returns are known, the latest last; -1 before the first.
        returns: [S, WINDOW], these returns.
    """

    def __init__(self, num_seeds: int, num_arms: int) -> None:
        self.num_arms = num_arms
        self.arm = torch.zeros(num_seeds, dtype=torch.int64)
        self.before = torch.full((num_seeds,), -1)
        self.arms = torch.full((num_seeds, WINDOW), -1)
        self.returns = torch.zeros(num_seeds, WINDOW)

    def bounds(self) -> Tensor:
        """Return the upper confidence bound of each arm, [S, A]; infinite where the window has none of it."""
        known = self.arms >= 0
        used = nn.functional.one_hot(self.arms.clamp(min=0), self.num_arms) * known.unsqueeze(-1)
        times, total = used.sum(1), known.sum(1, keepdim=True).clamp(min=1)
        off = (self.returns - self.returns.sum(1, keepdim=True) / total) * known
        scores = off / (off.square().sum(1, keepdim=True) / total).sqrt().clamp(min=1e-6)
        value = (used * scores.unsqueeze(-1)).sum(1) / times.clamp(min=1)
        bound = value + (2 * total.log() / times.clamp(min=1)).sqrt()
        return bound.masked_fill(times == 0, torch.inf)

    def step(self, returns: Tensor) -> None:
        """End an iteration with these mean returns, [S], and choose the arms of the next; ties go to the first."""
        told = (self.before >= 0) & returns.isfinite()
        for kept, new in ((self.arms, self.before), (self.returns, returns.to(self.returns))):
            kept[told] = torch.cat([kept[:, 1:], new.unsqueeze(1)], 1)[told]
        self.before, self.arm = self.arm, self.bounds().argmax(1)

    def state_dict(self) -> dict[str, Tensor]:
        """Return what a resumed run needs."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}
