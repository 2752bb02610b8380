"""Agents of different kinds: the roles of a task, each role's view of the worlds, and how learners share them.

A task with roles is an environment like any other. Its agents stand role after role; a row is as wide as the widest
role's, zeros fill the others, and a discrete action counts as far as the largest role's. Its spec says the rest.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

from torch import Tensor

from esp_envs.base import Environment, Observation, Step, generators_for, joined, require_shape
from esp_envs.errors import UserError
from esp_envs.promises import MakeWorlds
from esp_envs.spec import ActionSpace, Continuous, Discrete, Field, Items, Kind, Layout, TaskSpec, joint_layout, layout

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Role:
    """Agents of one kind; attributes as of `TaskSpec`.

    A field that lists the agents of another role, in their order, has that role's name as its family: the order of
    those agents then moves its items too.

    Example:
        Role(name="prey", num_agents=1, observation=layout(...), action=MOVES)
    """

    name: str
    num_agents: int
    observation: Layout
    action: ActionSpace
    shared_reward: bool = False
    masks: bool = False


def spec_with_roles(roles: Sequence[Role], *, symmetry: str, state: Layout | None = None, **named: Any) -> TaskSpec:
    """Return the spec of a task whose agents are of several kinds.

    Args:
        roles: in the order of their agents.
        symmetry: of the scene, and "agents" where those of one role may change places: "d4*agents".
        state: layout of the global state. Fields of one item for each agent of a role have its name as their family.
            By default the state is all agents' observations, one after the other.
        **named: what else a `TaskSpec` has: name, version, convention, horizon, ...

    One role alone makes a task without roles, whose rewards are shared if the role's are.

    Raises:
        UserError: no role, two of one name, a name that is no word, or actions of two sorts.
    """
    names = [role.name for role in roles]
    if len(roles) == 1:
        own = roles[0]
        state = joint_layout(own.observation, own.num_agents) if state is None else state
        return TaskSpec(**vars(own) | named, state=state, symmetry=symmetry)
    if not roles or len(set(names)) < len(names) or not all(name.isidentifier() for name in names):
        raise UserError(f"roles are named {', '.join(names) or 'not at all'}; give each a word of its own")
    actions = [role.action for role in roles]
    if len({type(action) for action in actions}) > 1:
        raise UserError(f"{' and '.join(names)} act by different sorts of actions; make all discrete or all continuous")
    width = max(role.observation.width for role in roles)
    joint = TaskSpec(
        num_agents=sum(role.num_agents for role in roles),
        observation=layout(Field("row", Kind.SCALAR, width)),
        action=_widest(actions),
        state=_every_row(roles) if state is None else state,
        symmetry=symmetry,
        shared_reward=False,
        masks=any(role.masks for role in roles),
        **named,
    )
    each = (
        replace(
            joint,
            **vars(role),
            state=_own_state(role, roles, state),
            symmetry=symmetry if role.num_agents > 1 else without_agents(symmetry) or "c1",
        )
        for role in roles
    )
    return replace(joint, roles=tuple(each))


def without_agents(transforms: str) -> str:
    """Return transforms for a role of one agent, which changes places with nobody: "d4" for "d4*agents"."""
    return "*".join(factor for factor in transforms.split("*") if factor != "agents")


def _widest(actions: Sequence[ActionSpace]) -> ActionSpace:
    counts = [action.count for action in actions if isinstance(action, Discrete)]
    if counts:
        numbers = range(max(counts))
        return Discrete(Kind.SCALAR, tuple((float(j),) for j in numbers), tuple(map(str, numbers)))
    width = max(action.width for action in actions if isinstance(action, Continuous))
    return Continuous(layout(Field("row", Kind.SCALAR, width)))


def _rows(role: Role) -> list[Field]:
    rows = joint_layout(role.observation, role.num_agents).fields
    return [replace(f, name=f"{role.name}.{f.name}", items=Items.FIXED) for f in rows]


def _every_row(roles: Sequence[Role]) -> Layout:
    return layout(*(field for role in roles for field in _rows(role)))


def _own_state(own: Role, roles: Sequence[Role], state: Layout | None) -> Layout:
    """Return the state as one role reads it: its agents are the agents, all others are things."""
    if state is not None:
        return layout(*(_follows(field, own) for field in state.fields))
    fields: list[Field] = []
    for role in roles:
        rows = joint_layout(role.observation, role.num_agents).fields
        fields += rows if role is own else [_follows(field, own) for field in _rows(role)]
    return layout(*fields)


def _follows(field: Field, own: Role | TaskSpec) -> Field:
    """Return a field whose items are the agents of a role, if they are."""
    return replace(field, items=Items.AGENTS) if field.family == own.name else field


def with_state(spec: TaskSpec, state: Layout) -> TaskSpec:
    """Return the spec of a task with another global state, see `spec_with_roles`."""
    own = ((role, layout(*(_follows(field, role) for field in state.fields))) for role in spec.roles)
    return replace(spec, state=state, roles=tuple(replace(role, state=read) for role, read in own))


class Turns(Protocol):
    """Steps the worlds with what all roles do."""

    env: Environment

    def reset(self, k: int) -> Observation:
        """Start a new episode in every world; asked for by role k."""

    def step(self, k: int, action: Tensor) -> Step:
        """Advance every world by one step, in which role k acts so [S, E, N(, width)]."""


class RoleView(Environment):
    """The worlds of a task as one role meets them: its agents, what they see, do and get.

    Args:
        turns: steps the worlds.
        role: its name.

    Example:
        prey = RoleView(OthersAtRandom(make("tag:Tag", 8, (0,))), "prey")
    """

    def __init__(self, turns: Turns, role: str) -> None:
        self.turns, self.inner = turns, turns.env
        worlds = self.inner.generators
        super().__init__(self.inner.settings, self.inner.num_envs, worlds)
        names = [spec.name for spec in self.inner.spec.roles]
        if role not in names:
            raise UserError(f"{self.inner.spec.name} has no role '{role}'; it has {', '.join(names) or 'none'}")
        self.index, self.heuristics = names.index(role), self.inner.heuristics
        self.generators = generators_for([g.initial_seed() ^ (self.index + 1) for g in worlds], self.device)

    @property
    def spec(self) -> TaskSpec:  # type: ignore[override]  # which an adapter changes where its state becomes another
        return self.inner.spec.roles[self.index]

    def reset(self) -> Observation:
        return self._seen(self.turns.reset(self.index))

    def step(self, action: Tensor) -> Step:
        require_shape("joint action", action, self.action_shape)
        step = self.turns.step(self.index, self.spec.action.admissible(action))
        return Step(
            next=self._seen(step.next),
            reward=step.reward[:, :, self._where].contiguous(),
            terminated=step.terminated.clone(),
            truncated=step.truncated.clone(),
            final=None if step.final is None else self._seen(step.final),
            metrics={name: value.clone() for name, value in step.metrics.items()},
        )

    def set_state(self, state: Tensor) -> Observation:
        return self._seen(self.inner.set_state(state))

    def settable(self) -> bool:
        return self.inner.settable()

    def has(self, method: str) -> bool:
        return self.inner.has(method)

    def heuristic(self, name: str | None = None) -> Tensor:
        return self._own(self.inner.heuristic(name))

    def action_mask(self) -> Tensor | None:
        return self.spec.own_mask(self.inner.action_mask(), self._where)

    def state_dict(self) -> dict[str, Tensor]:
        """Return this view's generators; the first role's also says where the worlds stand."""
        worlds = {f"worlds.{k}": v for k, v in self.inner.state_dict().items()} if self.index == 0 else {}
        return super().state_dict() | worlds

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        super().load_state_dict(tensors)
        if self.index == 0:
            self.inner.load_state_dict({k[7:]: v for k, v in tensors.items() if k.startswith("worlds.")})

    @property
    def _where(self) -> slice:
        return self.inner.spec.parts[self.index][1]

    def _own(self, action: Tensor) -> Tensor:
        action = action[:, :, self._where]
        return action[..., : self.action_shape[-1]] if isinstance(self.spec.action, Continuous) else action

    def _seen(self, seen: Observation) -> Observation:
        return Observation(
            seen.obs[:, :, self._where, : self.spec.observation.width].contiguous(),
            seen.state.clone(),
            self.spec.own_mask(seen.action_mask, self._where),
            None if seen.alive is None else seen.alive[:, :, self._where].contiguous(),
        )


class OthersAtRandom:
    """Worlds in which the agents of all other roles act at random, for checks of one role."""

    def __init__(self, env: Environment) -> None:
        self.env = env

    def reset(self, k: int) -> Observation:
        return self.env.reset()

    def step(self, k: int, action: Tensor) -> Step:
        joint = self.env.random_action()
        where = self.env.spec.parts[k][1]
        joint[:, :, where] = joined([action, joint[:, :, :0]])
        return self.env.step(joint)


def worlds_of_role(make: MakeWorlds, role: str) -> MakeWorlds:
    """Return what makes the worlds of one role, in which all others act at random."""
    return lambda num_envs, seeds: RoleView(OthersAtRandom(make(num_envs, seeds)), role)


class Lockstep:
    """Worlds that learners of all roles step together, each learner in a thread of its own.

    One of them computes at a time, so nothing depends on which is faster. A learner that asks for a step or a new
    episode waits until all have; then the worlds step once.
    """

    def __init__(self, env: Environment) -> None:
        self.env = env
        self._asked: list[Tensor | str] = ["" for _ in env.spec.roles]
        self._given: Any = None
        self._all = threading.Barrier(len(self._asked), self._advance)
        self._computing = threading.Lock()

    def run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        """Run one job for each role until all have ended, and return what they return; the first error ends all."""
        results: dict[int, T] = {}
        errors: list[BaseException] = []

        def work(k: int) -> None:
            with self._computing:
                try:
                    results[k] = jobs[k]()
                    self._wait(k, "the end")
                except BaseException as error:  # whatever it is, the others wait for it
                    errors.append(error)
                    self._all.abort()

        threads = [threading.Thread(target=work, args=(k,), daemon=True) for k in range(len(jobs))]
        try:
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
        except BaseException:  # an interrupt
            self._all.abort()
            raise
        self._all.reset()
        real = [error for error in errors if not isinstance(error, threading.BrokenBarrierError)]
        if errors:
            raise (real or errors)[0]
        return [results[k] for k in range(len(jobs))]

    def reset(self, k: int) -> Observation:
        self._wait(k, "a new episode")
        return self._given

    def step(self, k: int, action: Tensor) -> Step:
        self._wait(k, action)
        return self._given

    def _wait(self, k: int, asked: Tensor | str) -> None:
        self._asked[k] = asked
        self._computing.release()
        try:
            self._all.wait()
        finally:
            self._computing.acquire()

    def _advance(self) -> None:
        """Do what all have asked for."""
        actions = [asked for asked in self._asked if isinstance(asked, Tensor)]
        if len(actions) == len(self._asked):
            self._given = self.env.step(joined(actions))
            return
        words = [asked if isinstance(asked, str) else "a step" for asked in self._asked]
        if len(set(words)) > 1:
            told = ", ".join(f"{role.name} for {w}" for role, w in zip(self.env.spec.roles, words, strict=True))
            raise UserError(f"learners of roles have to step the worlds together, but here they ask: {told}")
        if words[0] == "a new episode":
            self._given = self.env.reset()


def of_role(value: Mapping[str, T] | T, role: str, otherwise: T) -> T:
    """Return what something that may be given by role is for one of them."""
    return value.get(role, otherwise) if isinstance(value, Mapping) else value
