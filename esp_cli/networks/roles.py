"""The policies of all roles of a task as one policy, on joint rows and into joint actions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from esp_cli.networks.policy import Policy
from esp_envs.base import joined
from esp_envs.errors import UserError
from esp_envs.spec import TaskSpec


class RolesPolicy(Policy):
    """S policies for each role of a task, by name; its memory and its noise are tuples, one part for each role."""

    def __init__(self, spec: TaskSpec, policies: Mapping[str, Policy]) -> None:
        nn.Module.__init__(self)
        self.num_seeds = next(iter(policies.values())).num_seeds
        self.num_agents, self._parts = spec.num_agents, spec.parts
        for name, policy in policies.items():
            if hasattr(self, name) or hasattr(nn.ModuleDict, name):  # learners with targets keep these in one
                raise UserError(f"a role cannot be named '{name}', which means something of a policy; rename it")
            self.add_module(name, policy)

    def of(self, role: str) -> Policy:
        """Return the policy of one role."""
        return self.get_submodule(role)  # type: ignore[return-value]

    def initial_memory(self, num_envs: int, like: Tensor) -> Any:
        return tuple(self.of(role.name).initial_memory(num_envs, like) for role, _ in self._parts)

    def noise(self, num_envs: int, num_agents: int, generators: Sequence[torch.Generator], device: Any = "cpu") -> Any:
        return tuple(self.of(role.name).noise(num_envs, role.num_agents, generators, device) for role, _ in self._parts)

    def act(self, obs: Tensor, memory: Any, noise: Any = None, action_mask: Tensor | None = None) -> tuple[Tensor, Any]:
        """Return the joint action and the next memory; see `Policy.act`."""
        actions, after = [], []
        for k, (role, where) in enumerate(self._parts):
            seen = obs[:, :, where, : role.observation.width].contiguous()
            mask, drawn = role.own_mask(action_mask, where), None if noise is None else noise[k]
            action, kept = self.of(role.name).act(seen, memory[k], drawn, mask)
            actions.append(action)
            after.append(kept)
        return joined(actions), tuple(after)
