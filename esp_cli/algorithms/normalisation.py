"""Running statistics of value targets, one set per seed."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from esp_cli.algorithms.objectives import beside
from esp_cli.prior import mean_per_seed

_SMALLEST = 1e-6  # the least standard deviation: of rewards that are all 0, say
_RESOLUTION = 1e-7  # the least standard deviation in means
# deviations that the mean of rewards may be away from 0: more than in any built-in task (4 to 6 in navigation)
_FAR = 8.0
_SHARE = 0.01  # of small sums of rewards: the deviation of values before any is learned
_UNKNOWN = {"mean": 0.0, "variance": 1.0, "weight": 0.0, "offset": 0.0}  # statistics before the first update


class ValueNormaliser(nn.Module):
    """Keeps value targets [S, ...] near mean 0, variance 1 per seed, so that one learning rate fits every reward scale.

    An exponential moving average with bias correction (as for Adam's moments), after the MAPPO paper's code, which uses
    decay 0.99999 per update: nearly an average over all of training. It moves mean and variance themselves, in float64
    (West, 1979): a variance as a difference of large squares is lost beside a large mean. A seed in which nothing
    counts keeps its statistics. A learner takes `offset` [S] off its rewards; it is 0 until `begin` fixes another.
    """

    def __init__(self, num_seeds: int, decay: float) -> None:
        super().__init__()
        self.decay = decay
        self.mean: Tensor
        self.variance: Tensor
        self.weight: Tensor
        self.offset: Tensor
        for name, value in _UNKNOWN.items():
            self.register_buffer(name, torch.full((num_seeds,), value, dtype=torch.float64))

    def begin(self, reward: Tensor, steps: float, centres: bool) -> None:
        """Before the first update, fix from the first rewards what statistics cannot tell yet; later do nothing.

        Values before any is learned are what the critic outputs, or a hundredth of the sums of rewards over `steps`, if
        these are smaller than 1. If it `centres`, a mean that is many deviations away from 0 becomes the `offset`.
        """
        deviation, mean = torch.std_mean(reward.double().flatten(1), 1, correction=0)
        first, offset = self.weight == 0, torch.where(mean.abs() > _FAR * deviation, mean, 0.0)
        self.offset.copy_(torch.where(first & centres, offset, self.offset))
        square = (deviation.square() + (mean - self.offset).square()) * steps**2
        small = first & (square > 0) & (square < 1)
        self.variance.copy_(torch.where(small, _SHARE**2 * square, self.variance))

    def update(self, target: Tensor, valid: Tensor | None = None) -> None:
        """Take in a batch of targets, those alone that are `valid` (of the same shape) where that is given."""
        target = target.double()
        mean = mean_per_seed(target, valid)
        variance = mean_per_seed((target - beside(mean, target)).square(), valid)
        counts = torch.ones_like(mean) if valid is None else valid.flatten(1).any(1).double()
        share = (1 - self.decay) * counts
        self.weight.mul_(self.decay).add_(share)
        share, step = share / self.weight.clamp_min(1e-30), mean - self.mean
        self.variance.add_(share * step.square()).mul_(1 - share).add_(share * variance)
        self.mean.add_(share * step)

    def normalise(self, x: Tensor) -> Tensor:
        return ((x - beside(self.mean, x)) / self._deviation(x)).to(x.dtype)

    def scaled(self, x: Tensor) -> Tensor:
        """Return x / root mean square: a sum of such numbers ranks as the sum of x does, however many there are."""
        return (x / torch.hypot(beside(self.mean, x), self._deviation(x))).to(x.dtype)

    def denormalise(self, x: Tensor) -> Tensor:
        return (x * self._deviation(x) + beside(self.mean, x)).to(x.dtype)

    def _deviation(self, like: Tensor) -> Tensor:
        """Return the standard deviation; of numbers that are all alike, what float32 can tell apart."""
        return beside(self.variance.sqrt().maximum(_RESOLUTION * self.mean.abs()).clamp_min(_SMALLEST), like)


def with_variances(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the state of a learner with means and variances, where 0.1 kept decayed sums of means and mean squares."""
    out = dict(tensors)
    for name in ("normaliser", "reward_scale"):
        kept = [out[key] for part in ("mean", "square", "weight") if (key := f"{name}.{part}") in out]
        if len(kept) < 3 or len({x.shape for x in kept}) > 1:
            continue
        mean, square, weight = (x.double() for x in kept)
        mean, square = mean / weight.clamp_min(1e-8), square / weight.clamp_min(1e-8)
        del out[f"{name}.square"]
        variance = torch.where(weight > 0, (square - mean.square()).clamp_min(0.0), 1.0)
        state = {"mean": mean, "variance": variance, "weight": weight, "offset": torch.zeros_like(mean)}
        out |= {f"{name}.{part}": value for part, value in state.items()}
    return out
