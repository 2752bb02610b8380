"""How far the mean return of one policy can be trusted by its episodes, where there are no other seeds to ask."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # its part "stats" takes a second to import, and does so where it is first used
from numpy.typing import ArrayLike

from esp_cli.policies.statistics import CONFIDENCE, Interval, bootstrap_interval, mean_and_sem


@dataclass(frozen=True)
class EpisodeSpread:
    """How far the mean return of one policy can be trusted, by its episodes; other seeds are another question.

    Attributes:
        sem: standard error of the mean over episodes; None for one episode.
        ci95: 95 % interval of the mean over episodes; None for one episode, or where all episodes are alike.
    """

    sem: float | None
    ci95: Interval | None


MOST_RESAMPLED = 512
"""More numbers than this have the interval of the normal distribution, from which the bootstrap's hardly differs."""


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
