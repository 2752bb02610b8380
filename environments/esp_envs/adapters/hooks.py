"""One copy of a `ParallelTask`'s environment: what a task says about it, and how its numbers go in and out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from typing import Any

import numpy as np

from esp_envs.adapters import foreign
from esp_envs.adapters.pairing import Array, Attributes, Simulator
from esp_envs.errors import UserError
from esp_envs.roles import Role, of_role
from esp_envs.spec import ActionSpace, Continuous, Discrete, Layout


class CopyHooks(ABC):
    """What a task says about one copy of its environment. The hooks run in worker processes; they use settings alone.

    All learning agents of a copy must end together, unless `agents_end` says otherwise. Where an episode may be over
    before the horizon, by an end of its own or by truncation, set `terminates`.
    """

    observation: Layout | Mapping[str, Layout]
    """What each learning agent sees, after `reading`; by role where agents of several kinds learn."""
    action: ActionSpace | Mapping[str, ActionSpace]
    """What each learning agent does, likewise; numbers in [-1, 1] are stretched to the bounds of a Box."""
    roles: Mapping[str, Sequence[Any]] = {}
    """The agents of each role; by default those whose names begin with the role's name in `observation`."""
    symmetry: str
    nearly: str = ""
    """A larger symmetry that holds nearly, which a prior may use all the same."""
    convention: str
    control_period_s: float = 0.1
    """Time of a step, s."""
    state: Layout | None = None
    """What `env.state()` returns; by default the global state is all agents' observations, one after the other."""
    learners: str = ""
    """What the names of the agents that learn begin with; the others act by `opponent`."""
    terminates: bool = False
    agents_end: bool = False
    """Whether agents may end one by one, by leaving `env.agents`, while the episode goes on for the others."""
    masks: bool | Mapping[str, bool] = False
    """Whether the environment says which discrete actions are allowed; see `allowed`. May be given by role."""
    shared_reward: bool | Mapping[str, bool] = False
    """Whether all agents, or those of a role, get the same reward."""
    metrics: tuple[str, ...] = ()
    """Names of the numbers that `measure` returns; by default it takes them from the agents' infos."""
    totals: tuple[str, ...] = ()
    """Those of them that are added up over an episode, as successes are; the mean is taken of the others."""

    simulated: Layout | None = None
    """What `take` returns, so that checks can pair states; known of MPE's particles, and where agents see all of it."""
    attributes: Attributes | None = None
    """Where the state stands in the environment, which is looked for when a check asks."""

    @property
    def role_names(self) -> tuple[str, ...]:
        """The roles in order; none where all learning agents are alike."""
        return tuple(self.roles or (self.observation if isinstance(self.observation, Mapping) else ()))

    def role_of(self, agent: Any) -> str:
        """Return the role of an agent; "" where it has none."""
        if self.roles:
            return next((role for role, agents in self.roles.items() if agent in agents), "")
        return max((role for role in self.role_names if str(agent).startswith(role)), key=len, default="")

    def kind_of(self, agent: Any) -> Role:
        """Return what a learning agent sees, does and gets, as the role of one."""
        role = self.role_of(agent)
        given = {name: getattr(self, name) for name in ("observation", "action", "shared_reward", "masks")}
        return Role(name=role, num_agents=1, **{name: of_role(value, role, False) for name, value in given.items()})

    @abstractmethod
    def make_one(self) -> Any:
        """Return one new copy, a PettingZoo `ParallelEnv`."""

    def take(self, env: Any) -> Array:
        """Return the numbers of `simulated`: all that decides what follows, up to chance and what `reset` drew.

        `env` is what the task itself made, without the wrapper that shows a Gymnasium environment's agents by name.
        """
        raise NotImplementedError

    def put(self, env: Any, state: Array) -> None:
        """Put a copy that has just been reset into a state that `take` returned of another."""
        raise NotImplementedError

    def reading(self, agent: str, observation: Any) -> Array:
        """Turn what an agent is given into the numbers of the layout: an angle into (cos, sin), axes into order.

        Entries of a Dict space are taken by the names of the layout's fields, parts of a Tuple in their order.

        Raises:
            UserError: a Dict space has no entry of a field's name.
        """
        given = observation.get("observation", observation) if _has(observation, "action_mask") else observation
        if isinstance(given, Mapping):
            names = [field.name for field in self.kind_of(agent).observation.fields]
            if missing := next((name for name in names if name not in given), None):
                raise UserError(
                    f"{agent} sees {', '.join(map(str, given))}, and the layout has '{missing}'; name fields as the "
                    "entries, or define 'reading'"
                )
            given = tuple(given[name] for name in names)
        return np.concatenate([np.ravel(part) for part in given]) if isinstance(given, tuple) else np.asarray(given)

    def acting(self, agent: str, action: Any) -> Any:
        """Turn an action of the layout, stretched to the bounds of a Box that it fits, into what the environment takes.

        A task that defines it may act in any space, as Dict, MultiDiscrete or a Box of another shape.
        """
        return action

    def allowed(self, agent: str, observation: Any, info: Mapping[str, Any]) -> Array:
        """Return the mask of an agent's actions: the entry "action_mask" of its observation, or else of its info."""
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
        env = task.make_one()
        of_several = isinstance(getattr(getattr(env, "action_space", None), "spaces", None), Sequence)
        self.env = foreign.ByAgent(env, alone=False) if of_several and not hasattr(env, "possible_agents") else env
        foreign.require_kind(self.env, foreign.PARALLEL, "make_one")
        self._own = self.env.own if isinstance(self.env, foreign.ByAgent) else self.env
        self.agents = list(self.env.possible_agents)
        listed = ", ".join(map(str, self.agents)) or "none"
        groups = {role: [name for name in self.agents if task.role_of(name) == role] for role in task.role_names}
        if empty := next((role for role, names in groups.items() if not names), None):
            raise UserError(
                f"no agent's name begins with '{empty}'; the agents are {listed}; name those of a role in 'roles'"
            )
        everyone = [name for names in groups.values() for name in names] if groups else self.agents
        self.learners = [name for name in everyone if str(name).startswith(task.learners)]
        if not self.learners:
            raise UserError(f"no agent's name begins with '{task.learners}'; the agents are {listed}")
        if len(set(self.agents)) < len(self.agents):
            raise UserError("'possible_agents' names an agent twice; give each a name of its own")
        self.rest = [name for name in self.agents if name not in self.learners]
        self.simulator = Simulator(self.env, groups or {"": self.learners}, task.attributes)
        self.kinds = {name: task.kind_of(name) for name in self.learners}
        self._width = max(kind.observation.width for kind in self.kinds.values())
        spaces = [foreign.space_of(self.env, name) for name in self.learners]
        kinds = self.kinds.values()
        self._boxes = [foreign.bounds_of(space, kind.action) for space, kind in zip(spaces, kinds, strict=True)]
        starts = [getattr(space, "start", 0) for space in spaces]
        self._starts = [int(start) if np.ndim(start) == 0 else 0 for start in starts]

    def naming(self, what: str, k: int = 0) -> AbstractContextManager[None]:
        """Say that this is copy k, and what it was about, if something fails."""
        return foreign.naming(f"copy {k} of {type(self._task).__name__}", what)

    def start(self, seed: int) -> tuple[Mapping[Any, Any], ...]:
        """Reset the copy; return what its agents see, and their infos."""
        seen, infos = foreign.parts(foreign.reset(self.env, seed), "reset")
        for name in self.learners:
            if name not in seen:
                raise UserError(f"{name} gets no observation from 'reset', and agents that join later cannot learn")
        return seen, infos

    def see(self, name: Any, observation: Any) -> Array:
        """Return the numbers of the layout that a learning agent sees."""
        row = foreign.numbers(self._task.reading(name, observation), f"what {name} sees")
        if (width := row.size) != (expected := self.kinds[name].observation.width):
            raise UserError(
                f"{name} sees {width} numbers, but the layout has {expected}; where agents are unlike, begin "
                "'learners' with the name of one kind, and let the others act by 'opponent', or give 'observation' and "
                "'action' by role, as {'adversary': ..., 'agent': ...}, so that both learn"
            )
        return row

    def seen(self, given: Mapping[Any, Any]) -> Array:
        """Return what learning agents see [N, D]; zeros of those that see nothing, and behind shorter rows."""
        rows = np.zeros((len(self.learners), self._width), np.float32)
        for row, name in zip(rows, self.learners, strict=True):
            if name in given:
                row[: self.kinds[name].observation.width] = self.see(name, given[name])
        return rows

    def require_spaces(self) -> None:
        """Refuse spaces that differ from the layouts, by looking at the first observation."""
        task = self._task
        with self.naming("reset"):
            first, infos = self.start(0)
        for name, box in zip(self.learners, self._boxes, strict=True):
            with self.naming("reading"):
                self.see(name, first[name])
            action = self.kinds[name].action
            if self.kinds[name].masks and isinstance(action, Discrete):
                size = np.size(task.allowed(name, first[name], infos.get(name, {})))
                if size != action.count:
                    raise UserError(f"{name} has a mask of {size} actions, but the task has {action.count}")
            space = foreign.space_of(self.env, name)
            if box is not None and isinstance(action, Continuous):
                foreign.require_round(action, task.symmetry, name, box)
            elif type(task).acting is not CopyHooks.acting:
                continue  # it makes of the layout's actions what the space holds
            elif not isinstance(action, Discrete):
                raise UserError(f"{name} acts in {space}, but the task says {action.width} bounded real numbers")
            elif getattr(space, "n", None) != action.count or space.shape != ():
                raise UserError(f"{name} acts in {space}, but the task says {action.count} discrete actions")
        if task.state is not None and not callable(getattr(self.env, "state", None)):
            raise UserError("the task says what the state is, but its environment has no 'state' method")
        if task.state is not None and (got := self.state().size) != task.state.width:
            raise UserError(f"the environment's state has {got} numbers, but the layout has {task.state.width}")

    def native(self, i: int, action: Array) -> Any:
        """Return an action of learning agent i as the environment takes it."""
        if not isinstance(kind := self.kinds[self.learners[i]].action, Discrete):
            action = action[: kind.width]  # a row is as wide as the widest role's
        if (box := self._boxes[i]) is None:
            return self._starts[i] + int(action) if np.ndim(action) == 0 else np.nan_to_num(action).clip(-1, 1)
        low, high = box
        action = np.nan_to_num(action)  # of a seed that is about to stop: its environment should not stop the others
        return (low + (action.clip(-1, 1) + 1) / 2 * (high - low)).clip(low, high).astype(low.dtype)

    def state(self, k: int = 0) -> Array:
        """Return the global state that the environment of copy k keeps."""
        with self.naming("state", k):
            return foreign.numbers(self.env.state(), "the state")

    def take(self) -> Array:
        by_task = type(self._task).take is not CopyHooks.take
        row = self._task.take(self._own) if by_task else self.simulator.read()
        return foreign.numbers(() if row is None else row, "what 'take' returns")

    def put(self, state: Array) -> Mapping[Any, Any] | None:
        """Put the simulator into a state at a start; return what agents see then, where the environment says so."""
        if type(self._task).put is not CopyHooks.put:
            self._task.put(self._own, state)
        else:
            self.simulator.write(state)
        return self.simulator.look(self.agents)

    def close(self) -> None:
        """Let go of the copy; what it raises then concerns nobody."""
        with suppress(Exception):
            self.env.close()


def _has(place: Any, name: str) -> bool:
    return isinstance(place, Mapping) and name in place
