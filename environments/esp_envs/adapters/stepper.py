"""Copies of a `ParallelTask`'s environment: how their numbers go in and out, and how they are stepped."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from esp_envs.adapters.copies import FINAL, NOW, TERMINATED, TRUNCATED, Board
from esp_envs.errors import UserError
from esp_envs.spec import ActionSpace, Discrete, Layout

Array = NDArray[Any]


class CopyHooks(ABC):
    """What a task says about one copy of its environment. The hooks run in worker processes; they use settings alone.

    All learning agents of a copy must end together, unless `agents_end` says otherwise. Where an episode may be over
    before the horizon, set `terminates`.
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
    agents_end: bool = False
    """Whether agents may end one by one, by leaving `env.agents`, while the episode goes on for the others."""
    masks: bool = False
    """Whether the environment says which discrete actions are allowed; see `allowed`."""
    shared_reward: bool = False
    metrics: tuple[str, ...] = ()
    """Names of the numbers that `measure` returns; by default it takes them from the agents' infos."""

    @abstractmethod
    def make_one(self) -> Any:
        """Return one new copy, a PettingZoo `ParallelEnv`."""

    def reading(self, agent: str, observation: Any) -> Array:
        """Turn what an agent is given into the numbers of the layout: an angle into (cos, sin), axes into order."""
        return np.asarray(observation["observation"] if _has(observation, "action_mask") else observation)

    def allowed(self, agent: str, observation: Any, info: Mapping[str, Any]) -> Array:
        """Return the mask of an agent's actions: the entry "action_mask" of its observation, or else of its info.

        Raises:
            UserError: neither has one.
        """
        for place in (observation, info):
            if _has(place, "action_mask"):
                return np.asarray(place["action_mask"])
        raise UserError(f"{agent} gets no 'action_mask', neither in its observation nor in its info")

    def opponent(self, agent: str, observation: Any, generator: np.random.Generator) -> Any:
        """Return the action of an agent that does not learn, as its environment takes it.

        Args:
            agent: its name.
            observation: what the environment gave it.
            generator: of this copy, seeded with each episode.
        """
        raise UserError(f"{type(self).__name__} does not say how {agent} acts; define 'opponent' or set 'learners'")

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
            raise UserError(f"no agent's name begins with '{task.learners}'; the agents are {', '.join(agents)}")
        self.rest = [name for name in agents if name not in self.learners]
        spaces = [self.env.action_space(name) for name in self.learners]
        self._boxes = [_bounds(space) for space in spaces]
        self._starts = [int(getattr(space, "start", 0)) for space in spaces]

    def require_spaces(self) -> None:
        """Refuse spaces that differ from the layouts, by looking at the first observation.

        Raises:
            UserError: names the agent, its numbers and those of the layout.
        """
        task = self._task
        first, infos = self.env.reset(seed=0)
        for name in self.learners:
            if name not in first:
                raise UserError(f"{name} gets no observation from 'reset', and agents that join later cannot learn")
            width = task.reading(name, first[name]).size
            if width != task.observation.width:
                raise UserError(f"{name} sees {width} numbers, but the layout has {task.observation.width}")
            if task.masks and isinstance(task.action, Discrete):
                size = task.allowed(name, first[name], infos.get(name, {})).size
                if size != task.action.count:
                    raise UserError(f"{name} has a mask of {size} actions, but the task has {task.action.count}")
            space = self.env.action_space(name)
            if isinstance(task.action, Discrete):
                if getattr(space, "n", None) != task.action.count or space.shape:
                    raise UserError(f"{name} acts in {space}, but the task says {task.action.count} discrete actions")
            elif _bounds(space) is None or space.shape != (task.action.width,):
                raise UserError(f"{name} acts in {space}, but the task says {task.action.width} bounded real numbers")
        if task.state is not None and not hasattr(self.env, "state"):
            raise UserError("the task says what the state is, but its environment has no 'state' method")
        if task.state is not None and np.size(self.env.state()) != task.state.width:
            got = np.size(self.env.state())
            raise UserError(f"the environment's state has {got} numbers, but the layout has {task.state.width}")

    def native(self, i: int, action: Array) -> Any:
        """Return an action of learning agent i as the environment takes it."""
        if (box := self._boxes[i]) is None:
            return self._starts[i] + int(action)
        low, high = box
        return (low + (action.clip(-1, 1) + 1) / 2 * (high - low)).clip(low, high).astype(low.dtype)

    def close(self) -> None:
        """Let go of the copy."""
        if hasattr(self.env, "close"):
            self.env.close()


class CopyStepper:
    """Steps some copies of a board."""

    def __init__(self, task: CopyHooks, board: Board, copies: range) -> None:
        self._task, self.board = task, board
        self._copies: dict[int, Copy] = {}
        self._copies.update((k, Copy(task)) for k in copies)
        self._seen: dict[int, Mapping[str, Any]] = {}
        self._infos: dict[int, Mapping[str, Any]] = {}
        self._gone: dict[int, set[str]] = {}
        self._opponents_draws: dict[int, np.random.Generator] = {}

    def reset(self) -> None:
        """Start an episode in every copy."""
        for k in self._copies:
            self._start(k)

    def step(self) -> None:
        """Advance every copy by one step, and reset those whose episode ends."""
        for k, copy in self._copies.items():
            self._step(k, copy)

    def __del__(self) -> None:
        """Close the copies of a task that is forgotten, or of a worker that leaves; what they raise concerns nobody."""
        for copy in self._copies.values():
            with suppress(Exception):
                copy.close()

    def _start(self, k: int) -> None:
        seed = int(self.board.seed[k])
        self._opponents_draws[k] = np.random.default_rng([seed, 1])  # of `seed` alone the environment's own are made
        with self._naming(k, "reset"):
            self._seen[k], self._infos[k] = self._copies[k].env.reset(seed=seed)
        self._gone[k] = set()
        self._write(k, NOW)

    def _step(self, k: int, copy: Copy) -> None:
        task, board, seen = self._task, self.board, self._seen[k]
        gone = self._gone[k]
        chosen = {name: copy.native(i, board.action[k, i]) for i, name in enumerate(copy.learners) if name not in gone}
        others = [name for name in copy.rest if name in seen and name not in gone]
        chosen |= {name: task.opponent(name, seen[name], self._opponents_draws[k]) for name in others}
        with self._naming(k, "step"):
            self._seen[k], reward, terminated, truncated, self._infos[k] = copy.env.step(chosen)
        with self._naming(k, "measure"):
            found = task.measure(copy.env, self._infos[k])
            board.metrics[k] = [found[name] for name in task.metrics]
        acting = [name for name in copy.learners if name not in gone]
        shared = next((reward[name] for name in acting if name in reward), 0.0) if task.shared_reward else 0.0
        board.reward[k] = [reward.get(name, 0.0) if name in acting else shared for name in copy.learners]
        ended = {name: terminated.get(name, True) for name in acting}  # an agent that is not mentioned has left
        over = [name for name in acting if ended[name] or truncated.get(name, False)]
        if over and len(over) < len(acting) and not task.agents_end:
            raise UserError(
                f"{over[0]} of {type(task).__name__} ends before the others; set 'agents_end = True' in the class"
            )
        # the horizon cuts agents that go on up to it, even if another ends in the same step; `alive` says which one
        terminates = all if task.agents_end and board.cut[k] else any
        board.ended[k] = self._how(k, len(over) == len(acting), terminates(ended.values()))
        gone.update(name for name in over if ended[name] or not board.cut[k])
        gone.update(name for name in others if terminated.get(name, False) or truncated.get(name, False))
        self._write(k, FINAL)
        if board.ended[k]:
            self._start(k)
        else:
            for seen_by in (board.obs, board.state, board.mask, board.alive):
                seen_by[NOW, k] = seen_by[FINAL, k]

    def _how(self, k: int, over: bool, terminated: bool) -> int:
        """Return how the episode of a copy ended, 0 where it goes on; the horizon counts as a cut in any case."""
        task = self._task
        if over and terminated and task.terminates:
            return TERMINATED
        if over and not self.board.cut[k]:
            way = "set 'terminates = True' in the class" if terminated else "give both the same number of steps"
            raise UserError(f"an episode of {type(task).__name__} ends before its horizon; {way}")
        return TRUNCATED if self.board.cut[k] else 0

    def _write(self, k: int, when: int) -> None:
        """Write what the agents of a copy see; zeros, and everything allowed, for one that is there no more."""
        copy, seen, infos, gone, board = self._copies[k], self._seen[k], self._infos[k], self._gone[k], self.board
        alive = board.alive[when, k] = [name not in gone for name in copy.learners]
        with self._naming(k, "reading"):
            for i, name in enumerate(copy.learners):
                board.obs[when, k, i] = self._task.reading(name, seen[name]).reshape(-1) if name in seen else 0
        if self._task.masks:
            with self._naming(k, "allowed"):
                for i, name in enumerate(copy.learners):
                    allowed = self._task.allowed(name, seen[name], infos.get(name, {})) if alive[i] else 1
                    board.mask[when, k, i] = allowed
        joint = self._task.state is None
        board.state[when, k] = board.obs[when, k].reshape(-1) if joint else np.asarray(copy.env.state()).reshape(-1)

    @contextmanager
    def _naming(self, k: int, what: str) -> Iterator[None]:
        """Say which copy fails, and where, if one does."""
        try:
            yield
        except Exception as error:
            line = (str(error).strip().splitlines() or [""])[-1]
            place = f"copy {k} of {type(self._task).__name__} raises in '{what}'"
            raise UserError(f"{place}: {type(error).__name__}: {line}") from error


def _has(place: Any, name: str) -> bool:
    return isinstance(place, Mapping) and name in place


def _bounds(space: Any) -> tuple[Array, Array] | None:
    """Return the bounds of a finite Box of real numbers, None for any other space."""
    if not hasattr(space, "low") or space.dtype.kind != "f" or not np.isfinite([space.low, space.high]).all():
        return None
    return np.asarray(space.low), np.asarray(space.high)
