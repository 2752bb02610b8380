"""A policy: an actor network shared by all agents, and the head that reads its outputs."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from esp_cli.networks.bodies import NetworkConfig, build_network
from esp_cli.networks.heads import build_head
from esp_envs.spec import TaskSpec

POLICY_GAIN = 0.01
"""Orthogonal gain of the last layer: the first policy is nearly uniform (MAPPO paper's default)."""


class Policy(nn.Module):
    """S policies of one shape; agents share parameters within a seed.

    Args:
        spec: the task.
        network: shape of the actor.
        generators: one CPU generator per seed, for the initial weights.
    """

    def __init__(self, spec: TaskSpec, network: NetworkConfig, generators: Sequence[torch.Generator]) -> None:
        super().__init__()
        self.num_seeds = len(generators)
        self.num_agents = spec.num_agents
        self.head = build_head(spec.action, self.num_seeds)
        self.actor = build_network(generators, spec.observation.width, self.head.num_outputs, network, POLICY_GAIN)

    def initial_memory(self, num_envs: int, like: Tensor) -> Tensor:
        """Return the memory [S, E * N, H] with which an episode begins."""
        return self.actor.initial_memory(self.num_seeds, num_envs * self.num_agents, like)

    def step(self, obs: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the normalised outputs [S, E, N, outputs] for obs [S, E, N, D], and the next memory."""
        outputs, memory = self.actor.step(obs.flatten(1, 2), memory)
        return self.head.normalise(outputs.unflatten(1, obs.shape[1:3])), memory

    def unroll(self, obs: Tensor, truncation: int = 0) -> Tensor:
        """Return the normalised outputs [S, B, T, N, outputs] over whole episodes obs [S, B, T, N, D]."""
        rows = obs.transpose(2, 3).flatten(1, 2)
        outputs = self.actor.unroll(rows, truncation).unflatten(1, (obs.shape[1], obs.shape[3]))
        return self.head.normalise(outputs.transpose(2, 3))

    def act(self, obs: Tensor, memory: Tensor, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return what `Environment.step` takes and the next memory; greedy where `noise` is None."""
        outputs, memory = self.step(obs, memory)
        action = self.head.mode(outputs) if noise is None else self.head.sample(outputs, noise)
        return self.head.to_environment(action), memory
