"""The verdict on a trained policy: greedy and stochastic returns with intervals, beside the task's anchors."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from esp_cli import __version__
from esp_cli.evaluation.statistics import bootstrap_interval, mean_and_sem
from esp_cli.training.loading import TrainedPolicy
from esp_cli.training.play import (
    Controller,
    Episodes,
    HeuristicController,
    PolicyController,
    RandomController,
    play,
)
from esp_cli.training.streams import generators
from esp_cli.training.trainer import build_environment
from esp_envs.registry import task_class

MAX_WORLDS = 4096
"""Worlds played at once, over all seeds; more episodes are played one batch after the other."""


def judge(trained: TrainedPolicy, episodes: int) -> dict[str, Any]:
    """Play `episodes` episodes per seed with each controller.

    Returns:
        A JSON-able dict: esp_version, task, task_version, convention, episodes, greedy and stochastic (each mean, sem,
        ci95 over seeds, per_seed), anchors (random, heuristic, and the task's other heuristics; one number each),
        heuristics (their names, the one called "heuristic" first), metrics (of the greedy policy) and metrics_per_seed,
        anchor_metrics (the same of each anchor), task_settings.
    """
    seeds = trained.config.seeds
    greedy = play_batches(trained, PolicyController(trained.policy), "greedy", episodes)
    drawn = PolicyController(trained.policy, generators(seeds, "judgement", "noise"))
    stochastic = play_batches(trained, drawn, "stochastic", episodes)
    names = task_class(trained.config.task).heuristics
    anchors = {"random": play_batches(trained, RandomController(), "random", episodes)}
    for index, name in enumerate(names):
        key = "heuristic" if index == 0 else name
        anchors[key] = play_batches(trained, HeuristicController(name), "heuristic", episodes)
    return {
        "esp_version": __version__,
        "task": trained.config.task,
        "task_version": trained.spec.version,
        "convention": trained.spec.convention,
        "task_settings": trained.config.task_settings,
        "source": str(trained.source),
        "step": trained.step,
        "seeds": list(seeds),
        "episodes": episodes,
        "greedy": summary(greedy.returns),
        "stochastic": summary(stochastic.returns),
        "anchors": {name: float(played.returns.mean()) for name, played in anchors.items()},
        "heuristics": list(names),
        "metrics": _means(greedy),
        "metrics_per_seed": {name: value.mean(1).tolist() for name, value in greedy.metrics.items()},
        "anchor_metrics": {name: _means(played) for name, played in anchors.items()},
    }


def summary(returns: Tensor) -> dict[str, Any]:
    """Return mean, s.e.m. and 95 % bootstrap interval over seeds of returns [S, episodes], and the seeds' means."""
    per_seed = returns.mean(1).double().cpu().numpy()
    mean, sem = mean_and_sem(per_seed)
    interval = bootstrap_interval(per_seed)
    return {"mean": mean, "sem": sem, "ci95": interval, "per_seed": per_seed.tolist()}


def _means(episodes: Episodes) -> dict[str, float]:
    return {name: float(value.mean()) for name, value in episodes.metrics.items()}


def play_batches(trained: TrainedPolicy, controller: Controller, stream: str, episodes: int) -> Episodes:
    """Play episodes in batches whose worlds depend on the seeds, the stream and the batch alone.

    Args:
        trained: the policy, and so the task.
        controller: who acts.
        stream: names the worlds.
        episodes: per seed.
    """
    parts = []
    batch = max(1, min(episodes, MAX_WORLDS // len(trained.config.seeds)))
    for begin in range(0, episodes, batch):
        env = build_environment(trained.config, min(batch, episodes - begin), "judgement", stream, begin)
        parts.append(play(env, controller))
    return Episodes(
        torch.cat([p.returns for p in parts], 1),
        torch.cat([p.lengths for p in parts], 1),
        {name: torch.cat([p.metrics[name] for p in parts], 1) for name in parts[0].metrics},
    )
