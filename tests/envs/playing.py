"""Play whole episodes with a heuristic or at random."""

from __future__ import annotations

import torch

from esp_envs import Environment


def episode_return(env: Environment, policy: str) -> tuple[float, float]:
    """Return the mean over worlds of one agent's return of an episode, and its standard error.

    Args:
        env: to be reset and played for one episode.
        policy: "random" or the name of a heuristic.
    """
    env.reset()
    total = torch.zeros(env.num_seeds, env.num_envs)
    for _ in range(env.spec.horizon):
        action = env.random_action() if policy == "random" else env.heuristic(policy)
        total += env.step(action).reward.mean(-1)
    return total.mean().item(), total.std().item() / total.numel() ** 0.5
