"""A Gymnasium environment as a task of one agent; see `esp_envs.adapters.pettingzoo.ParallelTask`."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

from esp_envs.adapters import foreign
from esp_envs.adapters.pettingzoo import ParallelSettings, ParallelTask

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
        return foreign.ByAgent(single)
