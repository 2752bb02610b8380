"""The state of a simulator of others: read and set, so that a check can begin in a state and in its image.

Known are particles (the MPE tasks of mpe2 and PettingZoo), MuJoCo, and environments that keep all that moves in one
array `state`, as the classic tasks of Gymnasium. Of others that can be copied, `attributes` are looked for that hold
what agents see. The rest says how by the hooks `simulated`, `take` and `put`.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from esp_envs.spec import Field, Items, Kind, Layout

Array = NDArray[Any]
Path = tuple[tuple[bool, Any], ...]
"""From an environment to one of its parts: whether each step is an attribute or an entry, and which one."""


class Attributes:
    """Numbers inside of an environment that are those of a layout: of each, paths of parts and its index in them."""

    def __init__(self, layout: Layout, places: Sequence[Sequence[tuple[Path, int]]]) -> None:
        self.layout, self._places = layout, places

    def read(self, bare: Any) -> Array:
        return np.array([np.ravel(_follow(bare, same[0][0]))[same[0][1]] for same in self._places])

    def write(self, bare: Any, numbers: Array) -> None:
        """Write the numbers, whole ones where whole ones stand."""
        for number, same in zip(numbers, self._places, strict=True):
            for path, index in same:
                old = _follow(bare, path)
                new = np.array(old)
                new.flat[index] = number if new.dtype.kind == "f" else round(float(number))
                kept = new if isinstance(old, np.ndarray) else type(old)(new.tolist())
                owner, (is_attribute, key) = _follow(bare, path[:-1]), path[-1]
                if is_attribute:
                    setattr(owner, key, kept)
                else:
                    owner[key] = kept


class Simulator:
    """The simulator inside of an environment if it is of a known kind; else `attributes` say where its state stands."""

    def __init__(self, env: Any, learners: Mapping[str, Sequence[Any]], attributes: Attributes | None = None) -> None:
        """Take the learning agents by role; the role "" is of a task without roles."""
        self.bare, self._learners = getattr(env, "unwrapped", env), learners
        self._attributes = attributes

    @property
    def layout(self) -> Layout | None:
        """What the numbers of particles are; None of any other simulator."""
        fields = []
        for name, entities, what, items in self._columns():
            words = sum(np.size(entity.state.c) for entity in entities) if what == "c" else 0
            role = name.rpartition(".")[0]
            kind = Kind.SCALAR if words else Kind.VECTOR
            fields.append(Field(name, kind, words or len(entities), items=items, family=role))
        return Layout(tuple(fields)) if fields else None

    def read(self) -> Array | None:
        """Return the state; None where the simulator is of no known kind."""
        bare = self.bare
        if self._attributes is not None:
            return self._attributes.read(bare)
        if columns := self._columns():
            return np.concatenate([np.ravel(getattr(e.state, what)) for _, some, what, _ in columns for e in some])
        if _is_mujoco(bare):
            return np.concatenate([bare.data.qpos, bare.data.qvel])
        state = getattr(bare, "state", None)
        is_row = isinstance(state, (np.ndarray, tuple, list)) and len(state) and not any(np.ndim(x) for x in state)
        return np.asarray(state, float) if is_row else None

    def write(self, numbers: Array) -> None:
        bare, at = self.bare, 0
        numbers = np.array(numbers, float)
        if self._attributes is not None:
            self._attributes.write(bare, numbers)
            return
        for _, entities, what, _ in self._columns():
            for entity in entities:
                width = np.size(getattr(entity.state, what))
                setattr(entity.state, what, numbers[at : at + width].copy())
                at += width
        if _is_mujoco(bare):
            bare.set_state(numbers[: bare.model.nq], numbers[bare.model.nq :])
        elif not at:
            bare.state = numbers if isinstance(bare.state, np.ndarray) else type(bare.state)(numbers.tolist())

    def look(self, agents: Sequence[Any]) -> Mapping[Any, Any] | None:
        """Return what agents see now, without a step; None where the environment has no way to say so."""
        bare = self.bare
        if callable(getattr(bare, "observe", None)):
            return {agent: bare.observe(agent) for agent in agents}
        get = getattr(bare, "_get_obs", getattr(bare, "_get_ob", None))
        if not callable(get):
            return None
        try:
            inspect.signature(get).bind()
        except (TypeError, ValueError):  # it has to be told of whom
            return None
        seen = get()
        if isinstance(seen, Mapping) and set(agents) <= set(seen):
            return seen
        by_agent = isinstance(seen, tuple | list) and len(seen) == len(agents) > 1
        return dict(zip(agents, seen, strict=True)) if by_agent else dict.fromkeys(agents, seen)

    def _columns(self) -> list[tuple[str, Sequence[Any], str, Items]]:
        """Return name, entities, attribute and items of each part of the state of particles; none of others."""
        world = getattr(self.bare, "world", None)
        agents, landmarks = (list(getattr(world, name, None) or []) for name in ("agents", "landmarks"))
        if not agents or not all(hasattr(getattr(e, "state", None), "p_pos") for e in [*agents, *landmarks]):
            return []
        by_name = {agent.name: agent for agent in agents}
        groups = {role: [by_name[n] for n in names if n in by_name] for role, names in self._learners.items()}
        rest = [agent for agent in agents if not any(agent in own for own in groups.values())]
        columns = [
            (f"{role}.{name}".lstrip("."), own, what, Items.FIXED if role else Items.AGENTS)
            for role, own in groups.items()
            for name, what in (("agents", "p_pos"), ("velocities", "p_vel"))
        ]
        columns += [
            ("rest", rest, "p_pos", Items.FIXED),
            ("rest_velocities", rest, "p_vel", Items.FIXED),
            ("landmarks", landmarks, "p_pos", Items.FIXED),
            ("landmark_velocities", [one for one in landmarks if one.movable], "p_vel", Items.FIXED),
            ("words", [agent for agent in agents if not agent.silent], "c", Items.FIXED),
        ]
        return [column for column in columns if column[1]]


def _is_mujoco(bare: Any) -> bool:
    data = getattr(bare, "data", None)
    return hasattr(data, "qpos") and hasattr(data, "qvel") and callable(getattr(bare, "set_state", None))


def _follow(thing: Any, path: Path) -> Any:
    for is_attribute, key in path:
        thing = getattr(thing, key) if is_attribute else thing[key]
    return thing
