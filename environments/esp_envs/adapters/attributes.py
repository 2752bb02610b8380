"""Attributes of an environment that hold what agents see, so that a check can begin in a state and in its image.

They serve an environment that can be copied and of which nothing else is known. A deep copy has to step as the
environment does, and so has another episode that the attributes are written into. Else they are not taken: a hidden
speed, a clock or chance decides, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np

from esp_envs.adapters import foreign
from esp_envs.adapters.hooks import Copy
from esp_envs.adapters.pairing import Array, Attributes, Path
from esp_envs.spec import Field, Items, Layout, TaskSpec

_TRIED = 16  # states that are set twice, to see whether the same follows
_UNLIKE = 0.1  # share of a number's variance that may be left to chance, of the number in the middle
_DEEP, _MOST = 6, 256  # how deep parts are looked for, and how many numbers one has at most


def deciding_attributes(copy: Copy, observation: Layout, steps: int) -> Attributes | None:
    """Return attributes that hold fields of an observation and decide what follows; None where there are none."""
    space = seeded_spaces(copy)
    lengths = [k * steps // _TRIED for k in range(_TRIED)]
    seen, parts = [], []
    for k, length in enumerate(lengths):
        seen.append(copy.seen(played(copy, space, k, length)))
        parts.append({path: part.astype(np.float32) for path, part in _leaves(copy.simulator.bare)})
    found = _matched(observation, np.array(seen, np.float32), parts)
    if not found.layout.width or (copy.rest and copy.simulator.look(copy.agents) is None):
        return None
    try:  # whatever a class refuses to be copied with, or to be written into
        return found if all(_decides(copy, found, space, k, length) for k, length in enumerate(lengths)) else None
    except Exception:
        return None


def _decides(copy: Copy, found: Attributes, space: Mapping[Any, Any], seed: int, steps: int) -> bool:
    """Return whether a deep copy steps as the environment does, and another episode that is put into its state."""
    here = copy.seen(played(copy, space, seed, steps))
    state, action = found.read(copy.simulator.bare), {name: one.sample() for name, one in space.items()}
    twin = deepcopy(copy.env)
    followed = [_outcome(copy, env, action) for env in (copy.env, twin)]
    copy.start(_TRIED + seed)
    found.write(copy.simulator.bare, state)
    shown = copy.simulator.look(copy.agents)
    pairs = [] if shown is None else [(here, copy.seen(shown))]
    pairs += [(followed[0], other) for other in (followed[1], _outcome(copy, copy.env, action))]
    return all(np.allclose(one, other, 1e-5, 1e-5) for one, other in pairs)


def _matched(observation: Layout, seen: Array, parts: Sequence[Mapping[Path, Array]]) -> Attributes:
    """Return the attributes that equal fields of what agents see [K, N, D] in all of K samples."""
    places: dict[bytes, list[tuple[Path, int]]] = {}
    for path in parts[0]:
        rows = [part.get(path, np.zeros(0)) for part in parts]
        if all(row.shape == rows[0].shape for row in rows):
            for index, column in enumerate(np.array(rows).T if len(rows[0]) else ()):
                if np.ptp(column) == 0:
                    continue  # a constant is the law of the task, and equals others by chance
                places.setdefault((column + 0.0).tobytes(), []).append((path, index))
    fields, held = list[Field](), list[list[tuple[Path, int]]]()
    for field, where in zip(observation.fields, observation.slices().values(), strict=True):
        own = [[places.get((row + 0.0).tobytes(), []) for row in each[:, where].T] for each in seen.swapaxes(0, 1)]
        moves = bool((seen[..., where].std(0) > 0).any())
        if field.items is not Items.FIXED or not moves or not all(same for each in own for same in each):
            continue
        alike = all(each == own[0] for each in own)
        if alike or field.count == 1:
            fields.append(field if alike else replace(field, count=len(own), items=Items.AGENTS, family=""))
            held += own[0] if alike else [same for each in own for same in each]
    return Attributes(Layout(tuple(fields)), held)


def _leaves(thing: Any, path: Path = (), known: set[int] | None = None) -> Iterator[tuple[Path, Array]]:
    known = set() if known is None else known
    if isinstance(thing, (bool, str, bytes, type, ModuleType)) or thing is None:
        return
    is_row = isinstance(thing, (list, tuple)) and thing and all(isinstance(one, (int, float)) for one in thing)
    if is_row or isinstance(thing, (int, float, np.number, np.ndarray)):
        if (array := np.asarray(thing)).dtype.kind in "fiu" and array.size <= _MOST:
            yield path, array.ravel()
    elif len(path) < _DEEP and id(thing) not in known:
        known.add(id(thing))
        is_attribute = not isinstance(thing, (Mapping, list, tuple))
        inside = getattr(thing, "__dict__", {}) if is_attribute else thing
        for key, part in list(inside.items() if isinstance(inside, Mapping) else enumerate(inside)):
            yield from _leaves(part, (*path, (is_attribute, key)), known)


def _outcome(copy: Copy, env: Any, action: Mapping[Any, Any]) -> Array:
    seen, reward, terminated, *_ = foreign.parts(env.step(dict(action)), "step")
    rest = [np.ravel(part.get(name, 0)) for part in (reward, terminated) for name in copy.learners]
    return np.concatenate([copy.seen(seen).ravel(), *rest]).astype(float)


def simulated_layout(copy: Copy, parts: Sequence[tuple[TaskSpec, slice]], declared: Layout | None) -> Layout | None:
    """Return the layout of the state of a known simulator, of roles at slices; None where no check can set it."""
    seen = copy.seen(copy.start(0)[0])
    size = copy.take().size
    found = declared or copy.simulator.layout
    if found is None and seen.shape == (1, size) and np.allclose(seen[0], copy.take(), atol=1e-5):
        found = parts[0][0].observation
    if found is None or found.width != size or not _takes_effect(copy):
        return None
    return found if declared else _with_names(copy, found, parts)


def seeded_spaces(copy: Copy) -> dict[Any, Any]:
    """Return the action space of each agent, from which the same actions are drawn each time."""
    spaces = {name: foreign.space_of(copy.env, name) for name in copy.agents}
    for k, space in enumerate(spaces.values()):
        space.seed(k)
    return spaces


def played(copy: Copy, space: Mapping[Any, Any], seed: int, steps: int) -> Mapping[Any, Any]:
    """Start a copy and take some random steps, up to the end of the episode; return what agents see."""
    seen = copy.start(seed)[0]
    for _ in range(steps):
        action = {name: one.sample() for name, one in space.items()}
        following, _, *flags, _ = foreign.parts(copy.env.step(action), "step")
        if any(foreign.ends(copy.env, copy.agents, *flags)):
            return copy.start(seed)[0]
        seen = following
    return seen


def _takes_effect(copy: Copy) -> bool:
    """Return whether much the same follows a state and an action, whatever the reset before drew."""
    spaces = seeded_spaces(copy)
    reached: list[list[Array]] = []
    for k in range(_TRIED):
        played(copy, spaces, k, k % 3)
        state, action = copy.take(), {name: space.sample() for name, space in spaces.items()}
        reached.append([])
        for twin in (2, 3):
            copy.start(_TRIED * twin + k)
            if copy.put(state) is None and copy.rest:
                return False  # the others act by what they see
            reached[-1].append(copy.seen(copy.env.step(action)[0]))
    one, other = np.array(reached).swapaxes(0, 1)
    spread = one.var(0)
    apart = ((one - other) ** 2).mean(0)[spread > 1e-12] / (2 * spread[spread > 1e-12])
    return bool(apart.size) and float(np.median(apart)) < _UNLIKE


def _with_names(copy: Copy, found: Layout, parts: Sequence[tuple[TaskSpec, slice]]) -> Layout:
    """Call landmarks as agents see them, if a field shows them: one that changes round as they do."""
    marks = next((field for field in found.fields if field.name == "landmarks"), None)
    if marks is None or marks.count < 2:
        return found
    before, state = copy.seen(copy.start(0)[0]), copy.take()
    state[found.slices()[marks.name]] = np.roll(state[found.slices()[marks.name]], 2)
    if (shown := copy.put(state)) is None:
        return found
    after = copy.seen(shown)
    for role, who in parts:
        for field, where in zip(role.observation.fields, role.observation.slices().values(), strict=True):
            alike = (field.kind, field.count, field.items) == (marks.kind, marks.count, marks.items)
            if alike and np.allclose(np.roll(before[who, where], 2, 1), after[who, where], atol=1e-5):
                return Layout(tuple(replace(f, name=field.name) if f is marks else f for f in found.fields))
    return found
