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
from esp_envs.adapters.hooks import Array, Copy
from esp_envs.adapters.pairing import Attributes, Path
from esp_envs.adapters.settable import played, seeded_spaces
from esp_envs.spec import Field, Items, Layout

_TRIED = 16
_DEEP, _MOST = 6, 256
"""How deep parts are looked for, and how many numbers one has at most."""


def deciding_attributes(copy: Copy, observation: Layout, steps: int) -> Attributes | None:
    """Return attributes that hold fields of an observation and decide what follows; None where there are none.

    Args:
        copy: one that nobody uses yet.
        observation: what its agents see.
        steps: of an episode.
    """
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
    """Yield all numbers inside of a thing, a number or a row of them at a time."""
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
