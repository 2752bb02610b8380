"""Agents of different kinds: the roles of a task.

A task with roles is an environment like any other. Its agents stand role after role; a row is as wide as the widest
role's, zeros fill the others, and a discrete action counts as far as the largest role's. Its spec says the rest.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from esp_envs.errors import UserError
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
    words = {name.upper().encode("ascii", "replace") for name in names}  # files and C cannot tell others apart
    if not roles or len(words) < len(names) or not all(name.isidentifier() for name in names):
        raise UserError(f"roles are named {', '.join(names) or 'not at all'}; give each a word of its own")
    actions = [role.action for role in roles]
    if len({type(action) for action in actions}) > 1:
        raise UserError(f"{' and '.join(names)} act by different sorts of actions; make all discrete or all continuous")
    width = max(role.observation.width for role in roles)
    joint = TaskSpec(
        num_agents=sum(role.num_agents for role in roles),
        observation=layout(Field("row", Kind.SCALAR, width)),
        action=_widest(actions),
        state=layout(*(field for role in roles for field in _rows(role))) if state is None else state,
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
    """Return transforms for a role of one agent, which changes places with nobody: "d4" for "d4*agents,agents-1-0"."""
    products = (part.strip().split("*") for part in transforms.split(","))
    rest = ("*".join(f for f in factors if not re.fullmatch(r"agents(-\d+)*", f)) for factors in products)
    return ",".join(filter(None, rest))


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


def of_role(value: Mapping[str, T] | T, role: str, otherwise: T) -> T:
    """Return what something that may be given by role is for one of them."""
    return value.get(role, otherwise) if isinstance(value, Mapping) else value
