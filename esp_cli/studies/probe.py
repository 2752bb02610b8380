"""What one run costs on this machine: time from a short measured probe, and disk; nothing is written."""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from esp_cli.algorithms.learner import Learner
from esp_cli.training.build import build_environment, build_learner
from esp_cli.training.config import RunConfig
from esp_cli.training.play import PolicyController, play
from esp_cli.training.streams import generators
from esp_envs.errors import UserError
from esp_envs.registry import task_class

PROBE_SECONDS = 1.0  # how long iterations of a run are timed, after a first that is not
_LONG_SECONDS = 3.0  # an iteration that takes as long is measured once
_PROBED_EPISODES = 8  # of an evaluation, at most; longer ones take their share more
_CHECKPOINTS = 3  # two are kept while a third is written
_POLICIES = 3  # A final evaluation plays greedily, with drawn actions, at random, and with each heuristic of the task


@dataclass(frozen=True)
class Cost:
    """What one run takes on this machine, alone on one thread."""

    training_s: float  # for all of its steps, evaluations included
    evaluation_s: float  # for its final evaluation
    disk_bytes: int  # of what stays when it is done
    peak_bytes: int  # of what lies on the disk at most while it trains


class Probes:
    """Measures runs, once those that cost the same.

    Args:
        episodes: per seed, of a final evaluation.
    """

    def __init__(self, episodes: int) -> None:
        self._episodes = episodes
        self._known: dict[str, Cost] = {}

    def cost(self, config: RunConfig) -> Cost:
        """Return what a run costs.

        Raises:
            UserError: its parts do not go together.
        """
        key = cost_key(config)
        if key not in self._known:
            self._known[key] = probe(config, self._episodes)
        return self._known[key]

    def cost_if_trained(self, config: RunConfig) -> Cost | None:
        """Return what a run costs; None where its parts do not go together, so that it is not trained."""
        try:
            return self.cost(config)
        except UserError:
            return None


def cost_key(config: RunConfig) -> str:
    """Return what decides the cost of a run: equal for runs that differ in numbers alone, as in the size of a wind.

    Of a task's settings, fractions are left out; elsewhere it counts whether they are 0, which switches things off.
    """
    parts = config.model_dump(mode="json")
    task = {name: value for name, value in parts["task_settings"].items() if not isinstance(value, float)}
    prior = {name: value for name, value in parts["prior"].items() if name != "weights"}
    parts |= {"task_settings": task, "prior": prior, "seeds": len(config.seeds)}
    return json.dumps(_on_or_off(parts), sort_keys=True)


def _on_or_off(value: object) -> object:
    """Return nested settings with whether it is not 0 in the place of each fraction."""
    if isinstance(value, dict):
        return {name: _on_or_off(one) for name, one in value.items()}
    return value != 0 if isinstance(value, float) else value


def probe(config: RunConfig, episodes: int) -> Cost:
    """Measure a run by some of its iterations and an evaluation, without writing anything.

    Args:
        config: of the run.
        episodes: per seed, of its final evaluation.

    Raises:
        UserError: its parts do not go together.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as the runs of a study do
    try:
        return _measured(config, episodes)
    finally:
        torch.set_num_threads(threads)


def _measured(config: RunConfig, episodes: int) -> Cost:
    learner = build_learner(config)
    clock = _clock(config)
    iterations = -(-config.steps // learner.steps_per_iteration)
    begun = clock()
    metrics = learner.iterate(0.0).metrics
    per_iteration = clock() - begun
    if per_iteration < _LONG_SECONDS:  # else the warm-up of the first is lost in it
        done, begun = 0, clock()
        while done == 0 or (clock() - begun < PROBE_SECONDS and done < iterations):
            metrics = learner.iterate(done / iterations).metrics
            done += 1
        per_iteration = (clock() - begun) / done
    per_episode = _seconds_per_episode(config, learner)
    evaluations = 1 + config.steps // config.evaluation.every_steps
    weights = sum(tensor.nbytes for tensor in learner.policy.state_dict().values())
    row = len(json.dumps({name: value.tolist() for name, value in metrics.items()}))
    kept = weights + _bytes(learner, complete=True) + iterations * row
    return Cost(
        training_s=iterations * per_iteration + evaluations * 2 * config.evaluation.episodes * per_episode,
        evaluation_s=(_POLICIES + len(task_class(config.task).heuristics)) * episodes * per_episode,
        disk_bytes=kept,
        peak_bytes=kept + _CHECKPOINTS * (_bytes(learner) + learner.bytes_to_come(config.steps)),
    )


def _clock(config: RunConfig) -> Callable[[], float]:
    """Return what seconds are read from: the processor time of this process, to which other work adds little.

    Where a GPU or processes of their own for the worlds work, this one waits, and time is that of a clock on the wall.
    """
    alone = config.device == "cpu" and not multiprocessing.active_children()
    return time.process_time if alone else time.monotonic


def _seconds_per_episode(config: RunConfig, learner: Learner) -> float:
    """Return the seconds that one greedy episode of every seed takes, played side by side with others."""
    count = min(config.evaluation.episodes, _PROBED_EPISODES)
    env = build_environment(config, count, "probe")
    clock = _clock(config)
    begun = clock()
    play(env, PolicyController(learner.policy, generators(config.seeds, "probe")))
    return (clock() - begun) / count


def _bytes(learner: Learner, complete: bool = False) -> int:
    return sum(tensor.nbytes for tensor in learner.state_dict(complete).values())
