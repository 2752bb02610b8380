"""Whether a copy of an environment of others can be put into states, and what the numbers of its state are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from esp_envs.adapters import foreign
from esp_envs.adapters.hooks import Array, Copy
from esp_envs.spec import Layout

_TRIED = 16
"""States that are set twice, to see whether the same follows."""
_UNLIKE = 0.1
"""Share of a number's variance that may be left to chance, of the number in the middle."""


def simulated_layout(copy: Copy, observation: Layout, declared: Layout | None) -> Layout | None:
    """Return the layout of the state of a known simulator, None where a check cannot put it into one.

    Args:
        copy: one that nobody uses yet.
        observation: what its agents see.
        declared: what the task says that the layout is.
    """
    seen = copy.seen(copy.start(0)[0])
    size = copy.take().size
    found = declared or copy.simulator.layout
    if found is None and seen.shape == (1, size) and np.allclose(seen[0], copy.take(), atol=1e-5):
        found = observation
    if found is None or found.width != size or not _takes_effect(copy):
        return None
    return found if declared else _with_names(copy, found, observation)


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
        if any(map(any, foreign.ends(copy.env, copy.agents, *flags))):
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


def _with_names(copy: Copy, found: Layout, observation: Layout) -> Layout:
    """Call landmarks as agents see them, if a field shows them: one that changes round as they do."""
    marks = next((field for field in found.fields if field.name == "landmarks"), None)
    for field, where in zip(observation.fields, observation.slices().values(), strict=True):
        if marks is None or (field.kind, field.count, field.items) != (marks.kind, marks.count, marks.items):
            continue
        rows, state = [copy.seen(copy.start(0)[0])[:, where]], copy.take()
        state[found.slices()[marks.name]] = np.roll(state[found.slices()[marks.name]], 2)
        if (seen := copy.put(state)) is not None and marks.count > 1:
            rows.append(copy.seen(seen)[:, where])
            if np.allclose(np.roll(rows[0], 2, 1), rows[1], atol=1e-5):
                return Layout(tuple(replace(f, name=field.name) if f is marks else f for f in found.fields))
    return found
