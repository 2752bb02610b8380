"""ESP itself: symmetry as augmentation and as a consistency loss, one object that any learner is given."""

from esp_cli.prior.config import PriorConfig
from esp_cli.prior.copies import Copies
from esp_cli.prior.losses import policy_consistency_loss, value_consistency_loss
from esp_cli.prior.seed_batch import SeedBatch, mean_per_seed
from esp_cli.prior.symmetry_prior import Answers, SymmetryPrior

__all__ = [
    "Answers",
    "Copies",
    "PriorConfig",
    "SeedBatch",
    "SymmetryPrior",
    "mean_per_seed",
    "policy_consistency_loss",
    "value_consistency_loss",
]
