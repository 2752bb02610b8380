"""Statistics over seeds: means with intervals, comparisons of two groups of seeds, learning curves.

A sample is one finite number per seed [S], or a UserError; never one per episode: episodes of one seed share its policy
and say nothing about how another seed would turn out (`spread_over_episodes` is for a policy without other seeds).
Intervals are 95 % percentile bootstrap intervals over seeds with a fixed generator, so that the same numbers give the
same interval; with few seeds they are too narrow (of ten seeds drawn from a normal distribution, 90 % of the intervals
hold its mean, of three 75 %, of two 50 %). They are None where the bootstrap cannot tell: one seed, or resamples that
all agree. A curve has ascending steps [K], env steps per seed, and values [K, S], or a UserError.

Source: Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice", NeurIPS 2021
(interquartile mean, bootstrap intervals, probability of improvement).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy  # its part "stats" takes a second to import, and does so where it is first used
from numpy.typing import ArrayLike, NDArray

from esp_envs.errors import UserError

CONFIDENCE = 0.95
RESAMPLES = 10_000
_MOST_RANKED = 100  # values of two samples of which all orders are counted
MOST_RESAMPLED = 512  # episodes; more have the interval of the normal distribution, which hardly differs

Floats = NDArray[np.float64]
Interval = tuple[float, float]


@dataclass(frozen=True)
class Estimate:
    """A number on the seeds at hand, and its 95 % interval."""

    value: float
    ci95: Interval | None


@dataclass(frozen=True)
class SeedSummary:
    """One number per seed, and what they say together; the numbers of seeds that stopped are left out."""

    mean: float | None  # None where every seed stopped
    sem: float | None  # standard error of the mean; None for one seed
    ci95: Interval | None  # of the mean
    per_seed: tuple[float | None, ...]  # [S]; None where a seed stopped


@dataclass(frozen=True)
class EpisodeSpread:
    """How far the mean return of one policy can be trusted by its episodes; other seeds are another question."""

    sem: float | None  # None for one episode
    ci95: Interval | None  # None for one episode, or where all are alike


def summarise(values: ArrayLike) -> SeedSummary:
    """Summarise one number per seed [S], NaN where a seed stopped."""
    numbers = np.asarray(values, dtype=np.float64)
    good = numbers[np.isfinite(numbers)]
    per_seed = tuple(float(x) if np.isfinite(x) else None for x in numbers)
    mean, sem = mean_and_sem(good) if good.size else (None, None)
    return SeedSummary(mean, sem, bootstrap_interval(good) if good.size else None, per_seed)


def spread_over_episodes(returns: ArrayLike) -> EpisodeSpread:
    """Return standard error and 95 % interval of the mean over the episodes of one policy."""
    sample = np.asarray(returns, dtype=np.float64)
    mean, sem = mean_and_sem(sample)
    if not sem:
        return EpisodeSpread(sem, None)
    if sample.size <= MOST_RESAMPLED:
        return EpisodeSpread(sem, bootstrap_interval(sample))
    reach = float(scipy.stats.norm.ppf((1 + CONFIDENCE) / 2)) * sem
    return EpisodeSpread(sem, (mean - reach, mean + reach))


def mean_and_sem(values: ArrayLike) -> tuple[float, float | None]:
    """Return the mean and its standard error, s / sqrt(S) with S - 1 in the variance; None for one seed."""
    sample = _sample(values)
    return float(sample.mean()), float(scipy.stats.sem(sample)) if sample.size > 1 else None


def bootstrap_interval(values: ArrayLike) -> Interval | None:
    """Return the 95 % bootstrap interval of the mean over seeds."""
    return _interval((_sample(values),), np.mean)


def interquartile_mean(values: ArrayLike) -> Estimate:
    """Return the mean of the middle half: a quarter of the seeds, rounded down, is left out at either end."""
    sample = _sample(values)
    return Estimate(float(_iqm(sample)), _interval((sample,), _iqm))


def difference(x: ArrayLike, y: ArrayLike, paired: bool = False) -> Estimate:
    """Return mean(x) - mean(y); paired, seed k of x and of y belong together (S = S'), as where they share worlds."""
    first, second = _sample(x), _sample(y)
    value = float(first.mean() - second.mean())
    if paired:
        return Estimate(value, _interval((first - second,), np.mean))
    return Estimate(value, _interval((first, second), lambda x, y, axis: x.mean(axis=axis) - y.mean(axis=axis)))


def probability_of_improvement(x: ArrayLike, y: ArrayLike, paired: bool = False) -> Estimate:
    """Return the probability that a seed of x beats a seed of y, P(X > Y) + P(X = Y) / 2.

    Unpaired, all S * S' pairs count: the Mann-Whitney U of x over S * S'. Paired, seed k meets seed k only.
    """
    first, second = _sample(x), _sample(y)
    if paired:
        wins = _wins(first, second)
        return Estimate(float(wins.mean()), _interval((wins,), np.mean))
    u = scipy.stats.mannwhitneyu(first, second).statistic
    return Estimate(float(u) / (first.size * second.size), _interval((first, second), _share_of_wins))


def rank_sum_p(x: ArrayLike, y: ArrayLike) -> float:
    """Return the two-sided p of the rank-sum test (Mann and Whitney): how likely so unequal samples of one law are.

    It is exact up to 100 values, with ties too, of which scipy takes the normal approximation.
    """
    first, second = _sample(x), _sample(y)
    if first.size + second.size > _MOST_RANKED:
        return float(scipy.stats.mannwhitneyu(first, second).pvalue)
    ranks = (2 * scipy.stats.rankdata([*first, *second])).astype(np.int64)  # tied values share the middle of theirs
    ways = np.zeros((first.size + 1, int(ranks.sum()) + 1))  # [k, s]: to choose k of the ranks so far with the sum s
    ways[0, 0] = 1
    for rank in ranks:
        ways[1:, rank:] += ways[:-1, :-rank].copy()
    chances, own = ways[-1] / ways[-1].sum(), ranks[: first.size].sum()
    return float(min(1.0, 2 * min(chances[: own + 1].sum(), chances[own:].sum())))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values corrected for their number (Holm, 1979): the k-th smallest of m, k from 0, times m - k.

    A corrected value is at least that of every smaller one, and at most 1.
    """
    corrected, largest = [0.0] * len(p_values), 0.0
    for k, index in enumerate(np.argsort(p_values, kind="stable")):
        largest = max(largest, min(1.0, (len(p_values) - k) * p_values[index]))
        corrected[index] = largest
    return corrected


def leader(
    ours: tuple[float, float | None, int], others: tuple[float, float | None, int]
) -> Literal["first", "second", "neither"] | None:
    """Return which of two published (mean, s.e.m., seeds) is higher by Welch's t-test at 5 %, if any."""
    (mean, sem, count), (other, other_sem, other_count) = ours, others
    if sem is None or other_sem is None or min(count, other_count) < 2 or sem == other_sem == 0:
        return None
    deviation, other_deviation = sem * np.sqrt(count), other_sem * np.sqrt(other_count)
    test = scipy.stats.ttest_ind_from_stats(
        mean, deviation, count, other, other_deviation, other_count, equal_var=False
    )
    if test.pvalue >= 1 - CONFIDENCE:
        return "neither"
    return "first" if mean > other else "second"


def normalised(values: ArrayLike, anchors: Mapping[str, float]) -> Floats | None:
    """Normalise returns by those of reference policies: 0 is "random", 1 the best other; None without a scale."""
    low, high = anchors.get("random", np.nan), max((v for k, v in anchors.items() if k != "random"), default=np.nan)
    return (np.asarray(values, dtype=np.float64) - low) / (high - low) if low < high else None


@dataclass(frozen=True)
class Passing:
    """Env steps per seed at which a learning curve first is at or above a threshold; None where it never is."""

    threshold: float
    of_mean: int | None  # by the mean over seeds
    per_seed: tuple[int | None, ...]  # by each seed


def steps_to_threshold(steps: ArrayLike, values: ArrayLike, threshold: float) -> Passing:
    """Return when a learning curve first is at or above a threshold; evaluations are not interpolated."""
    at, curves = _curves(steps, values)
    curves = np.where(np.isfinite(curves), curves, np.nan)

    def first(reached: NDArray[np.bool_]) -> int | None:
        return int(at[np.argmax(reached)]) if reached.any() else None

    per_seed = tuple(first(curve >= threshold) for curve in curves.T)
    return Passing(threshold, first(curves.mean(axis=1) >= threshold), per_seed)


def median_steps(per_seed: Sequence[int | None]) -> tuple[float, Interval | None]:
    """Return the median over seeds of their first steps at a threshold, and its interval; infinite stands for never.

    The interval lies between two order statistics and holds for any distribution: of ten seeds it goes from the second
    to the ninth and holds the median with 97.9 %, at least 95 % being asked for. Fewer than six seeds have none.
    """
    ordered = sorted(np.inf if steps is None else float(steps) for steps in per_seed)
    rank = int(scipy.stats.binom.ppf((1 - CONFIDENCE) / 2, len(ordered), 0.5))
    return float(np.median(ordered)), (ordered[rank - 1], ordered[-rank]) if rank else None


def area_under_curve(steps: ArrayLike, values: ArrayLike) -> Floats:
    """Return each seed's mean height [S], integral(value) / (last - first step) by the trapezoidal rule, K > 1."""
    at, curves = _curves(steps, values)
    return np.asarray(scipy.integrate.trapezoid(curves, at, axis=0) / (at[-1] - at[0]), dtype=np.float64)


def curve_band(values: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Return mean, lower and upper edge of a learning curve [K, S] over seeds, each [K].

    The bootstrap redraws whole seeds: the same ones at every step. With one seed the edges are the curve; where a seed
    is not finite all three are NaN, so that a stopped seed leaves a gap instead of a mean over the others.
    """
    curves = np.asarray(values, dtype=np.float64)
    whole = np.isfinite(curves).all(axis=1)
    mean = np.full(len(curves), np.nan)
    mean[whole] = curves[whole].mean(axis=1)
    low, high = mean.copy(), mean.copy()
    if curves.shape[1] > 1 and whole.any():
        interval = bootstrap((curves[whole],), np.mean, 2000)
        low[whole], high[whole] = interval.low, interval.high
    return mean, low, high


def _curves(steps: ArrayLike, values: ArrayLike) -> tuple[Floats, Floats]:
    at, curves = np.asarray(steps, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if not (np.diff(at) > 0).all():
        raise UserError("the steps of a learning curve have to ascend")
    return at, curves


def _interval(samples: tuple[Floats, ...], statistic: Callable[..., Any]) -> Interval | None:
    if any(sample.size < 2 for sample in samples):
        return None
    interval = bootstrap(samples, statistic)
    low, high = float(interval.low), float(interval.high)
    return (low, high) if low < high else None


def bootstrap(samples: tuple[Floats, ...], statistic: Callable[..., Any], resamples: int = RESAMPLES) -> Any:
    """Return scipy's percentile interval of a statistic of independent samples, with this module's generator."""
    return scipy.stats.bootstrap(
        samples,
        statistic,
        n_resamples=resamples,
        batch=500,
        vectorized=True,
        axis=-1,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval


def _iqm(values: Floats, axis: int = -1) -> Any:
    return scipy.stats.trim_mean(values, 0.25, axis=axis)


def _wins(x: Floats, y: Floats) -> Floats:
    return (x > y) + 0.5 * (x == y)


def _share_of_wins(x: Floats, y: Floats, axis: int = -1) -> Any:
    """Return the mean over all pairs; the samples' axis has to be the last."""
    del axis
    return _wins(x[..., :, None], y[..., None, :]).mean(axis=(-2, -1))


def _sample(values: ArrayLike) -> Floats:
    sample = np.asarray(values, dtype=np.float64)
    if sample.ndim != 1 or sample.size == 0:
        raise UserError(f"the values have to be one number per seed, not of shape {list(sample.shape)}")
    bad = np.flatnonzero(~np.isfinite(sample)).tolist()
    if bad:
        raise UserError(f"the values are not finite at index {bad}; leave those seeds out and say so beside the result")
    return sample
