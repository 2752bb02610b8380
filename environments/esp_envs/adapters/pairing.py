"""The state of a simulator of others: read and set, so that a check can begin in a state and in its image.

Known are particles (the MPE tasks of mpe2 and PettingZoo), MuJoCo, and environments that keep all that moves in one
array `state`, as the classic tasks of Gymnasium. Others say how by the hooks `simulated`, `take` and `put`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from esp_envs.adapters import foreign
from esp_envs.spec import Field, Items, Kind, Layout

if TYPE_CHECKING:
    from esp_envs.adapters.hooks import Copy

Array = NDArray[Any]


_TRIED = 16
"""States that are set twice, to see whether the same follows."""
_UNLIKE = 0.1
"""Share of a number's variance that may be left to chance, of the number in the middle."""


class Simulator:
    """The simulator inside of one environment, if it is of a known kind.

    Args:
        env: the environment, with any wrappers.
        learners: names of the agents that learn.
    """

    def __init__(self, env: Any, learners: Sequence[Any]) -> None:
        self._bare, self._learners = getattr(env, "unwrapped", env), list(learners)

    @property
    def layout(self) -> Layout | None:
        """What the numbers of particles are; None of any other simulator."""
        fields = []
        for name, entities, what, items in self._columns():
            words = sum(np.size(entity.state.c) for entity in entities) if what == "c" else 0
            fields.append(Field(name, Kind.SCALAR if words else Kind.VECTOR, words or len(entities), items=items))
        return Layout(tuple(fields)) if fields else None

    def read(self) -> Array | None:
        """Return the state; None where the simulator is of no known kind."""
        bare = self._bare
        if columns := self._columns():
            return np.concatenate([np.ravel(getattr(e.state, what)) for _, some, what, _ in columns for e in some])
        if _is_mujoco(bare):
            return np.concatenate([bare.data.qpos, bare.data.qvel])
        state = getattr(bare, "state", None)
        is_row = isinstance(state, (np.ndarray, tuple, list)) and len(state) and not any(np.ndim(x) for x in state)
        return np.asarray(state, float) if is_row else None

    def write(self, numbers: Array) -> None:
        """Put it into a state."""
        bare, at = self._bare, 0
        numbers = np.array(numbers, float)
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
        bare = self._bare
        if callable(getattr(bare, "observe", None)):
            return {agent: bare.observe(agent) for agent in agents}
        get = getattr(bare, "_get_obs", getattr(bare, "_get_ob", None))
        return dict.fromkeys(agents, get()) if callable(get) else None

    def _columns(self) -> list[tuple[str, Sequence[Any], str, Items]]:
        """Return name, entities, attribute and items of each part of the state of particles; none of others."""
        world = getattr(self._bare, "world", None)
        agents, landmarks = (list(getattr(world, name, None) or []) for name in ("agents", "landmarks"))
        if not agents or not all(hasattr(getattr(e, "state", None), "p_pos") for e in [*agents, *landmarks]):
            return []
        own = [agent for name in self._learners for agent in agents if agent.name == name]
        rest = [agent for agent in agents if agent not in own]
        columns = [
            ("agents", own, "p_pos", Items.AGENTS),
            ("velocities", own, "p_vel", Items.AGENTS),
            ("rest", rest, "p_pos", Items.FIXED),
            ("rest_velocities", rest, "p_vel", Items.FIXED),
            ("landmarks", landmarks, "p_pos", Items.FIXED),
            ("landmark_velocities", [one for one in landmarks if one.movable], "p_vel", Items.FIXED),
            ("words", [agent for agent in agents if not agent.silent], "c", Items.FIXED),
        ]
        return [column for column in columns if column[1]]


def simulated(copy: Copy, observation: Layout, declared: Layout | None) -> Layout | None:
    """Return the layout of a copy's state, None where a check cannot put it into one.

    Args:
        copy: one that nobody uses yet.
        observation: what its agents see.
        declared: what the task says that the layout is.
    """
    seen = _seen(copy, copy.start(0)[0])
    size = copy.take().size
    found = declared or copy.simulator.layout
    if found is None and seen.shape == (1, size) and np.allclose(seen[0], copy.take(), atol=1e-5):
        found = observation
    if found is None or found.width != size or not _takes_effect(copy):
        return None
    return found if declared else _with_names(copy, found, observation)


def _takes_effect(copy: Copy) -> bool:
    """Return whether much the same follows a state and an action, whatever the reset before drew."""
    spaces = {name: foreign.space_of(copy.env, name) for name in copy.agents}
    for k, space in enumerate(spaces.values()):
        space.seed(k)
    reached: list[list[Array]] = []
    for k in range(_TRIED):
        copy.start(k)
        for _ in range(k % 3):
            copy.env.step({name: space.sample() for name, space in spaces.items()})
        state, action = copy.take(), {name: space.sample() for name, space in spaces.items()}
        reached.append([])
        for twin in (2, 3):
            copy.start(_TRIED * twin + k)
            if copy.put(state) is None and copy.rest:
                return False  # the others act by what they see
            reached[-1].append(_seen(copy, copy.env.step(action)[0]))
    one, other = np.array(reached).swapaxes(0, 1)
    spread = one.var(0)
    apart = ((one - other) ** 2).mean(0)[spread > 1e-12] / (2 * spread[spread > 1e-12])
    return bool(apart.size) and float(np.median(apart)) < _UNLIKE


def _with_names(copy: Copy, found: Layout, observation: Layout) -> Layout:
    """Call landmarks as agents see them, if a field shows them: one that changes round as they do."""
    marks = next((field for field in found.fields if field.name == "landmarks"), None)
    for field, where in zip(observation.fields, observation.slices().values(), strict=True):
        if marks is None or (field.kind, field.count, field.items) != (marks.kind, marks.count, marks.items):
            continue
        rows, state = [_seen(copy, copy.start(0)[0])[:, where]], copy.take()
        state[found.slices()[marks.name]] = np.roll(state[found.slices()[marks.name]], 2)
        if (seen := copy.put(state)) is not None and marks.count > 1:
            rows.append(_seen(copy, seen)[:, where])
            if np.allclose(np.roll(rows[0], 2, 1), rows[1], atol=1e-5):
                return Layout(tuple(replace(f, name=field.name) if f is marks else f for f in found.fields))
    return found


def _seen(copy: Copy, given: Mapping[Any, Any]) -> Array:
    """Return what learning agents see [N, D]; zeros of those that see nothing."""
    rows = {name: copy.see(name, given[name]) for name in copy.learners if name in given}
    return np.array([rows.get(name, np.zeros_like(next(iter(rows.values())))) for name in copy.learners])


def _is_mujoco(bare: Any) -> bool:
    data = getattr(bare, "data", None)
    return hasattr(data, "qpos") and hasattr(data, "qvel") and callable(getattr(bare, "set_state", None))
