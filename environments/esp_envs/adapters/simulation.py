"""Inside a VMAS simulator: its random numbers, and its entities as a layout of the global state."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor

from esp_envs.errors import UserError
from esp_envs.installed import install, last_line
from esp_envs.spec import Field, Items, Kind, Layout


def simulator(scenario: Any, num_envs: int, device: torch.device, arguments: Mapping[str, object]) -> Any:
    """Make one simulator."""
    try:
        import vmas  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise UserError(f"a VMAS task needs a package that is missing ({error.name}): {install('vmas')}") from error
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message="Scenario kwargs")  # VMAS warns of what it does not know
            own = scenario if isinstance(scenario, str) else deepcopy(scenario)  # a scenario holds its worlds
            return vmas.make_env(own, num_envs, device=device, seed=0, **arguments)
    except UserWarning as unknown:
        told = str(unknown).partition(" passed")[0].removeprefix("Scenario kwargs: ")
        raise UserError(
            f"the VMAS scenario '{scenario}' has no arguments {told}; leave them out of what 'arguments' returns"
        ) from unknown
    except (AssertionError, TypeError, SystemExit) as error:
        raise UserError(f"VMAS does not make '{scenario}' with {dict(arguments)}: {last_line(error)}") from error


def has_end(sim: Any) -> bool:
    """Whether a scenario says when an episode is over: whether its `done` is one of its own."""
    from vmas.simulator.scenario import BaseScenario  # noqa: PLC0415 - an extra

    return type(sim.scenario).done is not BaseScenario.done


def rows(given: Sequence[Any], what: str, num_envs: int, width: int | None = None) -> Tensor:
    """Return what a scenario gives each agent as [E, N, width]."""
    for k, one in enumerate(given):
        is_tensor = isinstance(one, Tensor) and one.ndim > 0
        wanted = [num_envs, one.shape[-1] if width is None and is_tensor and k == 0 else width or 0]
        if not is_tensor or one.numel() != wanted[0] * wanted[1]:
            shown = list(one.shape) if isinstance(one, Tensor) else f"a {type(one).__name__}"
            raise UserError(f"the scenario's {what} {k} is {shown}; give each agent a tensor {wanted}")
        width = wanted[1]
    return torch.stack([one.reshape(num_envs, -1) for one in given], 1).float()


def groups_of(agents: Sequence[Any], roles: Sequence[str]) -> dict[str, slice]:
    """Return where the agents of each role stand, whose names begin with it; all of them as "" without roles."""
    if not roles:
        return {"": slice(0, len(agents))}
    owner = [max((r for r in roles if a.name.startswith(r)), key=len, default="") for a in agents]
    ends = {role: (owner.index(role), owner.index(role) + owner.count(role)) for role in roles if role in owner}
    if [role for role in roles for _ in range(owner.count(role))] != owner:
        names = ", ".join(agent.name for agent in agents)
        raise UserError(f"'seen' gives the roles {', '.join(roles)} for {names}; begin names so, in the agents' order")
    return {role: slice(*where) for role, where in ends.items()}


def force_of(agent: Any) -> float:
    """Return the full force of an agent, which has to act by a force in the plane of one range."""
    if agent.action_size != 2 or torch.as_tensor(agent.u_range).numel() != 1 or not agent.silent:
        raise UserError(f"agent {agent.name} acts by other numbers than a force in the plane with one u_range")
    return float(agent.u_range)


class RandomNumbers:
    """The random numbers of one simulator. VMAS has one state for all simulators; this exchanges it around a call."""

    def __init__(self, seed: int) -> None:
        self._state = torch.Generator().manual_seed(seed).get_state()

    @contextlib.contextmanager
    def drawn(self) -> Iterator[None]:
        """Let VMAS draw these numbers; a scenario that calls sys.exit ends no run with code 0."""
        from vmas.simulator.environment import Environment  # noqa: PLC0415 - an extra

        shared = Environment.vmas_random_state
        before, shared[0] = shared[0], self._state
        try:
            yield
        except SystemExit as error:
            raise UserError(f"the VMAS scenario raises {last_line(error)}") from error
        finally:
            self._state, shared[0] = shared[0], before


_STATE = ("pos", "vel", "rot", "ang_vel")  # what an entity's state holds; anything else is a flag of the entity itself


class Entities:
    """The entities of a simulator as the global state."""

    def __init__(
        self, sim: Any, own_goals: str, flags: Sequence[str], angles: Sequence[str], groups: Mapping[str, slice]
    ) -> None:
        """Take the agents by role; the role "" is of a scenario without roles."""
        self._angles = angles
        landmarks = sim.world.landmarks
        goals = [entity for entity in landmarks if own_goals and entity.name.startswith(own_goals)]
        if goals and len(goals) != len(sim.agents):
            raise UserError(
                f"{len(goals)} landmarks are named '{own_goals}...' for {len(sim.agents)} agents; one belongs to each"
            )
        rest = [entity for entity in landmarks if entity not in goals]
        scripted = [agent for agent in sim.world.agents if agent not in sim.agents]
        self._columns: list[tuple[Field, list[int], str]] = []  # and which of the world's entities, and what of them
        for role, where in groups.items():
            self._add(role or "agents", sim, sim.agents[where], Items.FIXED if role else Items.AGENTS, role)
        self._add("goals", sim, goals, Items.AGENTS if "" in groups else Items.FIXED)
        for entity in (*rest, *scripted):
            self._add(entity.name.replace(" ", "_"), sim, [entity], Items.FIXED)
        for flag in flags:
            held = [sim.world.entities.index(entity) for entity in rest if hasattr(entity, flag)]
            self._columns.append((Field(flag, Kind.SCALAR, len(held), "0 or 1"), held, flag))
        self.layout = Layout(tuple(field for field, *_ in self._columns))

    def read(self, sim: Any) -> Tensor:
        """Return the global state [E, state width]."""
        parts, entities = [], sim.world.entities
        for _, index, what in self._columns:
            for i in index:
                part = getattr(entities[i].state if what in _STATE else entities[i], what).float()
                parts.append(torch.cat([part.cos(), part.sin()], -1) if what == "rot" else part.reshape(len(part), -1))
        return torch.cat(parts, -1)

    def write(self, sim: Any, state: Tensor) -> None:
        """Put the entities into a global state [E, state width]."""
        start, entities = 0, sim.world.entities
        for field, index, what in self._columns:
            for i in index:
                part = state[:, start : start + field.item_width].clone()
                start += field.item_width
                if what == "rot":
                    part = torch.atan2(part[:, 1:], part[:, :1])
                if what in _STATE:
                    setattr(entities[i].state, what, part)
                else:
                    flag = getattr(entities[i], what)
                    setattr(entities[i], what, part.view_as(flag).to(flag.dtype))

    def _add(self, name: str, sim: Any, entities: Sequence[Any], items: Items, family: str = "") -> None:
        if not entities:
            return
        first, index = entities[0], [sim.world.entities.index(entity) for entity in entities]
        columns = [("pos", "position", Kind.VECTOR, "length")]
        if first.movable:
            columns.append(("vel", "velocity", Kind.VECTOR, "length/s"))
        turns = first.rotatable and type(first.shape).__name__ != "Sphere"
        if turns or first.name in self._angles:
            columns.append(("rot", "heading", Kind.VECTOR, "direction"))
        if turns:
            columns.append(("ang_vel", "spin", Kind.PSEUDOSCALAR, "rad/s"))
        for what, word, kind, unit in columns:
            field = Field(f"{name}.{word}", kind, len(index), unit, items, family=family)
            self._columns.append((field, index, what))
