"""ESP itself: symmetry as augmentation and as a consistency loss, one object that any learner is given."""

from esp_cli.prior.copies import Copies
from esp_cli.prior.losses import Loss, Term, value_consistency_loss
from esp_cli.prior.seed_batch import SeedBatch, mean_per_seed, shares
from esp_cli.prior.symmetry_prior import Answers, SymmetryPrior

__all__ = [
    "Answers",
    "Copies",
    "Loss",
    "SeedBatch",
    "SymmetryPrior",
    "Term",
    "mean_per_seed",
    "shares",
    "value_consistency_loss",
]
