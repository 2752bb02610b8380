"""A Gymnasium environment as a task of one agent; see `esp_envs.adapters.pettingzoo.ParallelTask`."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

from esp_envs.adapters import foreign
from esp_envs.adapters.pettingzoo import ParallelSettings, ParallelTask
from esp_envs.errors import UserError

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
        single = self.make_single()
        foreign.require_kind(single, foreign.SINGLE, "make_single")
        return _OneAgent(single)

    def own_of(self, env: Any) -> Any:
        return env.own


class _OneAgent:
    """The parts of a PettingZoo `ParallelEnv` that the adapter needs, over a Gymnasium environment."""

    possible_agents = agents = (_AGENT,)

    def __init__(self, env: Any) -> None:
        self.own = env

    def __getattr__(self, name: str) -> Any:
        """Give `state`, `unwrapped` and all else of the environment."""
        if name == "own":  # not there while it is unpacked
            raise AttributeError(name)
        return getattr(self.own, name)

    def action_space(self, agent: str) -> Any:
        return self.own.action_space

    def reset(self, seed: int) -> tuple[dict[str, Any], dict[str, Any]]:
        given = self.own.reset(seed=seed)
        if not (isinstance(given, tuple) and len(given) == 2 and isinstance(given[1], Mapping)):
            raise UserError(f"'reset' returns a {type(given).__name__}; return (observation, info), as Gymnasium does")
        return {_AGENT: given[0]}, {_AGENT: given[1]}

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        given = self.own.step(actions[_AGENT])
        if not (isinstance(given, tuple) and len(given) == 5):
            shown = f"{len(given)} parts" if isinstance(given, tuple) else f"a {type(given).__name__}"
            raise UserError(f"'step' returns {shown}; return (observation, reward, terminated, truncated, info)")
        return tuple({_AGENT: part} for part in given)

    def close(self) -> None:
        self.own.close()
