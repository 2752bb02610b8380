"""A Gymnasium environment as a task of one agent; see `esp_envs.adapters.pettingzoo.ParallelTask`."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

from esp_envs.adapters.pettingzoo import ParallelSettings, ParallelTask

_AGENT = "agent"
SingleAgentSettings = ParallelSettings


class SingleAgentTask(ParallelTask):
    """Copies of a Gymnasium environment, stepped as one vector of them.

    A subclass sets the same attributes as a `ParallelTask` and implements `make_single`. Its observation belongs to the
    agent "agent" in `reading`.
    """

    @abstractmethod
    def make_single(self) -> Any:
        """Return one new copy, a `gymnasium.Env`."""

    def make_one(self) -> Any:
        """Return one new copy as an environment of one agent."""
        return _OneAgent(self.make_single())


class _OneAgent:
    """The parts of a PettingZoo `ParallelEnv` that the adapter needs, over a Gymnasium environment."""

    possible_agents = (_AGENT,)

    def __init__(self, env: Any) -> None:
        self._env = env

    def __getattr__(self, name: str) -> Any:
        """Give `state`, `unwrapped` and all else of the environment."""
        if name == "_env":  # not there while it is unpacked
            raise AttributeError(name)
        return getattr(self._env, name)

    def action_space(self, agent: str) -> Any:
        return self._env.action_space

    def reset(self, seed: int) -> tuple[dict[str, Any], dict[str, Any]]:
        seen, info = self._env.reset(seed=seed)
        return {_AGENT: seen}, {_AGENT: info}

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        return tuple({_AGENT: part} for part in self._env.step(actions[_AGENT]))

    def close(self) -> None:
        self._env.close()
