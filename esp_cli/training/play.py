"""Playing whole episodes with a policy, at random, or with a heuristic of the task."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from esp_cli.networks.policy import Policy
from esp_envs.base import Environment, Observation


class PolicyController:
    """S trained policies, which draw their actions with a generator per seed, or without any act greedily."""

    def __init__(self, policy: Policy, generators: Sequence[torch.Generator] | None = None) -> None:
        self.policy, self.generators = policy, generators

    def begin(self, env: Environment, observation: Observation) -> None:
        """Empty the memory, for new episodes in all worlds."""
        self.memory = self.policy.initial_memory(env.num_envs, observation.obs)

    def act(self, env: Environment, observation: Observation) -> Tensor:
        """Return the greedy or a drawn action, as `Environment.step` takes it."""
        noise = None
        if self.generators is not None:
            shape = (env.num_envs, env.spec.num_agents)
            noise = self.policy.head.noise(shape, self.generators).to(env.device)
        action, self.memory = self.policy.act(observation.obs, self.memory, noise, observation.action_mask)
        return action


class ScriptedController:
    """A policy of the task itself, such as its random one or a heuristic, as a function of the environment.

    Example:
        >>> play(env, ScriptedController(methodcaller("heuristic"))).returns
    """

    def __init__(self, choose: Callable[[Environment], Tensor]) -> None:
        self._choose = choose

    def begin(self, env: Environment, observation: Observation) -> None:
        """Prepare nothing."""

    def act(self, env: Environment, observation: Observation) -> Tensor:
        """Return what the task's policy chooses."""
        return self._choose(env)


Controller = PolicyController | ScriptedController
"""Chooses joint actions."""


@dataclass(frozen=True)
class Episodes:
    """What one episode in every world brought."""

    returns: Tensor  # [S, E] mean over agents of the sum of rewards over time
    lengths: Tensor  # [S, E] steps
    metrics: dict[str, Tensor]  # task measures, each [S, E]: means over the episode's steps or sums, as the spec says


@torch.no_grad()
def play(env: Environment, controller: Controller) -> Episodes:
    """Play one episode in every world and add up what it brings; later episodes of a world do not count."""
    observation = env.reset()
    controller.begin(env, observation)
    shape = (env.num_seeds, env.num_envs)
    running = torch.ones(shape, dtype=torch.bool, device=env.device)
    returns, lengths = torch.zeros(shape, device=env.device), torch.zeros(shape, device=env.device)
    sums: dict[str, Tensor] = {}
    for _ in range(env.spec.horizon):
        step = env.step(controller.act(env, observation))
        returns += torch.where(running, step.reward.mean(-1), 0.0)
        lengths += running
        for name, value in step.metrics.items():
            sums[name] = sums.get(name, 0.0) + torch.where(running, value, 0.0)
        running &= ~step.ended
        observation = step.next
        if env.spec.terminates and not running.any():
            break
    means = {name: value if name in env.spec.totals else value / lengths for name, value in sums.items()}
    return Episodes(returns, lengths, means)
