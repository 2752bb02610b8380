"""Compare a step from a state with the step from the transformed state, as distributions.

From each state s and joint action a, two runs with chance of their own give outcomes X and X', transformed by g; two
runs from L_g s with K_g a give Y and Y'. The energy distance

    E |X - Y| - (E |X - X'| + E |Y - Y'|) / 2

is 0 if and only if both have one distribution (eq. 5 and 6), for noise of any kind. A random prey or a noisy sensor is
thus no false alarm, and no task has to turn its own noise along. A field without chance is judged state by state: one
that differs by more than rounding is a proof.
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
    stop_at,
    verdicts_of,
)
from esp_cli.symmetry import Element, Transform, build_transform
from esp_envs.base import Environment, Observation, Step
from esp_envs.promises import MakeWorlds
from esp_envs.spec import Layout, TaskSpec

_MOST_WORLDS = 256
_NUMBERS = 1 << 18
"""Numbers that all worlds together may show their agents at once; pictures are compared in fewer worlds."""
MOMENTS = 8
"""Points of an episode at which states are taken."""
TOLERATED = 0.15
"""Standard deviations that a field with chance may be off, where it is not found broken."""
_BOUND = 0.05
"""Where the bounded distance levels off, in standard deviations of the field."""
_NUDGE, _ROUNDINGS, _UNCLEAR = 1e-6, 10.0, 0.05
"""How far a state is moved to see what rounding does, how often that may be exceeded without being a mismatch, and the
share of the states that differ by no more than that, from which nothing is said."""
_SOME = 8
"""Of more elements than these, each is first tried in one of so many states."""
_FEW = 0.05
"""Share of the states further out that may differ: in some that play never reaches, contacts are solved in the order
in which a simulator numbers them."""
_FURTHER = "holds where play went, but further out {} would differ"
Outcomes = dict[str, Tensor]
"""What a step gives, by field: [M, numbers]."""


def check_paired(
    make: MakeWorlds,
    elements: Sequence[Element | Shift],
    most: int | None = None,
    watch: Watch = lambda *_: None,
    until: float = math.inf,
) -> list[ElementVerdict]:
    """Judge elements on a task that can be set to a state.

    Of many elements, each is first tried in an eighth of the states: what is broken there is broken. What holds in all
    states that were visited is tried further out, too, where random play does not go: an element that is broken there
    is not covered.

    Args:
        make: makes E worlds for some seeds.
        elements: to try.
        most: worlds in which outcomes are compared, at most.
        watch: told of how many steps of how many are taken to visit states, then of how many elements are judged.
        until: when to stop, see `verdicts_of`.
    """
    shown = make(1, [0]).spec
    worlds = max(64, min(most or _MOST_WORLDS, _NUMBERS // (shown.num_agents * shown.observation.width)))
    visited = _visit(make(worlds, [0]), watch, (until + time.monotonic()) / 2)
    if most is None:  # one step of many worlds takes less time than many steps
        states, actions = (torch.cat(part, 1) for part in zip(*visited, strict=True))
        visited = [(states, actions)]
    some = [(state[:, ::_SOME], action[:, ::_SOME]) for state, action in visited]
    everywhere, few = (cache(lambda states=states: _Pairs(make, states, until)) for states in (visited, some))

    @cache
    def further() -> _Pairs | None:
        try:
            return _Pairs(make, [(_stretched(state, shown.state), action) for state, action in some], until)
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

    return verdicts_of(elements, judge, lambda element: is_declared(element, shown), watch, until)


class _Pairs:
    """Steps from some states, to be compared with steps from their images.

    Args:
        make: makes E worlds for some seeds.
        visited: states [1, E, state width] and joint actions, for each moment.
        until: when to stop.

    Raises:
        Late: it is later than that, here or in `judge`.
    """

    def __init__(self, make: MakeWorlds, visited: Sequence[tuple[Tensor, Tensor]], until: float) -> None:
        self._visited, self._until, worlds = visited, until, visited[0][0].shape[1]
        self._twins = [make(worlds, [seed]) for seed in (101, 102)]
        for env in self._twins:
            env.renews = False
        self._spec = spec = self._twins[0].spec
        self._here = [_outcomes(env, visited, None, until) for env in self._twins]
        one, other = (_fields(steps, spec, None) for steps in self._here)
        if all(torch.equal(one[name].nan_to_num(), other[name].nan_to_num()) for name in one):
            self._twins = self._twins[:1]  # nothing is left to chance, so one run from each image will do
            near = [(_nudged(state), action) for state, action in visited]
            self._here.append(_outcomes(self._twins[0], near, None, until))

    def judge(self, element: Element | Shift) -> ElementVerdict:
        """Compare the steps from the images with the images of the steps."""
        declared = is_declared(element, self._spec)
        transform = element if isinstance(element, Shift) else build_transform([element], self._spec)
        try:
            there = [_outcomes(env, self._visited, transform, self._until) for env in self._twins]
        except Late:
            raise
        except (Exception, SystemExit) as error:
            reason = f"the task raises in the transformed states: {type(error).__name__}: {error}"
            return ElementVerdict(element.name, declared, (), reason)
        first, second, *nudged = (_fields(steps, self._spec, transform) for steps in self._here)
        third, fourth = _fields(there[0], self._spec, None), _fields(there[-1], self._spec, None)
        verdicts = [
            _verdict(name, first[name], second[name], third[name], fourth[name], *(near[name] for near in nudged))
            for name in first
        ]
        return ElementVerdict(element.name, declared, tuple(_merged(verdicts)))


def _visit(env: Environment, watch: Watch, until: float) -> list[tuple[Tensor, Tensor]]:
    """Return states and joint actions along episodes, half of the worlds random, half by the heuristic if any.

    After `until` no more steps are taken.
    """
    observation = env.reset()
    taken = {round(k * (env.spec.horizon - 1) / MOMENTS) for k in range(MOMENTS)}
    visited: list[tuple[Tensor, Tensor]] = []
    for t in range(max(taken) + 1):
        if visited and time.monotonic() > until:
            break
        action = env.random_action()
        if t in taken:
            visited.append((observation.state.clone(), action))
        observation = env.step(env.half_by_heuristic(action)).next
        watch(t + 1, max(taken) + 1, "steps")
    return visited


def _outcomes(
    env: Environment, visited: Sequence[tuple[Tensor, Tensor]], turned: Transform | Shift | None, until: float
) -> list[Step]:
    """Return the steps from each moment's states; the start's observation replaces `next` of the episode's end."""
    steps = []
    for state, action in visited:
        stop_at(until)
        env.reset()  # draws chance of its own
        start = env.set_state(state if turned is None else turned.state(state))
        step = env.step(action if turned is None else turned.action(action))
        steps.append(replace(step, next=start, final=step.reached, metrics={}))
    return steps


def _stretched(state: Tensor, layout: Layout) -> Tensor:
    """Return states [1, E, state width] whose vectors are up to ten times as long, the same factor for all of one."""
    factor = 10 ** torch.rand(state.shape[1], 1, generator=torch.Generator().manual_seed(0)).to(state.device)
    out = state.clone()
    for field, where in zip(layout.fields, layout.slices().values(), strict=True):
        if field.kind.is_vector and not bool((state[..., where] == state[..., where].round()).all()):  # no cells
            out[..., where] *= factor
    return out


def _nudged(state: Tensor) -> Tensor:
    """Return states that differ by about what rounding leaves; whole numbers, as of cells, stay."""
    noise = torch.randn(state.shape, generator=torch.Generator().manual_seed(0)).to(state.device)
    return torch.where(state == state.round(), state, state + _NUDGE * (1 + state.abs()) * noise)


def _verdict(name: str, x: Tensor, x2: Tensor, y: Tensor, y2: Tensor, near: Tensor | None = None) -> FieldVerdict:
    """Judge one field from its outcomes [M, numbers]: x and x2 transformed, y and y2 from the transformed state.

    Where nothing is left to chance, `near` are transformed outcomes from states that differ by about a rounding.
    """
    known = torch.isfinite(torch.stack([x, x2, y, y2])).all(-1).all(0)
    rounding = torch.zeros(len(x)) if near is None else (x - near).abs().amax(1).cpu().nan_to_num()
    x, x2, y, y2, rounding = (part[known] for part in (x, x2, y, y2, rounding.to(x.device)))
    if not bool(known.any()):
        return FieldVerdict(name, "not covered", float("nan"), float("nan"))
    scale = max(float(torch.cat([x, y]).std(0).max()), 1e-6)
    if name == "reward" and not bool(torch.cat([x, y]).any()):  # it never came
        return FieldVerdict(name, "not covered", 0.0, 0.0)
    if max(float((x - x2).abs().max()), float((y - y2).abs().max())) <= NEGLIGIBLE * scale:
        return _state_by_state(name, (x - y).abs().amax(1), _ROUNDINGS * rounding, scale)
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
