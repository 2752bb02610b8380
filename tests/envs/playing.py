"""Play whole episodes with a heuristic or at random."""

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
    running = torch.ones(env.num_seeds, env.num_envs, dtype=torch.bool)
    for _ in range(env.spec.horizon):
        step = env.step(env.random_action() if policy == "random" else env.heuristic(policy))
        total += torch.where(running, step.reward.mean(-1), 0.0)
        running &= ~(step.terminated | step.truncated)
    return total.mean().item(), total.std().item() / total.numel() ** 0.5
