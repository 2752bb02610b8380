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
from esp_envs.spec import Field, Items, Layout

_TRIED = 16
_DEEP, _MOST = 4, 256
"""How deep parts are looked for, and how many numbers one has at most."""


def deciding_attributes(copy: Copy, observation: Layout, steps: int) -> Attributes | None:
    """Return attributes that hold fields of an observation and decide what follows; None where there are none.

    Args:
        copy: one that nobody uses yet.
        observation: what its agents see.
        steps: of an episode.
    """
    space = {name: foreign.space_of(copy.env, name) for name in copy.agents}
    for k, one in enumerate(space.values()):
        one.seed(k)
    lengths = [k * steps // _TRIED for k in range(_TRIED)]
    seen, parts = [], []
    for k, length in enumerate(lengths):
        seen.append(copy.seen(_played(copy, space, k, length)))
        parts.append({path: part.astype(np.float32) for path, part in _leaves(copy.simulator.bare)})
    found = _matched(observation, np.array(seen, np.float32), parts)
    if not found.layout.width or (copy.rest and copy.simulator.look(copy.agents) is None):
        return None
    for k, length in enumerate(lengths):
        _played(copy, space, k, length)
        state, action = found.read(copy.simulator.bare), {name: one.sample() for name, one in space.items()}
        try:
            twin = deepcopy(copy.env)
        except Exception:  # whatever a class refuses to be copied with
            return None
        followed = [_outcome(copy, env, action) for env in (copy.env, twin)]
        copy.start(_TRIED + k)
        found.write(copy.simulator.bare, state)
        followed.append(_outcome(copy, copy.env, action))
        if not all(np.allclose(followed[0], other, 1e-5, 1e-5) for other in followed[1:]):
            return None
    return found


def _matched(observation: Layout, seen: Array, parts: Sequence[Mapping[Path, Array]]) -> Attributes:
    """Return the attributes that equal fields of what agents see [K, N, D] in all of K samples."""
    places: dict[bytes, list[tuple[Path, int]]] = {}
    for path in parts[0]:
        rows = [part.get(path, np.zeros(0)) for part in parts]
        if all(row.shape == rows[0].shape for row in rows):
            for index, column in enumerate(np.array(rows).T):
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


def _played(copy: Copy, space: Mapping[Any, Any], seed: int, steps: int) -> Mapping[Any, Any]:
    """Start a copy and take some random steps, up to the end of the episode; return what agents see."""
    seen = copy.start(seed)[0]
    for _ in range(steps):
        action = {name: one.sample() for name, one in space.items()}
        following, _, *flags, _ = foreign.parts(copy.env.step(action), "step")
        if any(map(any, foreign.ends(copy.env, copy.agents, *flags))):
            return copy.start(seed)[0]
        seen = following
    return seen


def _outcome(copy: Copy, env: Any, action: Mapping[Any, Any]) -> Array:
    seen, reward, terminated, *_ = foreign.parts(env.step(dict(action)), "step")
    rest = [np.ravel(part.get(name, 0)) for part in (reward, terminated) for name in copy.learners]
    return np.concatenate([copy.seen(seen).ravel(), *rest]).astype(float)
