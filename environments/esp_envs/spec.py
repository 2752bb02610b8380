"""What agents do, and all that a learner knows of a task; `esp_envs.fields` says what numbers are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING

from esp_envs.errors import UserError
from esp_envs.fields import Family, Field, Items, Kind, Layout, filled_layout, joint_layout, layout, others_of

if TYPE_CHECKING:
    from torch import Tensor

__all__ = [
    "DOWN",
    "LEFT",
    "RIGHT",
    "UP",
    "ActionSpace",
    "Continuous",
    "Discrete",
    "Family",
    "Field",
    "Items",
    "Kind",
    "Layout",
    "Spaces",
    "TaskSpec",
    "describe_action",
    "discrete_moves",
    "filled_layout",
    "joint_layout",
    "layout",
    "others_of",
]


@dataclass(frozen=True)
class Discrete:
    """One categorical choice per agent.

    Attributes:
        kind: what the points below are.
        points: the physical meaning of action j as one item of `kind`: a direction, a wheel pair, ... Several actions
            may have one meaning (stay and load, walk right and push right); a transform keeps their order.
        names: one word per action.
    """

    kind: Kind
    points: tuple[tuple[float, ...], ...]
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        if len(self.points) != len(self.names) or len(set(self.names)) != len(self.names):
            raise UserError("each action needs one meaning and a name of its own")
        if any(len(p) != self.kind.width for p in self.points):
            raise UserError(f"a meaning of kind {self.kind.name} has {self.kind.width} numbers")

    @property
    def count(self) -> int:
        """A, the number of actions."""
        return len(self.points)

    def holds(self, action: Tensor) -> bool:
        """Return whether all are indices of actions."""
        return not action.is_floating_point() and int(action.min()) >= 0 and int(action.max()) < self.count

    def admissible(self, action: Tensor) -> Tensor:
        """Return actions as they are; a UserError refuses what is none, where no GPU is waited for."""
        if not (self.holds(action) if action.device.type == "cpu" else not action.is_floating_point()):
            raise UserError(f"the joint action holds other than the indices 0 to {self.count - 1}")
        return action


@dataclass(frozen=True)
class Continuous:
    """A bounded real action vector per agent.

    Each item of a kind that is a vector lives in the unit disc or ball. A longer one is scaled back to length 1, so
    that every rotation maps the action set to itself. Each number of any other kind is clipped to [-1, 1].
    """

    layout: Layout

    def __post_init__(self) -> None:
        for part in self.layout.fields:
            if part.kind in (Kind.PICTURE, Kind.RING, Kind.RECORD):
                raise UserError(f"an action cannot hold '{part.name}', a {part.kind.name}; give vectors and numbers")

    @property
    def width(self) -> int:
        """Numbers per agent."""
        return self.layout.width

    def admissible(self, action: Tensor) -> Tensor:
        """Return actions [..., width] as the task takes them: vectors of length 1 at most, other numbers clipped."""
        within = action.clamp(-1.0, 1.0)
        for part, where in zip(self.layout.fields, self.layout.slices().values(), strict=True):
            if part.kind.is_vector:
                vectors = action[..., where].unflatten(-1, (-1, part.kind.width))
                within[..., where] = (vectors / vectors.norm(dim=-1, keepdim=True).clamp_min(1.0)).flatten(-2)
        return within


ActionSpace = Discrete | Continuous

RIGHT, LEFT, DOWN, UP = (1.0, 0.0), (-1.0, 0.0), (0.0, -1.0), (0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Spaces:
    """What a symmetry acts on: all that transforms, a prior and equivariant networks need to know of a task.

    Attributes:
        num_agents: N, learning agents.
        observation: layout of one agent's row, D numbers.
        state: layout of the global state that a centralised critic or mixer may see.
        action: the action space, the same for every agent.
        symmetry: the group that leaves *dynamics and reward* alone, or generators of it: what holds of the scene ("d4",
            "flip-y"), times "agents" and FIELD-COUNT where agents or like items may change places
            ("d4*agents*landmarks-3"), or coupled with such orders ("flip-x*agents-3-2-1-0").
        nearly: a larger symmetry that holds nearly, which a prior may use all the same; empty where there is none.
        masks: whether each observation says which of the discrete actions each agent may take.
        shifts: whether dynamics and reward stay as they are when every place (`Field.is_point`) is shifted alike.
    """

    num_agents: int
    observation: Layout
    state: Layout
    action: ActionSpace
    symmetry: str
    nearly: str = ""
    masks: bool = False
    shifts: bool = False

    @property
    def is_joint(self) -> bool:
        """Whether the state is all agents' observations end to end."""
        return self.joint_fields == slice(0, len(self.state.fields))

    @property
    def joint_fields(self) -> slice | None:
        """Which fields of the state are all agents' observations end to end; None where there are none."""
        count = self.num_agents * len(self.observation.fields)
        starts = range(len(self.state.fields) - count + 1)
        own = joint_layout(self.observation, self.num_agents).fields if starts else ()  # which takes time for many
        return next((slice(k, k + count) for k in starts if self.state.fields[k : k + count] == own), None)

    @property
    def label(self) -> str:
        """What messages call these spaces."""
        return "the task"


@dataclass(frozen=True, kw_only=True)
class TaskSpec(Spaces):
    """All that a learner, a prior or an exporter needs to know of a task; see also `Spaces`.

    Attributes:
        name: registry name.
        version: bumped by any change of observation, action, reward or start distribution.
        convention: the reward convention in a few words; printed beside every number.
        horizon: steps of an episode, at which it is truncated.
        shared_reward: whether all agents get the same reward, so that one value per world suffices.
        control_period_s: simulated seconds of one step, for rendering in real time.
        totals: names of the metrics that add up over an episode; the others are averaged over its steps.
        terminates: whether an episode can reach an end of its own before the horizon, each world at another time.
        agents_end: whether an agent can reach an end of its own before its episode, which goes on for the others.
        hidden: what decides what follows and is not in the global state, as "delayed actions".
        roles: the agents by kind, where there is more than one, as `esp_envs.roles.spec_with_roles` makes them; each is
            the task as one kind meets it. Rows and actions are then as wide as the widest, the rest is 0.
    """

    name: str
    version: int
    convention: str
    horizon: int
    shared_reward: bool = True
    control_period_s: float = 0.1
    totals: tuple[str, ...] = ()
    terminates: bool = False
    agents_end: bool = False
    hidden: tuple[str, ...] = ()
    settings: dict[str, object] = field(default_factory=dict)
    roles: tuple[TaskSpec, ...] = ()

    @property
    def label(self) -> str:
        return self.name

    @property
    def parts(self) -> tuple[tuple[TaskSpec, slice], ...]:
        """Each role and where its agents are among all; the task itself and everyone where it has no roles."""
        stops = list(accumulate(role.num_agents for role in self.roles))
        each = zip(self.roles, pairwise([0, *stops]), strict=True)
        return tuple((role, slice(*ends)) for role, ends in each) or ((self, slice(0, self.num_agents)),)

    def own_mask(self, mask: Tensor | None, where: slice) -> Tensor | None:
        """Return the part of a joint mask [S, E, N, A] that is of this role, whose agents are there; None without."""
        if mask is None or not self.masks or not isinstance(self.action, Discrete):
            return None
        return mask[:, :, where, : self.action.count].contiguous()

    def admissible(self, action: Tensor) -> Tensor:
        """Return a joint action as the task takes it, see `Continuous`; a role's last action stands for larger ones."""
        if not self.roles:
            return self.action.admissible(action)
        action = action.clone()
        for role, where in self.parts:
            if isinstance(role.action, Discrete):
                action[:, :, where] = action[:, :, where].clamp_max(role.action.count - 1)
            else:
                numbers = slice(role.action.width)
                action[:, :, where, numbers] = role.action.admissible(action[:, :, where, numbers])
        return action

    def __post_init__(self) -> None:
        if self.num_agents < 1 or self.horizon < 1:
            raise UserError(f"task {self.name}: agents and horizon must be positive")
        if not 0 < self.control_period_s < math.inf:
            raise UserError(f"task {self.name}: control_period_s is {self.control_period_s}; give seconds above 0")
        if self.masks and not isinstance(self.action, Discrete):
            raise UserError(f"task {self.name}: masks are for discrete actions; leave 'masks' out")


def describe_action(action: ActionSpace) -> Sequence[tuple[str, str]]:
    """Return (name, meaning) rows of an action space for cards."""
    if isinstance(action, Discrete):
        return [
            (f"{j} {name}", "(" + ", ".join(f"{x:g}" for x in p) + ")")
            for j, (name, p) in enumerate(zip(action.names, action.points, strict=True))
        ]
    return [(f.name, f"{f.described} {f.unit}".strip()) for f in action.layout.fields]


_MOVES = {"stay": (0.0, 0.0), "right": RIGHT, "up": UP, "left": LEFT, "down": DOWN}


def discrete_moves(moves: int | Sequence[str]) -> Discrete:
    """Return the actions of an agent that moves in one of some directions of the plane.

    Args:
        moves: how many directions, counter-clockwise from the right (4: right, up, left, down), or their names in the
            order of the action's index, of "stay", "right", "up", "left" and "down".

    Raises:
        UserError: a name is unknown or repeated; there is no direction; or it is neither a number nor names.
    """
    if isinstance(moves, int):
        if moves < 1:
            raise UserError(f"discrete_moves({moves}) has no direction; give 1 or more, or names")
        if moves == 4:
            return discrete_moves(tuple(_MOVES)[1:])
        angles = [2 * math.pi * k / moves for k in range(moves)]
        names = tuple(f"{360 * k / moves:g} degrees" for k in range(moves))
        return Discrete(Kind.VECTOR, tuple((math.cos(a), math.sin(a)) for a in angles), names)
    if not isinstance(moves, Sequence):
        raise UserError(f"discrete_moves({moves!r}) is neither a number of directions nor their names; give one")
    for index, name in enumerate(moves):
        if name not in _MOVES or name in moves[:index]:
            wrong = "does not know" if name not in _MOVES else "was given twice"
            raise UserError(f"discrete_moves {wrong} '{name}'; write {', '.join(_MOVES)} once each, or a number")
    return Discrete(Kind.VECTOR, tuple(_MOVES[name] for name in moves), tuple(moves))
