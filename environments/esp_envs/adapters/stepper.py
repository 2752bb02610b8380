"""Copies of a `ParallelTask`'s environment: how their numbers go in and out, and how they are stepped."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from esp_envs.adapters.copies import TERMINATED, TRUNCATED, Board
from esp_envs.spec import ActionSpace, Discrete, Layout

Array = NDArray[Any]


class CopyHooks(ABC):
    """What a task says about one copy of its environment. The hooks run in worker processes; they use settings alone.

    All learning agents of a copy must end together. Where they may end before the horizon, set `terminates`.
    """

    observation: Layout
    """What each learning agent sees, after `reading`."""
    action: ActionSpace
    """What each learning agent does; numbers in [-1, 1] are stretched to the bounds of a Box."""
    symmetry: str
    convention: str
    state: Layout | None = None
    """What `env.state()` returns; by default the global state is all agents' observations, one after the other."""
    learners: str = ""
    """What the names of the agents that learn begin with; the others act by `opponent`."""
    terminates: bool = False
    shared_reward: bool = False
    metrics: tuple[str, ...] = ()
    """Names of the numbers that `measure` returns; by default it takes them from the agents' infos."""

    @abstractmethod
    def make_one(self) -> Any:
        """Return one new copy, a PettingZoo `ParallelEnv`."""

    def reading(self, agent: str, observation: Any) -> Array:
        """Turn what an agent is given into the numbers of the layout: an angle into (cos, sin), axes into order."""
        return np.asarray(observation)

    def opponent(self, agent: str, observation: Any, generator: np.random.Generator) -> Any:
        """Return the action of an agent that does not learn, as its environment takes it.

        Args:
            agent: its name.
            observation: what the environment gave it.
            generator: of this copy, seeded with each episode.
        """
        raise ValueError(f"{type(self).__name__} does not say how {agent} acts; define 'opponent' or set 'learners'")

    def measure(self, env: Any, infos: Mapping[str, Mapping[str, Any]]) -> Mapping[str, float]:
        """Return the metrics of the step just made: the mean over the agents whose infos hold them."""
        return {
            name: float(np.mean([info[name] for info in infos.values() if name in info] or [0]))
            for name in self.metrics
        }


class Copy:
    """One copy, its learning agents and how their numbers go in and out."""

    def __init__(self, task: CopyHooks) -> None:
        self._task = task
        self.env = task.make_one()
        agents = list(self.env.possible_agents)
        self.learners = [name for name in agents if name.startswith(task.learners)]
        if not self.learners:
            raise ValueError(f"no agent's name begins with '{task.learners}'; the agents are {', '.join(agents)}")
        self.rest = [name for name in agents if name not in self.learners]
        self._boxes = [_bounds(self.env.action_space(name)) for name in self.learners]

    def require_spaces(self) -> None:
        """Refuse spaces that differ from the layouts, by looking at the first observation.

        Raises:
            ValueError: names the agent, its numbers and those of the layout.
        """
        task, first = self._task, self.env.reset(seed=0)[0]
        for name in self.learners:
            width = task.reading(name, first[name]).size
            if width != task.observation.width:
                raise ValueError(f"{name} sees {width} numbers, but the layout has {task.observation.width}")
            space = self.env.action_space(name)
            if isinstance(task.action, Discrete):
                if getattr(space, "n", None) != task.action.count:
                    raise ValueError(f"{name} acts in {space}, but the task says {task.action.count} discrete actions")
            elif _bounds(space) is None or space.shape != (task.action.width,):
                raise ValueError(f"{name} acts in {space}, but the task says {task.action.width} bounded numbers")
        if task.state is not None and np.size(self.env.state()) != task.state.width:
            got = np.size(self.env.state())
            raise ValueError(f"the environment's state has {got} numbers, but the layout has {task.state.width}")

    def native(self, i: int, action: Array) -> Any:
        """Return an action of learning agent i as the environment takes it."""
        if (box := self._boxes[i]) is None:
            return int(action)
        low, high = box
        return (low + (action.clip(-1, 1) + 1) / 2 * (high - low)).astype(np.float32)

    def close(self) -> None:
        """Let go of the copy."""
        if hasattr(self.env, "close"):
            self.env.close()


class CopyStepper:
    """Steps some copies of a board."""

    def __init__(self, task: CopyHooks, board: Board, copies: range) -> None:
        self._task, self._board = task, board
        self._copies = {k: Copy(task) for k in copies}
        self._seen: dict[int, Mapping[str, Any]] = {}
        self._dice: dict[int, np.random.Generator] = {}

    def reset(self) -> None:
        """Start an episode in the active copies."""
        for k in self._copies:
            if self._board.active[k]:
                self._start(k)

    def step(self) -> None:
        """Advance the active copies by one step, and reset those whose episode ends."""
        for k, copy in self._copies.items():
            if self._board.active[k]:
                self._step(k, copy)

    def _start(self, k: int) -> None:
        seed = int(self._board.seed[k])
        self._dice[k] = np.random.default_rng(seed)
        try:
            self._seen[k] = self._copies[k].env.reset(seed=seed)[0]
        except Exception as error:
            raise ValueError(self._sentence(k, "reset", error)) from error
        self._write(k, self._board.obs, self._board.state)

    def _step(self, k: int, copy: Copy) -> None:
        task, board, seen = self._task, self._board, self._seen[k]
        chosen = {name: copy.native(i, board.action[k, i]) for i, name in enumerate(copy.learners)}
        chosen |= {name: task.opponent(name, seen[name], self._dice[k]) for name in copy.rest if name in seen}
        try:
            self._seen[k], reward, terminated, truncated, infos = copy.env.step(chosen)
            found = task.measure(copy.env, infos)
        except Exception as error:
            raise ValueError(self._sentence(k, "step", error)) from error
        board.reward[k] = [reward[name] for name in copy.learners]
        board.metrics[k] = [found[name] for name in task.metrics]
        over = {name: terminated[name] or truncated[name] for name in copy.learners}
        if any(over.values()) and not all(over.values()):
            early = next(name for name, is_over in over.items() if is_over)
            raise ValueError(f"{early} of {type(task).__name__} ends before the others; its agents must end together")
        board.ended[k] = self._how(k, all(over.values()), any(terminated[name] for name in copy.learners))
        self._write(k, board.final_obs, board.final_state)
        if board.ended[k]:
            self._start(k)
        else:
            board.obs[k], board.state[k] = board.final_obs[k], board.final_state[k]

    def _how(self, k: int, over: bool, terminated: bool) -> int:
        """Return how the episode of a copy ended, 0 where it goes on; the horizon counts as a cut in any case."""
        task = self._task
        if over and terminated and task.terminates:
            return TERMINATED
        if over and not self._board.cut[k]:
            way = "set 'terminates = True' in the class" if terminated else "give both the same number of steps"
            raise ValueError(f"an episode of {type(task).__name__} ends before its horizon; {way}")
        return TRUNCATED if self._board.cut[k] else 0

    def _write(self, k: int, obs: Array, state: Array) -> None:
        copy, seen = self._copies[k], self._seen[k]
        for i, name in enumerate(copy.learners):
            obs[k, i] = self._task.reading(name, seen[name]).reshape(-1)
        state[k] = obs[k].reshape(-1) if self._task.state is None else np.asarray(copy.env.state()).reshape(-1)

    def _sentence(self, k: int, what: str, error: Exception) -> str:
        lines = str(error).strip().splitlines() or [""]
        return f"copy {k} of {type(self._task).__name__} raises in '{what}': {type(error).__name__}: {lines[-1]}"


def _bounds(space: Any) -> tuple[Array, Array] | None:
    """Return the bounds of a finite Box, None for any other space."""
    if not hasattr(space, "low") or not np.isfinite([space.low, space.high]).all():
        return None
    return np.asarray(space.low), np.asarray(space.high)
