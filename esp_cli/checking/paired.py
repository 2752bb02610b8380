"""Try elements on a task that can be set to states: where play goes, further out, and in the steps that follow."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, cached_property, partial

import torch
from torch import Tensor

from esp_cli.checking.candidates import is_declared
from esp_cli.checking.comparison import (
    FEW,
    Outcomes,
    beside_what_is_seen,
    by_distances,
    by_field,
    merged,
    state_by_state,
    the_same,
)
from esp_cli.checking.shifting import Shift, Unmoved
from esp_cli.checking.stepping import MOMENTS, nudged, outcomes, played, seek_end, stretched, visit
from esp_cli.checking.verdicts import ENDS, ElementVerdict, FieldVerdict, Watch, may_come, verdicts_of
from esp_cli.symmetry import Element, Transform, build_transform
from esp_envs.promises import MakeWorlds
from esp_envs.spec import TaskSpec

_FEWEST_WORLDS, _MOST_WORLDS = 64, 256
_NUMBERS = 1 << 18  # that all worlds together may show their agents at once; with pictures they are fewer
_SOME, _FOLLOWED = 8, 4
"""Of more elements than `_SOME`, each is first tried in one of so many states; later steps are those of `_FOLLOWED`."""
_BEYOND = "holds where play went, but {} {} would differ"
_TOGETHER = "fields together"
_UNMOVED = "it moves nothing in the states that play visits"
_HIDDEN = "the state leaves out {}, and later steps do not tell what that does"
_LATER, _LATER_OF_SLOW = 128, 32
"""Steps that are followed from an episode's start, for what builds up that no state holds, or until an end is found;
of slow simulators fewer."""
_LONG = 0.25  # share of the states that differ from which rounding is no reason, however many steps it had to grow
_HERE = (101, 102, 105, 107)  # seeds of runs from the states, with chance of their own
_THERE = (103, 104, 106, 108)  # of those from their images
_NEAR = -1  # stands for a run from states nearby, with the chance of the first
Visited = tuple[Tensor, Tensor]  # states [1, E, state width] and joint actions


def check_paired(
    make: MakeWorlds,
    elements: Sequence[Element | Shift],
    slow: bool = False,
    watch: Watch = lambda *_: None,
    until: float = math.inf,
    spare: float = math.inf,
) -> list[ElementVerdict]:
    """Judge elements on a task that can be set to a state; of a `slow` simulator in fewer worlds and steps.

    Of many elements, each is first tried in an eighth of the states: what is broken there is broken. What holds in all
    states that were visited is tried further out, too, where random play does not go: an element that is broken there
    is not covered. And it is tried in the steps that follow, in which clocks run and what no state holds builds up.
    Short episodes are played several times, as chance takes many states. `until` and `spare` as in `verdicts_of`.
    """
    shown = make(1, [0]).spec
    most = _FEWEST_WORLDS if slow else _MOST_WORLDS
    worlds = max(_FEWEST_WORLDS, min(most, _NUMBERS // (shown.num_agents * shown.observation.width)))
    env, rounds = make(worlds, [0]), 1 if slow else max(1, MOMENTS // shown.horizon)
    visited = [one for _ in range(rounds) for one in visit(env, watch, (until + time.monotonic()) / 2, early=slow)]
    judge = _Judge(make, shown, visited, slow, until, len(elements) > _SOME)
    return verdicts_of(elements, judge, lambda element: is_declared(element, shown), watch, until, spare)


class _Judge:
    """Judges elements from visited states, in some of them first where `quick`, then in all, further out and later.

    One step of many worlds takes less time than many steps, unless they are those of a slow simulator.
    """

    def __init__(
        self, make: MakeWorlds, spec: TaskSpec, moments: Sequence[Visited], slow: bool, until: float, quick: bool
    ) -> None:
        self._make, self._spec, self._moments, self._until, self._quick = make, spec, moments, until, quick
        self._later, self._few = (_LATER_OF_SLOW, FEW) if slow else (_LATER, 0.0)
        states, actions = (torch.cat(part, 1) for part in zip(*moments, strict=True))
        self._visited = moments if slow else [(states, actions)]
        self._some = [(state[:, ::_SOME], action[:, ::_SOME]) for state, action in self._visited]
        self._ending = cache(self._sought)

    def __call__(self, element: Element | Shift) -> ElementVerdict:
        if self._quick and (found := self._fewer.judge(element)).outcome == "broken":
            return found
        found = self._everywhere.judge(element)
        unseen = frozenset(f.field for f in found.fields if f.outcome != "holds")
        if found.outcome == "not covered" and unseen & ENDS and unseen <= ENDS | {"action mask"}:
            found = self._as_at_an_end(element, found, unseen & ENDS)
        if found.outcome == "holds" and self._further is not None:
            found = self._as_beyond(found, self._further.judge(element), "further out", self._few)
        return self._as_later(element, found) if found.outcome == "holds" else found

    @cached_property
    def _everywhere(self) -> _Pairs:
        return _Pairs(self._make, self._visited, self._until)

    @cached_property
    def _fewer(self) -> _Pairs:
        return _Pairs(self._make, self._some, self._until)

    @cached_property
    def _further(self) -> _Pairs | None:
        return self._tried(lambda: [(stretched(state, self._spec.state), action) for state, action in self._some])

    def _sought(self, unseen: frozenset[str]) -> _Pairs | None:
        return self._tried(lambda: [seek_end(self._make, self._moments[0][0], self._later, self._until, unseen)])

    @cached_property
    def _onwards(self) -> _Pairs | None:
        steps, start = min(self._later, self._spec.horizon), self._moments[0][0][:, ::_FOLLOWED]
        actions = [action[:, ::_FOLLOWED] for _, action in self._moments]

        def episode() -> Sequence[Visited]:
            if self._spec.masks:  # what is allowed later depends on what was done
                return played(self._make, start, steps, _HERE[0], self._until)
            return [(start, actions[k % len(actions)]) for k in range(steps)]

        return self._tried(episode, onwards=True)

    def _tried(self, moments: Callable[[], Sequence[Visited]], onwards: bool = False) -> _Pairs | None:
        """Return pairs from states, or None where these, or what is done in them, are not for this task."""
        with suppress(Exception, SystemExit):
            return _Pairs(self._make, moments(), self._until, onwards)
        return None

    def _as_at_an_end(self, element: Element | Shift, found: ElementVerdict, unseen: frozenset[str]) -> ElementVerdict:
        """Judge ends that did not come in play, and all that comes with them, as masks, where one was found."""
        if (ending := self._ending(unseen)) is None:
            return found
        near = ending.judge(element)
        held = {f.field: f for f in near.fields if f.outcome == "holds"}
        found = replace(found, fields=tuple(f if f.outcome == "holds" else held.get(f.field, f) for f in found.fields))
        return self._as_beyond(found, near, "at an end", 0.0) if found.outcome == "holds" else found

    def _as_beyond(self, found: ElementVerdict, beyond: ElementVerdict, where: str, few: float) -> ElementVerdict:
        """Say that what holds is not covered where fields are broken in states that play did not reach."""
        broken = (f for f in beyond.fields if f.outcome == "broken" and not f.share <= few)  # a share may be NaN
        fields = tuple(replace(f, outcome="not covered") for f in broken)
        if not fields:
            return found
        return replace(found, fields=fields, reason=_BEYOND.format(where, ", ".join(field.field for field in fields)))

    def _as_later(self, element: Element | Shift, found: ElementVerdict) -> ElementVerdict:
        broken = None if self._onwards is None else self._onwards.broken_later(element)
        if broken is None and self._spec.hidden:
            return replace(found, fields=(), reason=_HIDDEN.format(" and ".join(self._spec.hidden)))
        return replace(found, fields=broken) if broken else found


class _Pairs:
    """Steps from visited states [1, E, state width], compared with steps from their images; after `until`, `Late`.

    With `onwards` the steps are those of episodes that go on from the first states; see `outcomes`.
    """

    def __init__(self, make: MakeWorlds, visited: Sequence[Visited], until: float, onwards: bool = False) -> None:
        self._visited, worlds = visited, visited[0][0].shape[1]
        self._play = partial(outcomes, until=until, onwards=onwards)
        self._twins = [make(worlds, [seed]) for seed in _HERE[:2]]
        for env in self._twins:
            env.renews = False
        self._spec = self._twins[0].spec
        self._here = cache(lambda run: self._play(self._twins[min(run, 1)], visited, Unmoved(), _HERE[run]))
        for run in (0, 1):
            self._here(run)  # now, where an error says that these states cannot be played
        near = [(nudged(state), action) for state, action in visited]
        self._near = self._play(self._twins[0], near, Unmoved(), _HERE[0])

    def judge(self, element: Element | Shift) -> ElementVerdict:
        """Compare the steps from the images with the images of the steps."""
        declared, transform = is_declared(element, self._spec), self._transform(element)
        image = cache(partial(self._image, transform))

        runs = cache(partial(self._runs, transform))
        first = image(0)
        try:
            alike = self._there(transform, 0, _HERE[0])
            verdicts = [
                self._unseen(name, first, alike)
                or the_same(name, first, alike)
                or state_by_state(name, first, image(1), alike, image(_NEAR))
                or beside_what_is_seen(name, runs(), image(_NEAR))
                or by_distances(name, runs())
                for name in first
            ]
            if all(v.outcome == "holds" for v in verdicts) and any(math.isnan(v.share) for v in verdicts):
                drawn = [name for name in first if not torch.equal(first[name], image(1)[name])]
                verdicts.append(by_distances(_TOGETHER, runs(), drawn))
        except (Exception, SystemExit) as error:
            reason = f"the task raises in the transformed states: {type(error).__name__}: {error}"
            return ElementVerdict(element.name, declared, (), reason)
        found = ElementVerdict(element.name, declared, tuple(merged(verdicts)))
        if found.outcome == "holds" and not self._moves(transform):
            return replace(found, fields=(), reason=_UNMOVED)
        return found

    def _moves(self, transform: Transform | Unmoved) -> bool:
        """Return whether any visited state or action has another image than itself."""
        return any(
            not (torch.equal(transform.state(state), state) and torch.equal(transform.action(action), action))
            for state, action in self._visited
        )

    def broken_later(self, element: Element | Shift) -> tuple[FieldVerdict, ...] | None:
        """Return fields that are broken in so many states that rounding, which grows, is no reason.

        None where chance or rounding decides some field, and none is broken, or the task raises.
        """
        transform = self._transform(element)
        first, worlds = self._image(transform, 0), self._visited[0][0].shape[1]
        try:
            alike = self._there(transform, 0, _HERE[0])
        except (Exception, SystemExit):
            return None
        unlike = [name for name in first if not the_same(name, first, alike)]
        if not unlike:
            return ()
        second, near = self._image(transform, 1), self._image(transform, _NEAR)
        sides = (first, second, alike, near)
        goes = _until_an_end(sides, worlds)
        # in either half of the worlds: an event that rounding tips in one of them is no breaking
        soon = goes.clone()
        soon[worlds * _LATER_OF_SLOW :] = False
        halves = [_kept(sides, soon & (torch.arange(len(goes), device=goes.device) % 2 == k)) for k in (0, 1)]
        whole = _kept(sides, goes)
        names = [name for name in whole[0] if name in unlike]
        verdicts = {name: [state_by_state(name, *half) for half in halves] for name in names}
        verdicts |= {f"{name} later": [state_by_state(name, *whole)] for name in names}
        if drawn := [name for name in names if None in verdicts[name]]:
            verdicts |= self._drawn_later(drawn, transform)
        least = 0.5 / min(len(self._visited), _LATER_OF_SLOW)
        broken = [
            told[0]
            for name, told in verdicts.items()
            if all(v and v.outcome == "broken" and not v.share <= (least if name in first else _LONG) for v in told)
        ]
        holds = all(v and v.outcome == "holds" for name in names for v in verdicts[name])
        return tuple(merged([v for v in broken if v])) if broken or holds else None

    def _drawn_later(
        self, names: Sequence[str], transform: Transform | Unmoved
    ) -> dict[str, list[FieldVerdict | None]]:
        """Judge fields that chance decides in all steps, of which those of a world count once."""
        try:
            sides = self._runs(transform)
        except (Exception, SystemExit):
            return {}
        worlds = self._visited[0][0].shape[1]
        goes = _until_an_end(sides, worlds)
        rows, world = _kept(sides, goes), torch.arange(len(goes), device=goes.device)[goes] % worlds
        return {name: [by_distances(name, rows, worlds=world)] for name in names}

    def _transform(self, element: Element | Shift) -> Transform | Unmoved:
        return element if isinstance(element, Shift) else build_transform([element], self._spec)

    def _image(self, transform: Transform | Unmoved, run: int) -> Outcomes:
        """Return transformed outcomes of one of the runs from the states, or from states nearby."""
        return by_field(self._near if run == _NEAR else self._here(run), self._spec, transform)

    def _runs(self, transform: Transform | Unmoved) -> list[Outcomes]:
        """Return transformed outcomes of all runs from the states, and outcomes of as many from the images."""
        images = [self._image(transform, run) for run in range(len(_HERE))]
        return [*images, *(self._there(transform, min(run, 1), seed) for run, seed in enumerate(_THERE))]

    def _there(self, transform: Transform | Unmoved, twin: int, seed: int) -> Outcomes:
        """Return outcomes of the images."""
        return by_field(self._play(self._twins[twin], self._visited, transform, seed), self._spec, Unmoved())

    def _unseen(self, name: str, first: Outcomes, alike: Outcomes) -> FieldVerdict | None:
        """Say that ends, masks or rewards which never came or never changed could not have shown a breaking."""
        rows = torch.cat([first[name], alike[name]])
        if bool((rows != rows[:1]).any()):
            return None
        ends = bool(first["end"].any()) and not bool(first["end"].all())
        may = may_come(name, ends, pays=bool(rows.any()), forbids=not bool(rows.all()))
        unseen = may and (name != "end" or self._spec.terminates)
        return FieldVerdict(name, "not covered", 0.0, 0.0) if unseen else None


def _until_an_end(sides: Sequence[Outcomes], worlds: int) -> Tensor:
    """Return which rows [steps x worlds] belong to the first episode of a world on all sides."""
    ended = torch.stack([side["end"].any(1) for side in sides]).any(0).view(-1, worlds)
    return (ended.cumsum(0) == ended).flatten()


def _kept(sides: Sequence[Outcomes], rows: Tensor) -> list[Outcomes]:
    """Return some rows of all fields that have as many; some simulators do not say what is seen at the start."""
    return [{name: x[rows] for name, x in side.items() if len(x) == len(rows)} for side in sides]
