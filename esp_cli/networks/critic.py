"""A value function: one network for the whole team, or one shared by its agents."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import torch
from torch import Tensor, nn

from esp_cli.networks.build import build_network
from esp_cli.networks.contract import NetworkConfig, WithVJP
from esp_cli.networks.io_spec import IoSpec, Reads
from esp_envs.spec import TaskSpec


class Critic(nn.Module):
    """S critics of one shape.

    It reads the global "state" or all agents' "observations" in a row and returns one value for a shared reward, else
    one per agent; or it reads each agent's "own" observation and returns that agent's value, with weights that all
    share.
    """

    def __init__(
        self, spec: TaskSpec, reads: Reads, network: NetworkConfig, generators: Sequence[torch.Generator]
    ) -> None:
        super().__init__()
        self.reads = reads
        own = reads == "own"
        self.num_values = 1 if spec.shared_reward and not own else spec.num_agents
        observed = spec.observation.width
        width = {"state": spec.state.width, "observations": spec.num_agents * observed, "own": observed}[reads]
        outputs = 1 if own else self.num_values
        self.network = build_network(generators, width, outputs, network, 1.0, IoSpec(spec, reads, outputs))

    def unroll(self, obs: Tensor, state: Tensor, truncation: int = 0) -> Tensor:
        """Return the values [S, B, T, C] over whole episodes obs [S, B, T, N, D] and state [S, B, T, state width]."""
        return self._values(self.network.unroll_agents(self._rows(obs, state), truncation))

    def unroll_with_vjp(self, obs: Tensor, state: Tensor, truncation: int = 0) -> WithVJP:
        """Return what `unroll` does, for losses."""
        outputs, vjp = self.network.unroll_with_vjp(self._rows(obs, state), truncation)
        return WithVJP(self._values(outputs), lambda slope: vjp(slope.view(outputs.shape)), self._learned)

    @cached_property
    def _learned(self) -> list[Tensor]:
        """The parameters; to list them takes as long as a product."""
        return [*self.network.parameters()]

    def _rows(self, obs: Tensor, state: Tensor) -> Tensor:
        """Return what the network reads, [S, B, T, 1 or N, width]."""
        if self.reads == "own":
            return obs
        return (state if self.reads == "state" else obs.flatten(-2)).unsqueeze(3)

    def _values(self, outputs: Tensor) -> Tensor:
        """Return the values [S, B, T, C] that are in the network's outputs."""
        return outputs.squeeze(4 if self.reads == "own" else 3)
