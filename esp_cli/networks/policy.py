"""Policies, whose actor is shared by all agents and read by a head, and value functions."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from esp_cli.networks.build import build_network
from esp_cli.networks.contract import Generators, IoSpec, Network, NetworkConfig, Reads, WithVJP
from esp_cli.networks.heads import BoundedGaussian, Categorical, Head, masked
from esp_cli.networks.kernels.library import begin
from esp_cli.networks.plain import PlainConfig
from esp_cli.networks.symmetrised import Separate, action_parts
from esp_envs.spec import Discrete, Spaces, TaskSpec

POLICY_GAIN = 0.01  # orthogonal gain of the last layer: the first policy is nearly uniform (MAPPO paper's default)


class Policy(nn.Module):
    """S policies of one shape; agents share parameters within a seed."""

    head: Head

    def __init__(
        self,
        spec: Spaces,
        network: NetworkConfig,
        generators: Generators,
        head: Head,
        output_gain: float,
        num_extra: int = 0,
    ) -> None:
        super().__init__()
        self.num_seeds = len(generators)
        self.num_agents, self.num_observed = spec.num_agents, spec.observation.width
        self.head = head
        head.masks = spec.masks
        head.compiled = getattr(network, "compiled", False) is True and not getattr(network, "layer_norm", False)
        if head.compiled:
            begin("choices")
        inputs = spec.observation.width + num_extra
        io = IoSpec(spec, "own")
        if isinstance(network, PlainConfig) and network.separate_parts:
            parts = action_parts(spec.action)
            built = build_network(generators, inputs, len(parts), network, output_gain, io)
            self.actor: Network = Separate(built, parts)
        else:
            self.actor = build_network(generators, inputs, head.num_outputs, network, output_gain, io)

    def initial_memory(self, num_envs: int, like: Tensor) -> Tensor:
        """Return the memory [S, E * N, H] with which an episode begins."""
        return self.actor.initial_memory(self.num_seeds, num_envs * self.num_agents, like)

    def noise(self, num_envs: int, num_agents: int, generators: Generators, device: Any = "cpu") -> Any:
        """Draw what `act` needs to draw actions, per seed from its own generator."""
        return self.head.noise((num_envs, num_agents), generators).to(device)

    def step(self, obs: Tensor, memory: Tensor, action_mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return outputs, normalised, for obs [S, E, N, D] and allowed actions [S, E, N, A], and the memory."""
        outputs, memory = self.actor.step(obs.flatten(1, 2), memory)
        return self._chosen_from(outputs, obs, action_mask), memory

    def _chosen_from(self, outputs: Tensor, obs: Tensor, action_mask: Tensor | None) -> Tensor:
        """Return the normalised outputs [S, E, N, outputs] of a step; a seed lost to NaN does what is allowed."""
        outputs = outputs.unflatten(1, obs.shape[1:3])
        return self._normalised(outputs if action_mask is None else outputs.nan_to_num(), action_mask)

    def _normalised(self, outputs: Tensor, action_mask: Tensor | None) -> Tensor:
        return self.head.normalise(masked(outputs, action_mask))

    def act(
        self, obs: Tensor, memory: Tensor, noise: Tensor | None = None, action_mask: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return what `Environment.step` takes and the next memory; greedy where `noise` is None."""
        outputs, memory = self.step(obs, memory, action_mask)
        action = self.head.mode(outputs) if noise is None else self.head.sample(outputs, noise)
        return self.head.to_environment(action), self.remember(memory, action)

    def remember(self, memory: Tensor, action: Tensor) -> Tensor:
        """Put the action [S, E, N(, width)], as `Head.sample` returns it, into the memory of a policy that sees it."""
        return memory


class StochasticPolicy(Policy):
    """A policy that is a distribution over actions, as on-policy learners need it."""

    head: Categorical | BoundedGaussian

    def __init__(self, spec: Spaces, network: NetworkConfig, generators: Generators) -> None:
        space = spec.action
        head = Categorical(space) if isinstance(space, Discrete) else BoundedGaussian(space, len(generators))
        super().__init__(spec, network, generators, head, POLICY_GAIN)

    def unroll(self, obs: Tensor, truncation: int = 0, action_mask: Tensor | None = None) -> Tensor:
        """Return the normalised outputs [S, B, T, N, outputs] over whole episodes obs [S, B, T, N, D]."""
        return self._normalised(self.actor.unroll_agents(obs, truncation), action_mask)

    def unroll_with_vjp(self, obs: Tensor, truncation: int = 0, action_mask: Tensor | None = None) -> WithVJP:
        """Return the outputs as they are but for the mask, for losses; see `unroll`."""
        shape = (*obs.shape[:-1], self.head.num_outputs)
        given = self.actor.with_vjp(obs, shape, truncation, defer=action_mask is None)
        return given if action_mask is None else WithVJP(masked(given.tensor, action_mask), given.vjp, given.parameters)


class HistoryPolicy(Policy):
    """A policy of learners with a replay; a recurrent one sees its history (a_0, o_1, a_1, ..., a_{t-1}, o_t).

    The previous action is part of its memory [S, B * N, H + width]: zeros at the start of an episode, then the one-hot
    of a discrete action or the numbers of a continuous one. A perceptron sees the observation alone.
    """

    def __init__(
        self, spec: Spaces, network: NetworkConfig, generators: Generators, head: Head, output_gain: float
    ) -> None:
        extra = head.num_outputs if network.recurrent else 0
        super().__init__(spec, network, generators, head, output_gain, extra)
        self.recurrent = self.actor.memory_width > 0

    def initial_memory(self, num_envs: int, like: Tensor) -> Tensor:
        """Return the memory [S, E * N, H + width] with which an episode begins; [S, E * N, 0] of a perceptron."""
        hidden = super().initial_memory(num_envs, like)
        return torch.nn.functional.pad(hidden, (0, self.head.num_outputs)) if self.recurrent else hidden

    def step(self, obs: Tensor, memory: Tensor, action_mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the normalised outputs for obs [S, E, N, D], and the memory, in which the action is still missing."""
        if not self.recurrent:
            return super().step(obs, memory, action_mask)
        hidden, previous = memory.split((self.actor.memory_width, self.head.num_outputs), -1)
        outputs, hidden = self.actor.step(torch.cat([obs.flatten(1, 2), previous], -1), hidden)
        return self._chosen_from(outputs, obs, action_mask), torch.cat([hidden, previous], -1)

    def remember(self, memory: Tensor, action: Tensor) -> Tensor:
        if not self.recurrent:
            return memory
        return torch.cat([memory[..., : self.actor.memory_width], self.head.encode(action).flatten(1, 2)], -1)

    def unroll(self, obs: Tensor, action: Tensor, action_mask: Tensor | None = None) -> Tensor:
        """Return the normalised outputs over whole episodes, from empty memory, one row for each row of `obs`.

        obs [S, B, T + 1, N, D], the last row may be left out; what was done, action [S, B, T, N(, width)]; the allowed
        actions, action_mask [S, B, T + 1, N, A] -> [S, B, T + 1, N, outputs].
        """
        rows = obs
        if self.recurrent:
            done = self.head.encode(action)
            previous = torch.cat([torch.zeros_like(done[:, :, :1]), done], 2)[:, :, : obs.shape[2]]
            rows = torch.cat([rows, previous], -1)
        allowed = None if action_mask is None else action_mask[:, :, : obs.shape[2]]
        return self._normalised(self.actor.unroll_agents(rows), allowed)


class Critic(nn.Module):
    """S critics of one shape.

    It reads the global "state" or all agents' "observations" in a row and returns one value for a shared reward, else
    one per agent; or it reads each agent's "own" observation and returns its value, with weights that all share.
    """

    def __init__(self, spec: TaskSpec, reads: Reads, network: NetworkConfig, generators: Generators) -> None:
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
        values = self.network.unroll_agents(self._rows(obs, state), truncation)
        return values.squeeze(4 if self.reads == "own" else 3)

    def unroll_with_vjp(self, obs: Tensor, state: Tensor, truncation: int = 0) -> WithVJP:
        return self.network.with_vjp(self._rows(obs, state), (*obs.shape[:3], self.num_values), truncation)

    def _rows(self, obs: Tensor, state: Tensor) -> Tensor:
        if self.reads == "own":
            return obs
        return (state if self.reads == "state" else obs.flatten(-2)).unsqueeze(3)
