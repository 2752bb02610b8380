"""Compare a step from a state with the step from the transformed state, as distributions.

From each state s and joint action a, two runs with chance of their own give outcomes X and X', transformed by g; two
runs from L_g s with K_g a give Y and Y'. The energy distance

    E |X - Y| - (E |X - X'| + E |Y - Y'|) / 2

is 0 if and only if both have one distribution (eq. 5 and 6), for noise of any kind. A random prey or a noisy sensor is
thus no false alarm, and no task has to turn its own noise along.

Two cases need no statistics. A field without chance is judged state by state: one that differs by more than rounding is
a proof. And where a run from the images that meets the chance of X gives X itself, both have one distribution, too.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from esp_cli.checking.candidates import is_declared
from esp_cli.checking.shifting import Shift
from esp_cli.checking.stepping import nudged, outcomes, stretched, visit
from esp_cli.checking.verdicts import (
    NEGLIGIBLE,
    RANK,
    SIGNIFICANT,
    ElementVerdict,
    FieldVerdict,
    Late,
    Watch,
    chance,
    concluded,
    verdicts_of,
)
from esp_cli.symmetry import Element, Transform, build_transform
from esp_envs.base import Observation, Step
from esp_envs.promises import MakeWorlds
from esp_envs.spec import Layout, TaskSpec

_MOST_WORLDS = 256
_NUMBERS = 1 << 18  # that all worlds together may show their agents at once; with pictures they are fewer
TOLERATED = 0.15  # standard deviations that a field with chance may be off, where it is not found broken
_BOUND = 0.05  # where the bounded distance levels off, in standard deviations of the field
_ROUNDINGS, _UNCLEAR = 10.0, 0.05
"""How often what rounding does may be exceeded without being a mismatch, and the share of the states that differ by no
more than that, from which nothing is said."""
_SOME = 8  # of more elements than these, each is first tried in one of so many states
_FEW = 0.05
"""Share of the states further out that may differ: in some that play never reaches, contacts are solved in the order
in which a simulator numbers them."""
_FURTHER = "holds where play went, but further out {} would differ"
_HERE, _THERE = (101, 102), (103, 104)  # seeds of two runs from the states, two from images, with own chance
Outcomes = dict[str, Tensor]  # what a step gives, by field: [M, numbers]


def check_paired(
    make: MakeWorlds,
    elements: Sequence[Element | Shift],
    most: int | None = None,
    watch: Watch = lambda *_: None,
    until: float = math.inf,
    spare: float = math.inf,
) -> list[ElementVerdict]:
    """Judge elements on a task that can be set to a state, with outcomes of at most `most` worlds.

    Of many elements, each is first tried in an eighth of the states: what is broken there is broken. What holds in all
    states that were visited is tried further out, too, where random play does not go: an element that is broken there
    is not covered. `until` and `spare` as in `verdicts_of`.
    """
    shown = make(1, [0]).spec
    worlds = max(64, min(most or _MOST_WORLDS, _NUMBERS // (shown.num_agents * shown.observation.width)))
    visited = visit(make(worlds, [0]), watch, (until + time.monotonic()) / 2, early=most is not None)
    if most is None:  # one step of many worlds takes less time than many steps
        states, actions = (torch.cat(part, 1) for part in zip(*visited, strict=True))
        visited = [(states, actions)]
    some = [(state[:, ::_SOME], action[:, ::_SOME]) for state, action in visited]
    everywhere, few = (cache(lambda states=states: _Pairs(make, states, until)) for states in (visited, some))

    @cache
    def further() -> _Pairs | None:
        try:
            return _Pairs(make, [(stretched(state, shown.state), action) for state, action in some], until)
        except Late:
            raise
        except (Exception, SystemExit):  # such states, or what was done elsewhere, are not for this task
            return None

    def judge(element: Element | Shift) -> ElementVerdict:
        if len(elements) > _SOME and (found := few().judge(element)).outcome == "broken":
            return found
        found = everywhere().judge(element)
        pairs = further() if found.outcome == "holds" else None
        if pairs is not None and (beyond := pairs.judge(element)).outcome == "broken":
            broken = (f for f in beyond.fields if f.outcome == "broken" and not f.share <= _FEW)  # a share may be NaN
            fields = tuple(replace(f, outcome="not covered") for f in broken)
            if not fields:
                return found
            return replace(found, fields=fields, reason=_FURTHER.format(", ".join(field.field for field in fields)))
        return found

    return verdicts_of(elements, judge, lambda element: is_declared(element, shown), watch, until, spare)


class _Pairs:
    """Steps from visited states [1, E, state width], compared with steps from their images; after `until`, `Late`."""

    def __init__(self, make: MakeWorlds, visited: Sequence[tuple[Tensor, Tensor]], until: float) -> None:
        self._visited, self._until, worlds = visited, until, visited[0][0].shape[1]
        self._twins = [make(worlds, [seed]) for seed in _HERE]
        for env in self._twins:
            env.renews = False
        self._spec = self._twins[0].spec
        self._here = [outcomes(env, visited, None, seed, until) for env, seed in zip(self._twins, _HERE, strict=True)]
        near = [(nudged(state), action) for state, action in visited]
        self._here.append(outcomes(self._twins[0], near, None, _HERE[0], until))

    def judge(self, element: Element | Shift) -> ElementVerdict:
        """Compare the steps from the images with the images of the steps."""
        declared = is_declared(element, self._spec)
        transform = element if isinstance(element, Shift) else build_transform([element], self._spec)

        def there(twin: int, seed: int) -> Outcomes:
            steps = outcomes(self._twins[twin], self._visited, transform, seed, self._until)
            return _fields(steps, self._spec, None)

        @cache
        def apart() -> list[Outcomes]:
            return [there(twin, seed) for twin, seed in enumerate(_THERE)]

        first, second, near = (_fields(steps, self._spec, transform) for steps in self._here)
        try:
            alike = there(0, _HERE[0])
            verdicts = [
                _verdict(name, first[name], second[name], alike[name], near[name])
                or _beside_what_is_seen(name, (first, second, *apart()), near)
                or _by_distances(name, first[name], second[name], *(side[name] for side in apart()))
                for name in first
            ]
        except Late:
            raise
        except (Exception, SystemExit) as error:
            reason = f"the task raises in the transformed states: {type(error).__name__}: {error}"
            return ElementVerdict(element.name, declared, (), reason)
        return ElementVerdict(element.name, declared, tuple(_merged(verdicts)))


def _verdict(name: str, x: Tensor, x2: Tensor, y: Tensor, near: Tensor) -> FieldVerdict | None:
    """Judge one field from its outcomes [M, numbers] state by state, where that tells; else return None.

    `x` are transformed outcomes, `x2` the same with other chance, `y` outcomes from the transformed states with the
    chance of `x`, `near` transformed ones from states that differ by about a rounding, with the chance of `x` too.
    """
    own, *others, image = (side.isfinite().all(1) for side in (x, x2, near, y))
    if share := float((torch.stack(others) == own).all(0).logical_and(image != own).float().mean()):
        return FieldVerdict(name, "broken", share, 0.0, share=share)  # numbers on one side alone
    (x, x2, y), known = _known(x, x2, y)
    if not len(x):
        return FieldVerdict(name, "not covered", float("nan"), float("nan"))
    scale = _scale(x, y)
    if name == "reward" and not bool(torch.cat([x, y]).any()):  # it never came
        return FieldVerdict(name, "not covered", 0.0, 0.0)
    rounding = (x - near[known]).abs().amax(1).nan_to_num()
    found = _state_by_state(name, (x - y).abs().amax(1), _ROUNDINGS * rounding, scale)
    is_certain = float((x - x2).abs().max()) <= NEGLIGIBLE * scale
    return found if is_certain or found.outcome == "holds" else None


def _beside_what_is_seen(name: str, sides: Sequence[Outcomes], near: Outcomes) -> FieldVerdict | None:
    """Find a field with chance broken by how often runs agree in it and in all that is seen before the step.

    Episodes may draw a goal that no state holds and that agents see. Then rewards may be alike by themselves, and yet
    not beside the goal. Distances of continuous chance never agree, and of these this says nothing.
    """
    names = dict.fromkeys([*(one for one in near if one.startswith("start obs.")), name])
    rows, _ = _known(*(torch.cat([side[one] for one in names], 1) for side in (*sides, near)))
    tolerance = NEGLIGIBLE * rows[0].std(0).clamp_min(1e-6)
    is_clear = (_ROUNDINGS * (rows[0] - rows[-1]).abs() <= tolerance).all(1)
    x, x2, y, y2 = (side[is_clear] for side in rows[:4])
    within, across = ((x - x2, y - y2), (x - y, x2 - y2, x - y2, x2 - y))
    samples = _excess(lambda gap: (gap.abs() > tolerance).any(1, keepdim=True).double(), within, across)
    share, error = float(samples.mean()), float(samples.std()) / max(1, len(samples)) ** 0.5
    return FieldVerdict(name, "broken", share, error, share=share) if share > max(SIGNIFICANT * error, _FEW) else None


def _by_distances(name: str, x: Tensor, x2: Tensor, y: Tensor, y2: Tensor) -> FieldVerdict:
    """Judge one field with chance from four runs [M, numbers]: x and x2 transformed, y and y2 from images."""
    (x, x2, y, y2), _ = _known(x, x2, y, y2)
    if not len(x):
        return FieldVerdict(name, "not covered", float("nan"), float("nan"))
    scale = _scale(x, y)
    within, across = ((x - x2, y - y2), (x - y, x2 - y2, x - y2, x2 - y))
    # The second distance is bounded, so that rare large chance (a touch, a capture) hides no small constant fault.
    bound = _BOUND * scale
    distances = (Tensor.abs, lambda gap: bound * -torch.expm1(-gap.abs() / bound))
    tests = [_excess(distance, within, across) for distance in distances]
    tests.append((x + x2 - y - y2) / 2)
    samples = torch.cat(tests, 1).double() / scale
    gaps, errors = samples.mean(0).abs(), samples.std(0) / len(samples) ** 0.5
    broken = (gaps > SIGNIFICANT * errors) & (gaps > NEGLIGIBLE)
    worst = int(torch.where(broken, gaps, gaps * (not broken.any())).argmax())
    gap, error = float(gaps[worst]), float(errors[worst])
    return concluded(name, gap, error, bool(broken.any()), chance(gap, TOLERATED, error))


def _known(*sides: Tensor) -> tuple[list[Tensor], Tensor]:
    """Return the rows that are finite on all sides, and which these are."""
    known = torch.isfinite(torch.stack(sides)).all(-1).all(0)
    return [side[known] for side in sides], known


def _scale(x: Tensor, y: Tensor) -> float:
    return max(float(torch.cat([x, y]).std(0).max()), 1e-6)


def _state_by_state(name: str, apart: Tensor, rounding: Tensor, scale: float) -> FieldVerdict:
    """Judge a field without chance by how far apart the two sides are in each state, [M], and rounding could be."""
    unlike = apart > NEGLIGIBLE * scale
    differ = unlike & (apart > rounding)
    share, unclear = float(differ.float().mean()), float((unlike & ~differ).float().mean())
    gap = float((apart * differ).mean()) / scale
    return concluded(name, gap, 0.0, bool(differ.any()), float(unclear > _UNCLEAR), share)


def _excess(distance: Callable[[Tensor], Tensor], within: Sequence[Tensor], across: Sequence[Tensor]) -> Tensor:
    """Return by how much outcomes of the two sides lie further apart than those of one side [M, 1]."""
    apart = torch.stack([distance(gap) for gap in across]).mean(0)
    own = torch.stack([distance(gap) for gap in within]).mean(0)
    return (apart - own).mean(1, keepdim=True)


def _merged(verdicts: Sequence[FieldVerdict]) -> list[FieldVerdict]:
    """Keep one verdict for each field: the start's and the reached observation are of one field."""
    best: dict[str, FieldVerdict] = {}
    for verdict in verdicts:
        name = verdict.field.removeprefix("start ")
        renamed = replace(verdict, field=name)
        known = best.get(name)
        if known is None or (RANK[renamed.outcome], renamed.gap) > (RANK[known.outcome], known.gap):
            best[name] = renamed
    return list(best.values())


def _fields(steps: Sequence[Step], spec: TaskSpec, transform: Transform | Shift | None) -> Outcomes:
    """Return everything that the steps gave by field, transformed."""
    parts: dict[str, list[Tensor]] = {}

    def add(prefix: str, layout: Layout, rows: Tensor) -> None:
        for name, where in layout.slices().items():
            parts.setdefault(prefix + name, []).append(rows[..., where].flatten(0, 1).flatten(1))

    for step in steps:
        for prefix, seen in (("start ", step.next), ("", step.final)):
            assert isinstance(seen, Observation)
            if prefix and not bool(seen.obs.isfinite().any()):
                continue  # a simulator of others does not say what is seen before a step
            add(f"{prefix}obs.", spec.observation, seen.obs if transform is None else transform.obs(seen.obs))
            if not spec.is_joint:
                add(f"{prefix}state.", spec.state, seen.state if transform is None else transform.state(seen.state))
            if seen.action_mask is not None:
                mask = seen.action_mask if transform is None else transform.push_outputs(seen.action_mask)
                parts.setdefault(f"{prefix}action mask", []).append(mask.float().flatten(0, 1).flatten(1))
            if seen.alive is not None:
                alive = seen.alive if transform is None else transform.per_agent(seen.alive)
                parts.setdefault(f"{prefix}alive", []).append(alive.float().flatten(0, 1))
        reward = step.reward if transform is None else transform.per_agent(step.reward)
        parts.setdefault("reward", []).append(reward.flatten(0, 1))
        parts.setdefault("end", []).append(step.terminated.float().flatten(0, 1).unsqueeze(-1))
    return {name: torch.cat(rows) for name, rows in parts.items()}
