"""The verdict on a trained policy: greedy and stochastic returns with intervals, beside the task's anchors."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from esp_cli.experiments.statistics import bootstrap_interval, mean_and_sem
from esp_cli.training.evaluation import (
    Controller,
    Episodes,
    HeuristicController,
    PolicyController,
    RandomController,
    play,
)
from esp_cli.training.loading import TrainedPolicy
from esp_cli.training.streams import generators
from esp_cli.training.trainer import build_environment

MAX_WORLDS = 4096
"""Worlds played at once, over all seeds; more episodes are played one batch after the other."""


def judge(trained: TrainedPolicy, episodes: int) -> dict[str, Any]:
    """Play `episodes` episodes per seed with each controller.

    Returns:
        A JSON-able dict: task, task_version, convention, episodes, greedy and stochastic (each mean, sem, ci95 over
        seeds, per_seed), anchors (random and heuristic, one number each), metrics (of the greedy policy).
    """
    seeds = trained.config.seeds
    greedy = _play(trained, PolicyController(trained.policy), "greedy", episodes)
    drawn = PolicyController(trained.policy, generators(seeds, "judgement", "noise"))
    stochastic = _play(trained, drawn, "stochastic", episodes)
    random = _play(trained, RandomController(), "random", episodes)
    heuristic = _play(trained, HeuristicController(), "heuristic", episodes)
    return {
        "task": trained.config.task,
        "task_version": trained.spec.version,
        "convention": trained.spec.convention,
        "source": str(trained.source),
        "step": trained.step,
        "seeds": list(seeds),
        "episodes": episodes,
        "greedy": summary(greedy.returns),
        "stochastic": summary(stochastic.returns),
        "anchors": {"random": float(random.returns.mean()), "heuristic": float(heuristic.returns.mean())},
        "metrics": {name: float(value.mean()) for name, value in greedy.metrics.items()},
    }


def summary(returns: Tensor) -> dict[str, Any]:
    """Return mean, s.e.m. and 95 % bootstrap interval over seeds of returns [S, episodes], and the seeds' means."""
    per_seed = returns.mean(1).double().cpu().numpy()
    mean, sem = mean_and_sem(per_seed)
    interval = bootstrap_interval(per_seed)
    return {"mean": mean, "sem": sem, "ci95": interval, "per_seed": per_seed.tolist()}


def _play(trained: TrainedPolicy, controller: Controller, stream: str, episodes: int) -> Episodes:
    """Play the episodes in batches whose worlds depend on the seeds and the batch alone."""
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
