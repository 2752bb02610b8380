"""What a study or a search still costs on this machine: seconds by a short probe of each run."""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from esp_cli.files.formatting import format_count
from esp_cli.studies.run_set import Cell, RunSet
from esp_cli.studies.scheduler import makespan
from esp_cli.studies.study import StudyFolder
from esp_cli.training.build import PolicyController, build_environment, build_learner, generators, play
from esp_cli.training.config import RunConfig
from esp_envs.registry import task_class

PROBE_SECONDS = 1.0  # for which iterations of a run are timed, after a first that is not
_LONG_SECONDS = 3.0  # an iteration that takes as long is measured once
_PROBED_EPISODES = 8  # of an evaluation, at most; longer ones take their share more
_POLICIES = 3  # a final evaluation plays greedily, with drawn actions, at random, and with each heuristic of the task


@dataclass(frozen=True)
class Cost:
    """What one run takes on this machine, alone on one thread."""

    training_s: float  # for all of its steps, evaluations included
    evaluation_s: float  # for its final evaluation


# "finished" also where another study has the run; "twin" where another run of this one trains the same
RunStatus = Literal["waiting", "finished", "twin"]


@dataclass(frozen=True)
class RunForecast:
    """What is left of one run, or of a search and what judges it."""

    name: str
    status: RunStatus
    state: str  # the same in words, and how far it is
    steps: int  # environment steps per seed of the whole run
    step: int  # those that are done
    num_seeds: int
    seconds: float  # that are left, on one thread


@dataclass(frozen=True)
class Tuned:
    """Runs that are tuned and judged: of each that is left, which share of its training is."""

    trial: RunConfig  # all trials are taken to cost what this one does, and none to be pruned
    final: RunConfig  # the same of the runs that judge
    count: int  # of runs, done and left
    trials_left: Sequence[float]
    finals_left: Sequence[float]  # these are evaluated too


@dataclass(frozen=True)
class Forecast:
    """What is left of a study or a search."""

    title: str
    out: Path  # its folder
    jobs: int  # runs side by side
    seconds: float  # until the last run ends, where `jobs` run side by side and nothing else does
    core_seconds: float  # of all runs added up
    runs: tuple[RunForecast, ...]  # in the order in which they are begun


def forecast_study(
    folder: StudyFolder, others: Sequence[StudyFolder], jobs: int, listener: Callable[[int], object]
) -> Forecast:
    """Measure what is left of a study, whose folder need not exist; runs that cost the same are measured once."""
    known, runs, unlike = dict[str, Cost](), list[RunForecast](), folder.unlike(folder.study.cells)
    for cell in folder.study.cells:
        config, step, left = cell.config, folder.progress(cell)[0], 0.0
        status: RunStatus
        if folder.is_finished(cell) or folder.find_twin(cell, others) is not None:
            status, step, state = "finished", config.steps, "finished"
        elif cell not in unlike:
            status, state = "twin", f"like {next(first.name for first in unlike if first.config == config)}"
        else:
            status, state = "waiting", f"at {format_count(step)}" if step else "new"
            cost = _cost(config, folder.study.episodes, known)
            left = cost.training_s * (1 - step / config.steps) + cost.evaluation_s
        runs.append(RunForecast(cell.name, status, state, config.steps, step, len(config.seeds), left))
        listener(len(runs))
    left_s = [run.seconds for run in runs if run.status == "waiting"]
    return Forecast(folder.study.title, folder.path, jobs, makespan([], left_s, jobs), sum(left_s), tuple(runs))


def forecast_tuned(
    title: str, out: Path, searches: Mapping[str, Tuned], episodes: int, jobs: int, listener: Callable[[int], object]
) -> Forecast:
    """Measure what is left of searches, by name, and of the runs that judge once all trials have ended."""
    known, runs, tried, judged = dict[str, Cost](), list[RunForecast](), list[float](), list[float]()
    for name, one in searches.items():
        trials, finals = list[float](), list[float]()
        if one.trials_left:
            cost = _cost(one.trial, episodes, known)
            trials = [cost.training_s * share for share in one.trials_left]
        if one.finals_left:
            cost = _cost(one.final, episodes, known)
            finals = [cost.training_s * share + cost.evaluation_s for share in one.finals_left]
        status: RunStatus = "waiting" if trials or finals else "finished"
        state = f"{one.count - len(trials) - len(finals)} of {one.count} finished" if trials or finals else status
        seconds = sum(trials) + sum(finals)
        runs.append(RunForecast(name, status, state, one.trial.steps, 0, len(one.trial.seeds), seconds))
        tried += trials
        judged += finals
        listener(len(runs))
    seconds = makespan([], tried, jobs) + makespan([], judged, jobs)
    return Forecast(title, out, jobs, seconds, sum(tried) + sum(judged), tuple(runs))


def shares_left(folder: RunSet, cells: Sequence[Cell]) -> list[float]:
    """Return of each run that is not finished which share of its training is left."""
    return [1 - folder.progress(cell)[0] / cell.config.steps for cell in cells if not folder.is_finished(cell)]


def _cost(config: RunConfig, episodes: int, known: dict[str, Cost]) -> Cost:
    """Return what a run costs, measured once for those that differ in fractions alone, as in the size of a wind.

    Of fractions it counts whether they are 0, which switches things off; those of the task are left out.
    """
    parts = config.model_dump(mode="json", exclude={"prior": {"weights"}}) | {"seeds": len(config.seeds)}
    parts["task_settings"] = {k: v for k, v in parts["task_settings"].items() if not isinstance(v, float)}
    key = str(json.loads(json.dumps(parts), parse_float=lambda text: float(text) != 0))
    if key not in known:
        known[key] = measure(config, episodes)
    return known[key]


def measure(config: RunConfig, episodes: int) -> Cost:
    """Measure a run by some of its iterations and an evaluation, without writing anything."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as the runs of a study do
    try:
        learner = build_learner(config)
        iterations = -(-config.steps // learner.steps_per_iteration)
        clock, done = _clock(config), 0
        begun = clock()
        learner.iterate(0.0)
        per_iteration = clock() - begun
        if per_iteration < _LONG_SECONDS:  # else the warm-up of the first is lost in it
            begun = clock()
            while done == 0 or (clock() - begun < PROBE_SECONDS and done < iterations):
                learner.iterate(done / iterations)
                done += 1
            per_iteration = (clock() - begun) / done
        side_by_side = min(config.evaluation.episodes, _PROBED_EPISODES)
        env = build_environment(config, side_by_side, "probe")
        clock = _clock(config)
        begun = clock()
        play(env, PolicyController(learner.policy, generators(config.seeds, "probe")))
        per_episode = (clock() - begun) / side_by_side
    finally:
        torch.set_num_threads(threads)
    evaluations = 1 + config.steps // config.evaluation.every_steps
    return Cost(
        training_s=iterations * per_iteration + evaluations * 2 * config.evaluation.episodes * per_episode,
        evaluation_s=(_POLICIES + len(task_class(config.task).heuristics)) * episodes * per_episode,
    )


def _clock(config: RunConfig) -> Callable[[], float]:
    """Return the processor time of this process, or where it waits for a GPU or others, a clock on the wall."""
    alone = config.device == "cpu" and not multiprocessing.active_children()
    return time.process_time if alone else time.monotonic
