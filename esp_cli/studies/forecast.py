"""What is left of a study: time and disk of each run, and of all runs on a number of cores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from esp_cli.studies.cost import Cost, cost_key, probe
from esp_cli.studies.scheduler import Run, Status, makespan
from esp_cli.studies.study import StudyFolder
from esp_cli.training.config import RunConfig


@dataclass(frozen=True)
class RunForecast:
    """What is left of one run.

    Attributes:
        name: of its cell.
        status: of its cell; "finished" also where another study has it, or another run of this one trains the same.
        step: environment steps per seed that are done.
        seconds_left: alone on one thread.
        seconds: of the whole run; None where nothing is left of it, which is not measured.
        disk_bytes: of what stays when it is done.
        peak_bytes: of what lies on the disk at most while it trains.
        config: what is run.
    """

    name: str
    status: Status
    step: int
    seconds_left: float
    seconds: float | None
    disk_bytes: int
    peak_bytes: int
    config: RunConfig


@dataclass(frozen=True)
class Forecast:
    """What is left of a study.

    Attributes:
        kind: of the study.
        title: of the study.
        out: its folder.
        jobs: runs side by side.
        seconds: until the last run ends, where `jobs` run side by side and nothing else does.
        core_seconds: of all runs added up.
        disk_bytes: of the folder when all is done.
        disk_peak_bytes: of the folder at most, where the `jobs` runs that need most on the way end together.
        runs: in the order in which they are begun.
    """

    kind: str
    title: str
    out: Path
    jobs: int
    seconds: float
    core_seconds: float
    disk_bytes: int
    disk_peak_bytes: int
    runs: tuple[RunForecast, ...]


def forecast(
    folder: StudyFolder, others: Sequence[StudyFolder], jobs: int, listener: Callable[[int], object]
) -> Forecast:
    """Measure what is left of a study by probes of runs that are not finished, without writing anything.

    Runs that cost the same, whatever the numbers in their settings, are measured once.

    Args:
        folder: of the study; need not exist.
        others: studies whose finished runs are taken over.
        jobs: runs side by side.
        listener: told how many runs have been looked at.
    """
    study, costs = folder.study, dict[str, Cost]()
    found: list[RunForecast] = []
    for cell in study.cells:
        run = Run.found(folder, cell)
        twin = folder.run_path(cell) if run.status == "finished" else folder.find_twin(cell, others)
        if twin is not None:
            found.append(_finished(run, twin))
        else:
            if (key := cost_key(cell.config)) not in costs:
                costs[key] = probe(cell.config, study.episodes)
            again = any(cell.config == earlier.config for earlier in found)
            found.append(_measured(run, costs[key], again))
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


def _finished(run: Run, path: Path) -> RunForecast:
    size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    config = run.cell.config
    return RunForecast(run.cell.name, "finished", config.steps, 0.0, None, size, size, config)


def _measured(run: Run, cost: Cost, again: bool) -> RunForecast:
    """Return the forecast of a run by what one costs; `again`: an earlier run trains the same."""
    config = run.cell.config
    if again and not run.step:
        return RunForecast(run.cell.name, "finished", config.steps, 0.0, None, cost.disk_bytes, cost.disk_bytes, config)
    left = cost.training_s * (1 - run.step / config.steps) + cost.evaluation_s
    whole = cost.training_s + cost.evaluation_s
    return RunForecast(run.cell.name, run.status, run.step, left, whole, cost.disk_bytes, cost.peak_bytes, config)
