"""Statistics of learning curves over seeds: bands, first steps at a threshold, mean heights.

A curve has ascending steps [K], env steps per seed, and values [K, S]; other shapes raise a UserError.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # its part "stats" takes a second to import, and does so where it is first used
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import trapezoid

from esp_cli.policies.statistics import CONFIDENCE, Floats, Interval, bootstrap
from esp_envs.errors import UserError

_RESAMPLES = 2_000


@dataclass(frozen=True)
class Passing:
    """Env steps per seed at which a learning curve first is at or above a threshold; None where it never is."""

    threshold: float
    of_mean: int | None  # by the mean over seeds
    per_seed: tuple[int | None, ...]  # by each seed


def steps_to_threshold(steps: ArrayLike, values: ArrayLike, threshold: float) -> Passing:
    """Return when a learning curve first is at or above a threshold; evaluations are not interpolated.

    Higher is better. A value that is not finite, as of a seed that was stopped, reaches nothing.
    """
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
    """Return each seed's mean height, integral(value) / (last step - first step) by the trapezoidal rule [S], K > 1.

    A value NaN gives that seed NaN.
    """
    at, curves = _curves(steps, values)
    if at.size < 2:
        raise UserError("the area under a curve needs two evaluations or more")
    return np.asarray(trapezoid(curves, at, axis=0) / (at[-1] - at[0]), dtype=np.float64)


def curve_band(values: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Return mean, lower and upper edge of a learning curve [K, S] over seeds, each [K].

    The bootstrap redraws whole seeds: the same ones at every step. With one seed the edges are the curve; where a seed
    is not finite all three are NaN, so that a stopped seed leaves a gap instead of a mean over the survivors.
    """
    curves = np.asarray(values, dtype=np.float64)
    if curves.ndim != 2 or curves.shape[1] == 0:
        raise UserError(f"learning curves are evaluations by seeds [K, S], not of shape {list(curves.shape)}")
    whole = np.isfinite(curves).all(axis=1)
    mean = np.full(len(curves), np.nan)
    mean[whole] = curves[whole].mean(axis=1)
    low, high = mean.copy(), mean.copy()
    if curves.shape[1] > 1 and whole.any():
        interval = bootstrap((curves[whole],), np.mean, _RESAMPLES)
        low[whole], high[whole] = interval.low, interval.high
    return mean, low, high


def _curves(steps: ArrayLike, values: ArrayLike) -> tuple[Floats, Floats]:
    at, curves = np.asarray(steps, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if at.ndim != 1 or curves.ndim != 2 or curves.shape[0] != at.size or curves.size == 0:
        raise UserError(
            f"a learning curve is steps [K] and values [K, S], not {list(at.shape)} and {list(curves.shape)}"
        )
    if not (np.diff(at) > 0).all():
        raise UserError("the steps of a learning curve have to ascend")
    return at, curves
