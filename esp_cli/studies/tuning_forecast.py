"""What a search costs before it is started: its trials differ in what they cost as in what they learn."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from esp_cli.studies.cost import Cost, cost_key, probe
from esp_cli.studies.tuning import Tuning
from esp_cli.studies.tuning_space import space_of

LIKELY_SHARE = 0.5
"""What a search takes of the steps of its trials; 0.44 to 0.56 where it was measured (docs/measurements/tuned.md)."""


@dataclass(frozen=True)
class SearchForecast:
    """What the search with one kind of prior costs, on one core.

    Attributes:
        prior: its kind.
        trials: of the search.
        settings: names of what is searched.
        default_s: seconds of a whole trial with the default settings.
        mean_s: of one as the space has them on average, where what each setting costs multiplies.
        longest_s: of one with the values that take longest.
        likely_s: of the search with pruning, and of the runs on fresh seeds.
        at_most_s: of both, where every trial takes longest and none is pruned.
        disk_bytes: of the trials and the runs on fresh seeds when all is done, at most.
        peak_bytes: of what one run has on the disk on the way beyond that, at most.
    """

    prior: str
    trials: int
    settings: tuple[str, ...]
    default_s: float
    mean_s: float
    longest_s: float
    likely_s: float
    at_most_s: float
    disk_bytes: int
    peak_bytes: int


def forecast_search(
    tuning: Tuning, prior: str, seeds: Sequence[int], episodes: int, listener: Callable[[], object]
) -> SearchForecast:
    """Measure what a search costs by probes of the default trial and of the ends of each setting's range.

    Args:
        tuning: what is asked for.
        prior: the kind of prior.
        seeds: of the runs that judge the best settings.
        episodes: per seed, of their final evaluations.
        listener: told after each setting.
    """
    known: dict[str, Cost] = {}

    def cost(settings: Mapping[str, object]) -> Cost | None:
        """Return what a trial with these settings costs; None where they do not go together and it is not trained."""
        config = tuning.config(prior, settings)
        key = cost_key(config)
        if key not in known:
            try:
                known[key] = probe(config, episodes)
            except ValueError:
                return None
        return known[key]

    default = probe(tuning.config(prior, {}), episodes)
    known[cost_key(tuning.config(prior, {}))] = default
    mean_s, slowest, largest = default.training_s, dict[str, object](), default
    space = space_of(tuning.space, prior)
    for name, dimension in space.items():
        tried = [(found, value) for value in dimension.corners() if (found := cost({name: value})) is not None]
        if tried:
            mean_s *= fmean(found.training_s for found, _ in tried) / default.training_s
            slowest[name] = max(tried, key=lambda one: one[0].training_s)[1]
        largest = max([largest, *(found for found, _ in tried)], key=lambda one: one.peak_bytes)
        listener()
    longest = cost(slowest) or max(known.values(), key=lambda one: one.training_s)
    longest_s = max(longest.training_s, mean_s)
    judged = probe(tuning.config(prior, {}, seeds), episodes)
    judged_s = judged.training_s + judged.evaluation_s
    bulk = max(longest.disk_bytes, largest.disk_bytes)
    growth = math.ceil(len(seeds) / len(tuning.trial_seeds))
    return SearchForecast(
        prior=prior,
        trials=tuning.budget,
        settings=tuple(space),
        default_s=default.training_s,
        mean_s=mean_s,
        longest_s=longest_s,
        likely_s=LIKELY_SHARE * tuning.budget * mean_s + judged_s * (1 + mean_s / default.training_s),
        at_most_s=tuning.budget * longest_s + judged_s * (1 + longest_s / default.training_s),
        disk_bytes=(tuning.budget + growth) * bulk + judged.disk_bytes,
        peak_bytes=growth * max(one.peak_bytes - one.disk_bytes for one in (longest, largest)),
    )
