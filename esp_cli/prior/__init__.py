"""ESP itself: symmetry as augmentation and as a consistency loss, one object that any learner is given."""

from typing import TYPE_CHECKING, Any

from esp_cli.prior.copies import Copies
from esp_cli.prior.losses import Loss, Term, policy_consistency_loss, value_consistency_loss
from esp_cli.prior.seed_batch import SeedBatch, average, mean_per_seed, shares
from esp_cli.prior.symmetry_prior import Answers, SymmetryPrior

if TYPE_CHECKING:
    from esp_cli.prior.config import PriorConfig

__all__ = [
    "Answers",
    "Copies",
    "Loss",
    "PriorConfig",
    "SeedBatch",
    "SymmetryPrior",
    "Term",
    "average",
    "mean_per_seed",
    "policy_consistency_loss",
    "shares",
    "value_consistency_loss",
]


def __getattr__(name: str) -> Any:
    """Import the settings when they are asked for: a foreign training loop has no use for pydantic."""
    if name == "PriorConfig":
        from esp_cli.prior.config import PriorConfig  # noqa: PLC0415 - see above

        return PriorConfig
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
