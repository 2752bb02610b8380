"""Inside a VMAS simulator: its tensors by name, its random numbers, its entities as a layout of the global state."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from esp_envs.base import Observation
from esp_envs.errors import UserError
from esp_envs.extras import install
from esp_envs.spec import Field, Items, Kind, Layout

Tensors = dict[str, Tensor]


@dataclass(frozen=True)
class Start:
    """The tensors of a simulator in which an episode begins in every world, and what is seen there."""

    tensors: Tensors
    seen: Observation


def maker(scenario: Any, num_envs: int, device: torch.device, arguments: Mapping[str, object]) -> Callable[[], Any]:
    """Return what makes one simulator.

    Raises:
        UserError: VMAS is missing, or the scenario does not take the arguments.
    """
    try:
        import vmas  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise UserError(f"a VMAS task needs a package that is missing ({error.name}): {install('vmas')}") from error

    def make() -> Any:
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("error", message="Scenario kwargs")  # VMAS warns of what it does not know
                return vmas.make_env(scenario, num_envs, device=device, seed=0, **arguments)
        except UserWarning as unknown:
            told = str(unknown).partition(" passed")[0].removeprefix("Scenario kwargs: ")
            raise UserError(
                f"the VMAS scenario '{scenario}' has no arguments {told}; leave them out of what 'arguments' returns"
            ) from unknown
        except (AssertionError, TypeError) as error:
            raise UserError(f"VMAS does not make '{scenario}' with {dict(arguments)}: {error}") from error

    return make


class RandomNumbers:
    """The random numbers of one simulator. VMAS has one state for all simulators; this exchanges it around a call."""

    def __init__(self, seed: int) -> None:
        self.begin(seed)

    def begin(self, seed: int) -> None:
        """Begin with the numbers of a seed."""
        self.state = torch.Generator().manual_seed(seed).get_state()

    @contextlib.contextmanager
    def drawn(self) -> Iterator[None]:
        """Let VMAS draw these numbers."""
        from vmas.simulator.environment import Environment  # noqa: PLC0415 - an extra

        shared = Environment.vmas_random_state
        before, shared[0] = shared[0], self.state
        try:
            yield
        finally:
            self.state, shared[0] = shared[0], before


def snapshot(sim: Any) -> Tensors:
    """Return a copy of every tensor of a simulator that has a row for each world."""
    return {name: tensor.clone() for name, _, _, tensor in _tensors(sim)}


def restore(sim: Any, tensors: Tensors) -> None:
    """Put a simulator into the state of a `snapshot`, which may hold more than the simulator has used so far."""
    owners = dict(_owners(sim))
    for name, tensor in tensors.items():
        path, _, key = name.rpartition(".")
        if path in owners:
            _put(owners[path], key, tensor)


def copy_worlds(tensors: Tensors, sim: Any, which: Tensor) -> None:
    """Copy some worlds [E] of a snapshot into a simulator."""
    for name, owner, key, tensor in list(_tensors(sim)):
        if name in tensors and tensors[name].shape == tensor.shape:
            mask = which.view(-1, *(1,) * (tensor.dim() - 1))
            _put(owner, key, torch.where(mask, tensors[name], tensor))


def _put(owner: Any, key: str, tensor: Tensor) -> None:
    """Write a tensor in place, so that other names of it follow; set it where there is none of its shape."""
    values = owner if isinstance(owner, list | dict) else vars(owner)
    place: Any = int(key) if isinstance(owner, list) else key
    old = values.get(place) if isinstance(values, dict) else values[place]
    if isinstance(old, Tensor) and old.shape == tensor.shape and old.dtype == tensor.dtype and 0 not in old.stride():
        old.copy_(tensor)
    else:
        values[place] = tensor.clone()


def _tensors(sim: Any) -> Iterator[tuple[str, Any, str, Tensor]]:
    """Yield name, owner, key and tensor of everything that has a row for each world."""
    for path, owner in _owners(sim):
        for key, value in _items(owner):
            if isinstance(value, Tensor) and value.dim() and value.shape[0] == sim.num_envs:
                yield f"{path}.{key}", owner, key, value


def _owners(sim: Any) -> Iterator[tuple[str, Any]]:
    """Yield the objects of a simulator that may hold tensors, each once, by a path that does not depend on its past."""
    known: set[int] = set()
    waiting: list[tuple[str, Any]] = [("scenario", sim.scenario), ("world", sim.world)]
    while waiting:
        path, owner = waiting.pop()
        if id(owner) in known:
            continue
        known.add(id(owner))
        yield path, owner
        waiting += [(f"{path}.{key}", value) for key, value in _items(owner) if _may_hold(value)]


def _items(owner: Any) -> list[tuple[str, Any]]:
    if isinstance(owner, list | tuple):
        return [(str(i), value) for i, value in enumerate(owner)]
    if isinstance(owner, dict):
        return [(key, value) for key, value in owner.items() if isinstance(key, str)]
    return list(vars(owner).items())


def _may_hold(value: Any) -> bool:
    if isinstance(value, list | tuple | dict):
        return True
    bases = type(value).__mro__
    return any(base.__module__.startswith("vmas.") for base in bases) and hasattr(value, "__dict__")


class Entities:
    """The entities of a simulator as the global state.

    Args:
        sim: a simulator of the scenario.
        own_goals: what the names of landmarks begin with that belong to one agent each.
        flags: attributes of landmarks that are 0 or 1 for each world.
    """

    def __init__(self, sim: Any, own_goals: str, flags: Sequence[str]) -> None:
        landmarks = sim.world.landmarks
        goals = [i for i, entity in enumerate(landmarks) if own_goals and entity.name.startswith(own_goals)]
        if goals and len(goals) != len(sim.agents):
            raise UserError(
                f"{len(goals)} landmarks are named '{own_goals}...' for {len(sim.agents)} agents; one belongs to each"
            )
        rest = [i for i in range(len(landmarks)) if i not in goals]
        self._columns: list[tuple[Field, bool, list[int], str]] = []
        agents = list(range(len(sim.agents)))
        self._add("agents", sim.agents, True, agents, Items.AGENTS)
        self._add("goals", landmarks, False, goals, Items.AGENTS)
        for i in rest:
            self._add(landmarks[i].name.replace(" ", "_"), landmarks, False, [i], Items.FIXED)
        for flag in flags:
            held = [i for i in rest if hasattr(landmarks[i], flag)]
            self._columns.append((Field(flag, Kind.SCALAR, len(held), "0 or 1"), False, held, flag))
        self.layout = Layout(tuple(field for field, *_ in self._columns))

    def read(self, sim: Any) -> Tensor:
        """Return the global state [E, state width]."""
        parts = []
        for _, of_agents, index, what in self._columns:
            entities = sim.agents if of_agents else sim.world.landmarks
            for i in index:
                part = getattr(entities[i].state if what in _STATE else entities[i], what).float()
                parts.append(torch.cat([part.cos(), part.sin()], -1) if what == "rot" else part.reshape(len(part), -1))
        return torch.cat(parts, -1)

    def write(self, sim: Any, state: Tensor) -> None:
        """Put the entities into a global state [E, state width]."""
        start = 0
        for field, of_agents, index, what in self._columns:
            entities = sim.agents if of_agents else sim.world.landmarks
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

    def _add(self, name: str, entities: Sequence[Any], of_agents: bool, index: list[int], items: Items) -> None:
        """Add the columns of some entities that are alike."""
        if not index:
            return
        first = entities[index[0]]
        columns = [("pos", "position", Kind.VECTOR, "length")]
        if first.movable:
            columns.append(("vel", "velocity", Kind.VECTOR, "length/s"))
        if first.rotatable and not _is_round(first):
            columns.append(("rot", "heading", Kind.VECTOR, "direction"))
            columns.append(("ang_vel", "spin", Kind.PSEUDOSCALAR, "rad/s"))
        for what, word, kind, unit in columns:
            self._columns.append((Field(f"{name}.{word}", kind, len(index), unit, items), of_agents, index, what))


_STATE = ("pos", "vel", "rot", "ang_vel")
"""What an entity's state holds; anything else is a flag of the entity itself."""


def _is_round(entity: Any) -> bool:
    return type(entity.shape).__name__ == "Sphere"
