"""The object that a learner is given: it hands out transforms and says what to do with them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from esp_cli.prior.config import PriorConfig
from esp_cli.symmetry import Transform, carried_groups, transform_set
from esp_envs.spec import TaskSpec


class SymmetryPrior:
    """A task's known symmetry, ready for use in a learner's update.

    `probe` holds the fixed elements on which symmetry errors are measured, with a prior or without.

    Args:
        config: what the user chose.
        spec: the task; it decides how an element acts, and may refuse it.
        device: where the transforms live.

    Raises:
        ValueError: the task cannot carry an element, or all copies of an infinite group are asked for.
    """

    def __init__(self, config: PriorConfig, spec: TaskSpec, device: torch.device | str = "cpu") -> None:
        self.config = config
        self.active = config.augments or config.coefficient > 0
        self.transforms = transform_set(config.transforms, spec, device) if self.active else None
        if self.transforms is not None and config.copies == "all" and not self.transforms.is_finite:
            raise ValueError(f"prior.copies=all needs a finite group, but '{config.transforms}' is infinite; use draw")

        self.probe = _probe(spec, device)

    @property
    def num_copies(self) -> int:
        """Transformed copies of every row of a minibatch."""
        if self.transforms is None:
            return 0
        return self.transforms.size if self.config.copies == "all" else 1

    @property
    def augmented_share(self) -> float:
        """Share of the rows in a learner's own loss that are copies."""
        return self.num_copies / (1 + self.num_copies) if self.config.augments else 0.0

    def for_minibatch(self, generators: Sequence[torch.Generator]) -> list[Transform]:
        """Return the transforms of the next minibatch, each one element per seed.

        Args:
            generators: one per seed; only `copies` "draw" uses them, and only if there is something to draw.
        """
        if self.transforms is None:
            return []
        if self.config.copies == "all" or self.transforms.size == 1:
            return self.transforms.each()
        return [self.transforms.draw(generators)]

    def for_replay(self, generators: Sequence[torch.Generator]) -> list[Transform]:
        """Return the transforms whose copies of new episodes an off-policy learner stores beside them."""
        return self.for_minibatch(generators) if self.config.augments_replay else []

    def for_batch(self, generators: Sequence[torch.Generator]) -> list[Transform]:
        """Return the transforms of the next batch out of a replay; none where nothing would use them."""
        used = self.config.augments_batches or self.config.coefficient > 0
        return self.for_minibatch(generators) if used else []

    def penalty(self, policy_gap: Tensor | None, value_gap: Tensor | None) -> Tensor:
        """Return c times the sum of the consistency terms that are on (Eq. 10); None is a term that isn't there."""
        gaps = {"policy": policy_gap, "value": value_gap}
        chosen = [gap for name, gap in gaps.items() if gap is not None and self.config.terms in ("both", name)]
        return self.config.coefficient * sum(chosen, start=torch.zeros(()))


def _probe(spec: TaskSpec, device: torch.device | str) -> list[Transform]:
    """Return a quarter turn and a mirror, as far as the task carries them, for measuring symmetry errors."""
    carried = carried_groups(spec)
    elements = ",".join(name for name, group in (("rot90", "c4"), ("flip-x", "d4")) if group in carried)
    return transform_set(elements, spec, device).each() if elements else []
