"""ESP itself: symmetry as augmentation and as a consistency loss, one object that any learner is given."""

from esp_cli.prior.config import PriorConfig
from esp_cli.prior.losses import policy_consistency_loss, value_consistency_loss
from esp_cli.prior.symmetry_prior import SymmetryPrior

__all__ = ["PriorConfig", "SymmetryPrior", "policy_consistency_loss", "value_consistency_loss"]
