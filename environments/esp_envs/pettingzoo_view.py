"""Every task as a PettingZoo parallel environment: one world, NumPy in and out.

    from esp_envs.pettingzoo_view import ParallelView
    env = ParallelView("navigation", seed=0, num_agents=4)

Needs the optional extra `pettingzoo` of this package.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from esp_envs.base import Observation, put_back
from esp_envs.drawing import draw
from esp_envs.errors import UserError
from esp_envs.installed import install
from esp_envs.registry import make
from esp_envs.spec import Continuous

try:
    from gymnasium import spaces
    from pettingzoo import ParallelEnv
except ImportError as error:
    raise ImportError(
        f"the PettingZoo view needs a package that is missing ({error.name}): {install('pettingzoo')}"
    ) from error

_Array = NDArray[Any]


class ParallelView(ParallelEnv):  # type: ignore[misc]  # pettingzoo may be missing, its base is then unknown
    """One world of a registered task as a `pettingzoo.ParallelEnv`.

    Agents are named `agent_0`, `agent_1`, ...; observations are float32 vectors laid out as the task's card says,
    actions are integers or float32 vectors, `state()` is the global state. Every agent's info holds the task's metrics,
    and where the task has masks `action_mask`, its allowed actions [A] int8. An agent that ends before its episode is
    terminated in that step and is then no more among `agents`.

    Args:
        task_name: registered name.
        seed: of the first episode; `reset(seed=...)` sets another.
        render_mode: None or "rgb_array".
        **settings: task settings that differ from the defaults.

    Raises:
        UserError: unknown task, unknown setting, or a value out of range.
    """

    def __init__(self, task_name: str, seed: int = 0, render_mode: str | None = None, **settings: object) -> None:
        if render_mode not in (None, "rgb_array"):
            raise UserError(f"unknown render mode '{render_mode}'; use 'rgb_array' or none")
        self._env = make(task_name, 1, [seed], settings)
        spec, action = self._env.spec, self._env.spec.action
        self.metadata: dict[str, Any] = {
            "name": f"{spec.name}_v{spec.version}",
            "render_modes": ["rgb_array"],
            "is_parallelizable": True,
            "render_fps": round(1 / spec.control_period_s),
        }
        self.render_mode = render_mode
        self.possible_agents = [f"agent_{i}" for i in range(spec.num_agents)]
        self.agents: list[str] = []
        self.state_space = spaces.Box(-np.inf, np.inf, (spec.state.width,), np.float32)
        self._state = np.zeros(spec.state.width, np.float32)
        # one space object per agent: each has its own random generator
        self.observation_spaces = {
            agent: spaces.Box(-np.inf, np.inf, (spec.observation.width,), np.float32) for agent in self.possible_agents
        }
        self.action_spaces = {
            agent: spaces.Box(-1.0, 1.0, (action.width,), np.float32)
            if isinstance(action, Continuous)
            else spaces.Discrete(action.count)
            for agent in self.possible_agents
        }

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return the observation space of an agent, always the same object."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return the action space of an agent, always the same object."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, _Array], dict[str, dict[str, Any]]]:
        """Start a new episode, of `seed` where one is given; no options are known."""
        if seed is not None:
            self._env.generators[0].manual_seed(int(seed))
        seen = self._env.reset()
        self.agents = self.possible_agents
        self.agents = self._living(seen)
        return self._take(seen, {})

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, _Array], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Advance by one step; after the last one of an episode no agents are left until `reset`."""
        if not self.agents:
            return {}, {}, {}, {}, {}
        step = self._env.step(self._joint(actions))
        terminated, truncated = bool(step.terminated), bool(step.truncated)
        if (terminated or truncated) and self.render_mode is not None and self._env.has("set_state"):
            put_back(self._env, step.reached)  # the world has reset itself; show how the episode ended
        living = self._living(step.reached)
        observation, infos = self._take(step.reached, {name: float(value) for name, value in step.metrics.items()})
        rewards = {agent: float(reward) for agent, reward in self._by_agent(step.reward).items()}
        terminations = {agent: terminated or agent not in living for agent in self.agents}
        truncations = {agent: truncated and agent in living for agent in self.agents}
        self.agents = [] if terminated or truncated else living
        return observation, rewards, terminations, truncations, infos

    def state(self) -> _Array:
        """Return the global state [state width]."""
        return self._state.copy()

    def render(self) -> _Array | None:
        """Return a picture [H, W, 3] uint8, or nothing without a render mode."""
        return None if self.render_mode is None else draw(self._env.scene())

    def _joint(self, actions: dict[str, Any]) -> torch.Tensor:
        """Return the joint action [1, 1, N] or [1, 1, N, width] of a dictionary of actions."""
        if missing := [agent for agent in self.agents if agent not in actions]:
            raise UserError(f"the action of {', '.join(missing)} is missing; give one for every live agent")
        space = self._env.spec.action
        idle = np.zeros(space.width, np.float32) if isinstance(space, Continuous) else np.zeros((), np.int64)
        checked = {agent: self._checked(agent, actions[agent]) for agent in self.agents}
        joint = np.stack([checked.get(agent, idle) for agent in self.possible_agents])
        return torch.as_tensor(joint).unsqueeze(0).unsqueeze(0)

    def _checked(self, agent: str, action: object) -> _Array:
        """Return an agent's action in the type of its space; any NumPy or Python numbers are taken."""
        space = self.action_spaces[agent]
        array: _Array = np.empty(0, object)
        with suppress(ValueError):  # rows of different lengths
            array = np.asarray(action)
        array = array.reshape(()) if array.shape == (1,) and not space.shape else array
        is_number = array.dtype.kind in ("fiu" if space.shape else "iu")
        if not is_number or array.shape != space.shape or not space.contains(array.astype(space.dtype)):
            raise UserError(f"{agent}'s action {action!r} is not in {space}; give one from there")
        return array.astype(space.dtype)

    def _take(
        self, seen: Observation, metrics: dict[str, float]
    ) -> tuple[dict[str, _Array], dict[str, dict[str, Any]]]:
        """Keep the global state; return observation and info of each agent that acted, with its allowed actions."""
        self._state = seen.state[0, 0].numpy().copy()
        masks = {} if seen.action_mask is None else self._by_agent(seen.action_mask.to(torch.int8))
        infos = {agent: metrics | ({"action_mask": masks[agent]} if masks else {}) for agent in self.agents}
        return self._by_agent(seen.obs), infos

    def _by_agent(self, x: torch.Tensor) -> dict[str, Any]:
        """Return what [1, 1, N, ...] says of each agent that still acts, as memory of its own."""
        rows = dict(zip(self.possible_agents, x[0, 0].numpy().copy(), strict=True))
        return {agent: rows[agent] for agent in self.agents}

    def _living(self, seen: Observation) -> list[str]:
        """Return which of the agents that acted still do."""
        return [*self.agents] if seen.alive is None else [k for k, alive in self._by_agent(seen.alive).items() if alive]
