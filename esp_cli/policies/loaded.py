"""Trained policies for other programs: numpy in, numpy out.

from esp_cli import load_policy

policy = load_policy("formation")
wheels = policy.act(obs)
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from esp_cli.algorithms.learner import Learner
from esp_cli.algorithms.presets import ALGORITHMS
from esp_cli.files.formatting import Shown, format_count
from esp_cli.networks.build import NETWORKS
from esp_cli.networks.contract import NetworkConfig
from esp_cli.policies.loading import TrainedPolicy, open_policy
from esp_envs.base import Environment
from esp_envs.errors import UserError
from esp_envs.registry import register
from esp_envs.spec import Continuous, Discrete, TaskSpec

Floats = NDArray[np.float32]
Action = NDArray[np.int64] | NDArray[np.float32]


class LoadedPolicy(Shown):
    """One seed's policy, ready to act; agents share it, so every row of observations is an agent of its own.

    Example:
        policy = load_policy("formation")
        wheels = policy.act(obs)  # [8, D] to [8, 2]

    Shape letters as in `esp_envs.spec`; `...` stands for any leading axes, none among them. Where agents exchange
    messages (`team` more than 1), the last of the leading axes has the agents of one world.

    Attributes:
        spec: of its task: layout of an observation, meaning of the actions.
        memory_width: numbers that it carries from step to step; 0 for one that remembers nothing.
        team: agents that act together; 1 where each acts by itself.
        source: the file or run folder that it came from.
    """

    def __init__(self, trained: TrainedPolicy, seed: int | None = None) -> None:
        self.trained = trained.single_seed(seed)
        self.spec: TaskSpec = trained.spec
        self.source = trained.source
        self.team = trained.policy.actor.team
        self.memory_width = int(trained.policy.initial_memory(1, torch.empty(0)).shape[-1])

    def _facts(self) -> Mapping[str, object]:
        config, action = self.trained.config, self.spec.action
        return {
            "policy": f"{config.algorithm} on {config.task}, prior {config.prior.kind}, network {config.network.name}",
            "source": self.source,
            "seed": f"{config.seeds[0]}, after {format_count(self.trained.step)} steps",
            "observation": self.spec.observation.summary,
            "action": f"{action.count} choices" if isinstance(action, Discrete) else action.layout.summary,
        }

    def act(
        self, obs: ArrayLike, rng: np.random.Generator | None = None, action_mask: ArrayLike | None = None
    ) -> Action:
        """Return what each agent does, for a policy that remembers nothing.

        Args:
            obs: [..., D] as `spec.observation` lays it out.
            rng: draws the actions; without it the policy is greedy.
            action_mask: [..., A] bool, the allowed actions; needed where `spec.masks` says so.

        Returns:
            [...] int64, indices of `spec.action.names`, or [..., width] float32 within the task's bounds.

        Raises:
            UserError: another shape, numbers that are not finite, or a policy that has to remember.
        """
        if self.memory_width:
            raise UserError(
                f"{self.source} is recurrent; begin an episode with memory = policy.initial_memory(num_agents), and "
                "act with action, memory = policy.step(obs, memory)"
            )
        rows = self._checked_obs(obs)
        return self.step(rows, self.initial_memory(*rows.shape[:-1]), rng, action_mask)[0]

    def initial_memory(self, *lead: int) -> Floats:
        """Return the memory with which an episode begins: zeros [*lead, H]."""
        return np.zeros((*lead, self.memory_width), np.float32)

    @torch.no_grad()
    def step(
        self,
        obs: ArrayLike,
        memory: ArrayLike,
        rng: np.random.Generator | None = None,
        action_mask: ArrayLike | None = None,
    ) -> tuple[Action, Floats]:
        """Return what each agent does, and its next memory [..., H]; the arguments stay as they are.

        `memory` [..., H] is that of `initial_memory`, or of the step before; all else is as of `act`.
        """
        rows = self._checked_obs(obs)
        carried = self._checked(memory, self.memory_width, "memory", "as policy.initial_memory gives it")
        lead, policy, space, noise = rows.shape[:-1], self.trained.policy, self.spec.action, None
        if carried.shape[:-1] != lead:
            raise UserError(
                f"the memory has shape {carried.shape}, but observations of shape {rows.shape} need "
                f"{(*lead, self.memory_width)}: one row for each agent"
            )
        mask = self._checked_mask(action_mask, lead)
        shape = (*lead, space.width) if isinstance(space, Continuous) else lead
        count = math.prod(lead)  # reshape cannot infer it where a width is 0
        if not count:
            return np.zeros(shape, np.float32 if isinstance(space, Continuous) else np.int64), carried
        if rng is not None:
            if not isinstance(rng, np.random.Generator):
                raise UserError(f"rng is {rng!r}; give a generator, as numpy.random.default_rng makes it")
            noise = policy.head.noise((1, count), [torch.Generator().manual_seed(int(rng.integers(2**63)))])
        inputs = torch.tensor(rows.reshape(1, 1, count, rows.shape[-1]))
        action, after = policy.act(inputs, torch.tensor(carried.reshape(1, count, self.memory_width)), noise, mask)
        return action.numpy().reshape(shape), after.numpy().reshape((*lead, self.memory_width))

    def _checked_mask(self, action_mask: ArrayLike | None, lead: tuple[int, ...]) -> torch.Tensor | None:
        """Return the mask as [1, 1, rows, A]; None for a task without masks."""
        space = self.spec.action
        if not (isinstance(space, Discrete) and self.spec.masks):
            if action_mask is not None:
                raise UserError(f"{self.spec.name} has no action masks; leave action_mask out")
            return None
        expected = (*lead, space.count)
        if action_mask is None:
            raise UserError(f"{self.spec.name} says which actions are allowed; give action_mask of shape {expected}")
        try:
            given = np.asarray(action_mask)
        except (TypeError, ValueError):  # as for rows of unequal length
            given = np.asarray(None)
        if given.dtype.kind not in "biuf" or not np.isin(given, (0, 1)).all():
            raise UserError("the action mask is not an array of booleans; give True for each action that is allowed")
        if given.shape != expected:
            raise UserError(f"the action mask has shape {given.shape}, expected {expected}")
        if not (mask := given.astype(bool)).any(-1).all():
            raise UserError("the action mask allows an agent nothing; leave it one action")
        return torch.from_numpy(mask.reshape(1, 1, -1, space.count))

    def _checked_obs(self, obs: ArrayLike) -> Floats:
        layout = self.spec.observation
        rows = self._checked(obs, layout.width, "observation", layout.summary)
        if self.team > 1 and rows.shape[-2:-1] != (self.team,):
            raise UserError(
                f"the observation has shape {rows.shape}, but the agents of {self.source} exchange messages: give "
                f"(..., {self.team}, {layout.width}), one row for each agent of a world"
            )
        return rows

    def _checked(self, values: ArrayLike, width: int, what: str, meaning: str) -> Floats:
        """Return [..., width] float32 after checking that it is that."""
        try:  # "same_kind" takes no texts and cuts no complex numbers
            array = np.asarray(values).astype(np.float32, casting="same_kind", copy=False)
        except (TypeError, ValueError):
            raise UserError(f"the {what} is not an array of real numbers; give (..., {width}): {meaning}") from None
        if array.ndim == 0 or array.shape[-1] != width:
            raise UserError(f"the {what} has shape {array.shape}, but {self.spec.name} needs (..., {width}): {meaning}")
        if not np.isfinite(array).all():
            place = tuple(int(k) for k in np.argwhere(~np.isfinite(array))[0])
            raise UserError(f"the {what} holds {array[place]} at {place}; give finite numbers")
        return array


def load_policy(
    where: str | os.PathLike[str],
    algo: str | type[Learner] | None = None,
    prior: str | None = None,
    seed: int | None = None,
    task: str | type[Environment] | None = None,
    network: str | type[NetworkConfig] | None = None,
    settings: Mapping[str, object] | None = None,
    role: str | None = None,
) -> LoadedPolicy:
    """Load a trained policy; loading runs no code but that of a task, algorithm or network which you name.

    Args:
        where: a task ("formation") or the name of a bundled policy, a policy file, or a run folder.
        algo: of a task's policies, the one that this algorithm trained; "module:Class" or the class of your own.
        prior: likewise this kind of prior; "none" is the plain learner.
        seed: which seed of a run acts; by default its first.
        task: the task that the policy is of, as "module:Class" or as the class, where it is not installed.
        network: the settings class of its network, likewise.
        settings: of the task, where they are others than in training: {"num_agents": 100} for a network over sets.
        role: whose policy, of a task whose agents have roles.

    Raises:
        UserError: nothing there, damaged, of another version, no such seed, or no such task.
    """
    register_own(task, algo, network)
    name = algo if isinstance(algo, str) else None
    return LoadedPolicy(open_policy(Path(where), name, prior).transfer(settings or {}).of_role(role), seed)


def register_own(
    task: str | type[Environment] | None, algo: str | type[Learner] | None, network: str | type[NetworkConfig] | None
) -> None:
    """Register the task, algorithm and network that a caller names; see `Registry.register`."""
    if task is not None:
        register(task)
    if algo is not None:
        ALGORITHMS.register(algo)
    if network is not None:
        NETWORKS.register(network)
