"""What a study, or a search, still costs on this machine: seconds by a short probe of each run."""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from esp_cli.files.formatting import format_count
from esp_cli.networks.policy import Policy
from esp_cli.studies.plan import Cell
from esp_cli.studies.scheduler import makespan
from esp_cli.studies.study import StudyFolder
from esp_cli.training.build import PolicyController, build_environment, build_learner, generators, play
from esp_cli.training.config import RunConfig
from esp_envs.errors import UserError
from esp_envs.registry import task_class

PROBE_SECONDS = 1.0  # for which iterations of a run are timed, after a first that is not
_LONG_SECONDS = 3.0  # an iteration that takes as long is measured once
_PROBED_EPISODES = 8, 32  # of an evaluation; longer ones take more by the line through both
_POLICIES = 3  # a final evaluation plays greedily, with drawn actions, at random, and with each heuristic of the task


@dataclass(frozen=True)
class Cost:
    """What one run takes on this machine, alone on one thread."""

    training_s: float  # for all of its steps, evaluations included
    evaluation_s: float  # for its final evaluation


@dataclass(frozen=True)
class RunForecast:
    """What is left of one run, or of a group of trials."""

    name: str
    # such as "new", "at 50k", "5 of 8 finished", "like NAME" where that run trains the same; "finished" also where
    # another study has the run
    status: str
    steps: int  # environment steps per seed of the whole run
    step: int  # those that are done
    num_seeds: int
    seconds: float  # that are left, on one thread


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
    known, runs, left_s = dict[str, Cost](), list[RunForecast](), list[float]()
    unlike = folder.unlike(folder.study.cells)
    for cell in folder.study.cells:
        config, step, left = cell.config, folder.progress(cell)[0], 0.0
        if folder.is_finished(cell) or folder.find_twin(cell, others) is not None:
            status, step = "finished", config.steps
        elif cell not in unlike:
            status = f"like {next(first.name for first in unlike if first.config == config)}"
        else:
            status, cost = f"at {format_count(step)}" if step else "new", _cost(config, folder.study.episodes, known)
            left = cost.training_s * (1 - step / config.steps) + cost.evaluation_s
            left_s.append(left)
        runs.append(RunForecast(cell.name, status, config.steps, step, len(config.seeds), left))
        listener(len(runs))
    return Forecast(folder.study.title, folder.path, jobs, makespan([], left_s, jobs), sum(left_s), tuple(runs))


def forecast_tuned(
    folder: StudyFolder, groups: Mapping[str, Sequence[Cell]], judged: Forecast, listener: Callable[[int], object]
) -> Forecast:
    """Measure what is left of trials, in groups with names, and add what is `judged` once they have ended.

    All trials of a group are taken to cost what its first one does.
    """
    known, runs, left_s = dict[str, Cost](), list[RunForecast](), list[float]()
    for name, cells in groups.items():
        config, left = cells[0].config, [cell for cell in cells if not folder.is_finished(cell)]
        seconds = _cost(config, 1, known).training_s if left else 0.0
        own = [seconds * (1 - folder.progress(cell)[0] / config.steps) for cell in left]
        status = f"{len(cells) - len(left)} of {len(cells)} finished" if left else "finished"
        runs.append(RunForecast(name, status, config.steps, 0, len(config.seeds), sum(own)))
        left_s += own
        listener(len(runs))
    seconds, core_seconds = makespan([], left_s, judged.jobs) + judged.seconds, sum(left_s) + judged.core_seconds
    return Forecast(folder.study.title, folder.path, judged.jobs, seconds, core_seconds, (*runs, *judged.runs))


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
    if config.device == "cuda" and not torch.cuda.is_available():
        raise UserError("this machine has no GPU, so it cannot tell what runs cost on one; leave out --dry-run")
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
        playing = _playing(config, learner.policy)
    finally:
        torch.set_num_threads(threads)
    evaluations = 1 + config.steps // config.evaluation.every_steps
    return Cost(
        training_s=iterations * per_iteration + evaluations * 2 * playing(config.evaluation.episodes),
        evaluation_s=(_POLICIES + len(task_class(config.task).heuristics)) * playing(episodes),
    )


def _playing(config: RunConfig, policy: Policy) -> Callable[[int], float]:
    """Return by number of episodes how long a policy takes to play them, side by side."""
    few, many = _PROBED_EPISODES

    def measured(episodes: int) -> float:
        env, clock = build_environment(config, episodes, "probe"), _clock(config)
        begun = clock()
        play(env, PolicyController(policy, generators(config.seeds, "probe")))
        return clock() - begun

    seconds = measured(few)
    each = seconds / few
    if seconds < PROBE_SECONDS:  # else the steps themselves are what takes the time
        each = min(each, max(0.0, measured(many) - seconds) / (many - few))
    return lambda episodes: max(0.0, seconds + (episodes - few) * each)


def _clock(config: RunConfig) -> Callable[[], float]:
    """Return the processor time of this process, or where it waits for a GPU or others, a clock on the wall."""
    alone = config.device == "cpu" and not multiprocessing.active_children()
    return time.process_time if alone else time.monotonic
