"""Running statistics of value targets, one set per seed."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from esp_cli.prior import mean_per_seed


class ValueNormaliser(nn.Module):
    """Keeps value targets near mean 0, variance 1 per seed, so that one learning rate fits every reward scale.

    An exponential moving average with bias correction (as for Adam's moments), after the MAPPO paper's code, which
    uses decay 0.99999 per update: nearly an average over all of training.

    Shape:
        Every argument is [S, ...]; statistics are over all other axes.
    """

    def __init__(self, num_seeds: int, decay: float) -> None:
        super().__init__()
        self.decay = decay
        self.mean: Tensor
        self.square: Tensor
        self.weight: Tensor
        self.register_buffer("mean", torch.zeros(num_seeds))
        self.register_buffer("square", torch.zeros(num_seeds))
        self.register_buffer("weight", torch.zeros(num_seeds))

    def update(self, target: Tensor, valid: Tensor | None = None) -> None:
        """Take in a batch of targets, those alone that are `valid` (of the same shape) where that is given."""
        mean, square = mean_per_seed(target, valid), mean_per_seed(target.square(), valid)
        for buffer, value in ((self.mean, mean), (self.square, square)):
            buffer.mul_(self.decay).add_(value, alpha=1 - self.decay)
        self.weight.mul_(self.decay).add_(1 - self.decay)

    def _statistics(self, like: Tensor) -> tuple[Tensor, Tensor]:
        weight = self.weight.clamp_min(1e-8)
        mean = self.mean / weight
        variance = torch.where(self.weight > 0, self.square / weight - mean.square(), 1.0)
        shape = (-1, *[1] * (like.dim() - 1))
        return mean.view(shape), variance.clamp_min(1e-4).sqrt().view(shape)

    def normalise(self, x: Tensor) -> Tensor:
        """Return (x - mean) / deviation."""
        mean, deviation = self._statistics(x)
        return (x - mean) / deviation

    def scaled(self, x: Tensor) -> Tensor:
        """Return x / root mean square: a sum of such numbers ranks as the sum of x does, however many there are."""
        square = torch.where(self.weight > 0, self.square / self.weight.clamp_min(1e-8), 1.0)
        return x / square.clamp_min(1e-4).sqrt().view(-1, *[1] * (x.dim() - 1))

    def denormalise(self, x: Tensor) -> Tensor:
        """Return x * deviation + mean."""
        mean, deviation = self._statistics(x)
        return x * deviation + mean
