"""What is left of a study, or what a search costs, by probes of its runs: time on a number of cores, and disk."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from esp_cli.studies.probe import Cost, Probes
from esp_cli.studies.run_set import Cell
from esp_cli.studies.scheduler import Status, makespan
from esp_cli.studies.study import StudyFolder
from esp_cli.studies.tuning import Tuning
from esp_cli.studies.tuning_space import space_of
from esp_cli.training.config import RunConfig

LIKELY_SHARE = 0.5
"""What a search takes of the steps of its trials; 0.44 to 0.56 where it was measured (docs/measurements/tuned.md)."""


@dataclass(frozen=True)
class RunForecast:
    """What is left of one run."""

    name: str  # of its cell
    # of its cell; "finished" also where another study has it, or another run of this one trains the same
    status: Status
    step: int  # environment steps per seed that are done
    seconds_left: float  # alone on one thread
    seconds: float | None  # of the whole run; None where nothing is left of it, which is not measured
    disk_bytes: int  # of what stays when it is done
    peak_bytes: int  # of what lies on the disk at most while it trains
    config: RunConfig  # what is run


@dataclass(frozen=True)
class Forecast:
    """What is left of a study."""

    kind: str  # of the study
    title: str  # of the study
    out: Path  # its folder
    jobs: int  # runs side by side
    seconds: float  # until the last run ends, where `jobs` run side by side and nothing else does
    core_seconds: float  # of all runs added up
    disk_bytes: int  # of the folder when all is done
    disk_peak_bytes: int  # of the folder at most, where the `jobs` runs that need most on the way end together
    runs: tuple[RunForecast, ...]  # in the order in which they are begun


@dataclass(frozen=True)
class SearchForecast:
    """What the search with one kind of prior costs, on one core."""

    prior: str  # its kind
    trials: int  # of the search
    settings: tuple[str, ...]  # names of what is searched
    default_s: float  # seconds of a whole trial with the default settings
    mean_s: float  # of one as the space has them on average, where what each setting costs multiplies
    longest_s: float  # of one with the values that take longest
    likely_s: float  # of the search with pruning, and of the runs on fresh seeds
    at_most_s: float  # of both, where every trial takes longest and none is pruned
    disk_bytes: int  # of the trials and the runs on fresh seeds when all is done, at most
    peak_bytes: int  # of what one run has on the disk on the way beyond that, at most


def forecast_study(
    folder: StudyFolder, others: Sequence[StudyFolder], jobs: int, listener: Callable[[int], object]
) -> Forecast:
    """Measure what is left of a study by probes of runs that are not finished.

    Args:
        folder: of the study; need not exist.
        others: studies whose finished runs are taken over.
        jobs: runs side by side.
        listener: told how many runs have been looked at.
    """
    study, probes = folder.study, Probes(folder.study.episodes)
    found: list[RunForecast] = []
    for cell in study.cells:
        twin = folder.run_path(cell) if folder.is_finished(cell) else folder.find_twin(cell, others)
        again = any(cell.config == earlier.config for earlier in found)  # an earlier run trains the same
        if twin is not None:
            found.append(_nothing_left(cell, _bytes_in(twin)))
        else:
            found.append(_left(cell, folder.progress(cell)[0], probes.cost(cell.config), again))
        listener(len(found))
    disk = sum(run.disk_bytes for run in found)
    extra = sorted((run.peak_bytes - run.disk_bytes for run in found), reverse=True)
    return Forecast(
        kind=study.kind,
        title=study.title,
        out=folder.path,
        jobs=jobs,
        seconds=makespan([], [run.seconds_left for run in found if run.status != "finished"], jobs),
        core_seconds=sum(run.seconds_left for run in found),
        disk_bytes=disk,
        disk_peak_bytes=disk + sum(extra[:jobs]),
        runs=tuple(found),
    )


def _left(cell: Cell, step: int, cost: Cost, again: bool) -> RunForecast:
    """Return what is left of a run at a step by what one costs; `again`: another one trains the same."""
    if again and not step:
        return _nothing_left(cell, cost.disk_bytes)
    whole = cost.training_s + cost.evaluation_s
    left = cost.training_s * (1 - step / cell.config.steps) + cost.evaluation_s
    return RunForecast(cell.name, "waiting", step, left, whole, cost.disk_bytes, cost.peak_bytes, cell.config)


def _nothing_left(cell: Cell, size: int) -> RunForecast:
    return RunForecast(cell.name, "finished", cell.config.steps, 0.0, None, size, size, cell.config)


def _bytes_in(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


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
    probes, space = Probes(episodes), space_of(tuning.space, prior)
    default = longest = largest = probes.cost(tuning.config(prior, {}))
    mean_s, slowest = default.training_s, dict[str, object]()
    for name, dimension in space.items():
        costs = [(probes.cost_if_trained(tuning.config(prior, {name: v})), v) for v in dimension.corners()]
        tried = [(cost, value) for cost, value in costs if cost is not None]
        if tried:
            mean_s *= fmean(cost.training_s for cost, _ in tried) / default.training_s
            slowest[name] = max(tried, key=lambda one: one[0].training_s)[1]
        longest = max([longest, *(cost for cost, _ in tried)], key=lambda cost: cost.training_s)
        largest = max([largest, *(cost for cost, _ in tried)], key=lambda cost: cost.peak_bytes)
        listener()
    longest = probes.cost_if_trained(tuning.config(prior, slowest)) or longest
    longest_s = max(longest.training_s, mean_s)
    judged = probes.cost(tuning.config(prior, {}, seeds))
    judged_s = judged.training_s + judged.evaluation_s
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
        disk_bytes=(tuning.budget + growth) * max(longest.disk_bytes, largest.disk_bytes) + judged.disk_bytes,
        peak_bytes=growth * max(one.peak_bytes - one.disk_bytes for one in (longest, largest)),
    )
