"""The object that a learner is given: it makes copies of experience and says what they are for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypedDict

import torch
from torch import Tensor

from esp_cli.prior.bandit import Bandit
from esp_cli.prior.copies import Copies
from esp_cli.prior.seed_batch import Rows
from esp_cli.symmetry import Transform, transform_set
from esp_cli.symmetry.admission import carries, under_a_compass, unrestricted
from esp_envs.errors import UserError
from esp_envs.spec import Spaces

if TYPE_CHECKING:
    from esp_cli.prior.config import PriorConfig


class Answers(TypedDict, total=False):
    """What networks say of rows: see `Copies.gaps`."""

    policy: tuple[Any, Tensor]
    value: Tensor


class SymmetryPrior:
    """A known symmetry of some spaces, ready for use in a learner's update.

    Attributes:
        config: what the user chose.
        augments: whether copies of a batch enter the learner's own loss.
        transforms: the elements that copies are made with; None without a prior.
        strength: the probability with which a drawn element is used, 0 to 1; see `begin`.
    """

    def __init__(
        self, config: PriorConfig, spaces: Spaces, device: torch.device | str = "cpu", replays: bool = False
    ) -> None:
        self.config = config
        if config.trust == "gate":
            raise UserError("prior.trust=gate can no longer be trained; choose measured, or evaluate a run that has it")
        self._stores = config.augments and replays and config.replay == "stored"
        self.augments = config.augments and not self._stores
        active = config.augments or config.coefficient > 0
        admitting = spaces
        if not config.needs_declaration:
            admitting = under_a_compass(spaces) if config.compass else unrestricted(spaces)
        self.transforms = transform_set(config.transforms, admitting, device) if active else None
        if self.transforms is not None and config.copies != "draw" and not self.transforms.is_finite:
            told = f"prior.copies={config.copies} needs a finite group, but '{config.transforms}' is infinite"
            raise UserError(f"{told}; use draw")
        if config.copies == "bandit" and (config.trust != "full" or config.fade or config.compass):
            raise UserError("prior.copies=bandit finds what helps by itself; leave prior.trust, fade and compass out")
        self._probe = _probe(spaces, device)
        self.strength = 1.0
        self._weights = self._weigh()
        self._bandit: Bandit | None = None

    def begin(self, progress: float) -> None:
        """Set how strong the prior is from here on: 1 - progress / fade, or 1 where it does not fade.

        Where trust is not full, elements of weight 1 are certain and do not fade; the others do. Elements are drawn in
        proportion to strength x weight, and the identity takes their place with 1 minus the largest of these. A copy by
        the identity adds nothing to a mean loss, and its consistency terms are 0: the share of copies and c fall in
        proportion, in expectation.
        """
        self.strength = max(0.0, 1.0 - progress / self.config.fade) if self.config.fade else 1.0

    def learned(self, returns: Tensor) -> None:
        """End an iteration whose episodes had these mean training returns, [S]; a bandit chooses by them."""
        if self.config.copies == "bandit" and self.transforms is not None:
            self._bandit = self._bandit or Bandit(len(returns), self.transforms.size + 1)
            self._bandit.step(returns.cpu())

    def state_dict(self) -> dict[str, Tensor]:
        """Return what a resumed run needs, beside the generators."""
        return self._bandit.state_dict() if self._bandit else {}

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        if tensors and self.transforms is not None:
            self._bandit = Bandit(len(tensors["arm"]), self.transforms.size + 1)
            for name, value in self._bandit.state_dict().items():
                value.copy_(tensors[name])

    def _weigh(self) -> list[float]:
        names = self.transforms.names if self.transforms is not None else ()
        if self.config.trust == "full":
            return [1.0] * len(names)
        if set(self.config.weights) != set(names) and names:
            told = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
            raise UserError(
                f"prior.trust is {self.config.trust}, but prior.weights does not weigh just these elements: {told}; "
                "weigh each, or have them weighed by --set prior.weights={}"
            )
        return [self.config.weights[name] for name in names]

    @property
    def num_copies(self) -> int:
        """Transformed copies of every row."""
        if self.transforms is None:
            return 0
        return self.transforms.size if self.config.copies == "all" else 1

    @property
    def num_stored(self) -> int:
        """Copies of every episode that a replay stores."""
        return self.num_copies if self._stores else 0

    def augmented_share(self, num_seeds: int) -> Tensor:
        """Return the share of the rows in a learner's own loss that are copies, [S]."""
        keep = self._keep()
        kept = max(keep, default=0.0) if self._draws_one else sum(keep) / max(1, len(keep))
        used = torch.full((num_seeds,), kept)
        if self._bandit:
            used = (self._bandit.arm < self._bandit.num_arms - 1).float()
        return used * self.num_copies / (1 + self.num_copies) * self.config.augments

    @property
    def recomputes(self) -> bool:
        """Whether a copy's old log-probability is recomputed instead of copied (Eq. 7)."""
        return self.augments and self.config.old_log_prob == "recompute"

    def copies(
        self, batch: Rows, generators: Sequence[torch.Generator], adapt: Callable[[Rows], Rows] | None = None
    ) -> Copies[Rows]:
        """Return a batch with the copies for its gradient step; without any where nothing would use them.

        The generators, one per seed, are used only if there is something to draw. `adapt` is what the learner changes
        in a copy that transforming alone leaves wrong.
        """
        used = self.augments or self.config.coefficient > 0
        return Copies(self.config, batch, self._draw(generators) if used else [], self.augments, adapt)

    def stored(self, batch: Rows, generators: Sequence[torch.Generator]) -> list[Rows]:
        """Return the copies of new experience that a replay stores with it."""
        return [batch.transformed(g) for g in self._draw(generators)] if self._stores else []

    @torch.no_grad()
    def errors(self, batch: Rows, evaluate: Callable[[Rows], Answers]) -> dict[str, Tensor]:
        """Measure how far networks are from symmetry, with a prior or without, on fixed elements.

        Returns:
            "policy_symmetry_error" and "value_symmetry_error", [S] each, as far as `evaluate` answers; empty where the
            task carries neither a quarter turn nor a mirror.
        """
        if not self._probe:
            return {}
        copies = Copies(self.config, batch, self._probe, augments=True)
        return {f"{name}_symmetry_error": gap for name, gap in copies.gaps(**evaluate(copies.rows)).items()}

    def _draw(self, generators: Sequence[torch.Generator]) -> list[Transform]:
        keep = self._keep()
        if self.transforms is None or not any(keep):
            return []
        if self.config.copies == "bandit":
            return [self.transforms.chosen(self._bandit.arm.tolist() if self._bandit else [0] * len(generators))]
        if all(share == 1 for share in keep):
            return [self.transforms.draw(generators)] if self._draws_one else self.transforms.each()
        if self._draws_one:
            return [self.transforms.draw(generators, keep)]
        return [self.transforms.kept(index, share, generators) for index, share in enumerate(keep)]

    @property
    def _draws_one(self) -> bool:
        return self.config.copies == "draw" and self.transforms is not None and self.transforms.size != 1

    def _keep(self) -> list[float]:
        """Return for each element how likely it is used now, beside the others."""
        if self.config.trust == "full":
            return [self.strength] * len(self._weights)
        return [1.0 if weight == 1 else self.strength * weight for weight in self._weights]


def _probe(spaces: Spaces, device: torch.device | str) -> list[Transform]:
    """Return a quarter turn and a mirror, as far as the task carries them, for measuring symmetry errors."""
    elements = [name for name in ("rot90", "flip-x") if carries(name, spaces)]
    return transform_set(",".join(elements), spaces, device).each() if elements else []
