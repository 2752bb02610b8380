"""Measure symmetry from transitions alone: no state can be set, and the noise is unknown.

A predictor of change and reward is fitted to each half of the episodes. On the other half it errs by e(x, y), and on
the images of these under an element by e(gx, gy). If starts, policy, dynamics and reward are symmetric, a transition
and its image have one distribution, so any predictor errs on both alike. The gap squared is the difference
(e(gx, gy) - e(x, y)) / variance; of an exact predictor it is the mean squared difference of a step from the image and
the step's image. Squares of what changes, and products of neighbours in a field, are predicted too, which shows where
noise is not symmetric, and so does how often a number lies above what is expected; of the reward only the mean matters.

A predictor that knows nothing errs alike everywhere. So breakings of the tolerance's size are planted in the same data
(see `controls`): d h(x) is added to a field, for functions h that the element changes. An element holds where each of
them would have raised the gap so far that one as small as what is found has a probability of 5 %, at most.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import cache
from itertools import accumulate, pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from esp_cli.checking.candidates import is_declared
from esp_cli.checking.controls import STILL, Controls, Sides, strength, trust_in
from esp_cli.checking.predictor import Predictor, done
from esp_cli.checking.recorded import Transitions, outputs_of, require_told, turned
from esp_cli.checking.shifting import Shift
from esp_cli.checking.verdicts import SIGNIFICANT, ElementVerdict, FieldVerdict, Watch, concluded, may_come, verdicts_of
from esp_cli.symmetry import Element, Transform, build_transform
from esp_cli.symmetry.elements import AGENTS
from esp_envs.spec import Spaces, TaskSpec

TOLERATED = 0.2  # standard deviations of a field that a step from the image may differ from the step's image
_SEEN = 0.1  # squared share of the tolerance from which a gap beyond chance is a breaking: predictors err
_DOUBTFUL = 4.0  # standard errors from which such a gap is no breaking yet, but leaves an element uncovered
_HIDES, _CARRIES = 0.25, 0.9
"""Shares of the variance of rewards that the rarest hundredth of them has: from the first on it is left out, as it
hides what is usual, from the second on what is left is too little to say that rewards hold."""
_MOST_ROWS = 1 << 15  # steps of agents that are looked at, at most; of more episodes every k-th step
_FEWEST_INSIDE = 0.5  # least share of images that lie where transitions do to show something; these are judged
_TURNED = 1e-5  # by which the image of what never changes differs from it by more than rounding
_BESIDE_OTHERS = "no state holds these items, and each agent's transitions do not show what others see beside them"
_LITTLE, _LEANS = 0.05, 0.06
"""Standard deviations that a number may be off what is expected without being above or below it, and by how much more
often it is above in a transition than in its image where chance is skewed."""
_PREFERS, _ELSEWHERE = 0.05, 0.5
"""Shifts of starts or first actions, in standard deviations: from the first on, what looks broken may be a preference;
from the second on, of starts, images lie where no transition does."""


def check_transitions(
    spaces: Spaces,
    data: Transitions,
    elements: Sequence[Element],
    watch: Watch = lambda *_: None,
    until: float = math.inf,
    by_itself: bool | None = None,
) -> list[ElementVerdict]:
    """Judge elements from 64 episodes or more of anybody's transitions, of a policy that prefers no direction.

    Each episode counts once. `watch` is told of how many elements of how many are judged; `until` as in `verdicts_of`.
    `by_itself` says whether nobody else acts, by default whether there is one agent.
    """
    data = data.map(_plain)
    data = replace(data, reward=data.reward.float())
    require_told(spaces, data)
    usual = _without_tails(data.reward)
    is_little = usual is not data.reward and bool(usual.var() < (1 - _CARRIES) * data.reward.var())
    data = replace(data, reward=usual)
    stride = -(-len(data.obs) * data.obs.shape[1] * spaces.num_agents // _MOST_ROWS)
    thinned, half = data.map(lambda x: x[:, ::stride]), len(data.obs) // 2
    parts, first = (thinned.episodes(slice(half)), thinned.episodes(slice(half, None))), data.map(lambda x: x[:, :1])

    @cache
    def halves() -> list[_Half]:
        controls = Controls(spaces.observation, thinned)
        return [_Half(spaces, controls, fitted, held) for fitted, held in (parts, parts[::-1])]

    def judge(element: Element) -> ElementVerdict:
        found = _judge(element, spaces, halves(), first, spaces.num_agents == 1 if by_itself is None else by_itself)
        told = (_untold(field) if is_little and field.field == "reward" else field for field in found.fields)
        return replace(found, fields=tuple(told))

    return verdicts_of(elements, judge, lambda element: is_declared(element, spaces), watch, until)


def _plain(x: Tensor) -> Tensor:
    """Return numbers as float32 or int64, and flags as they are, without a graph."""
    x = x.detach()
    return x if x.dtype == torch.bool else x.float() if x.is_floating_point() else x.long()


def _untold(field: FieldVerdict) -> FieldVerdict:
    return replace(field, outcome="not covered", p_value=1.0) if field.outcome == "holds" else field


def is_unheld(element: Element | Shift, spaces: Spaces) -> bool:
    """Return whether an element orders items that no state holds but what agents see."""
    held = {AGENTS} if spaces.joint_fields is not None else {AGENTS, *(field.name for field in spaces.state.fields)}
    return any(name not in held for name, _ in element.orders)


def _judge(
    element: Element, spaces: Spaces, halves: Sequence[_Half], first: Transitions, by_itself: bool
) -> ElementVerdict:
    declared, transform = is_declared(element, spaces), build_transform([element], spaces)
    image = turned(first, transform)
    moved = (_outputs(image) - _outputs(first)).mean(0)
    compared = [half.compared(transform) for half in halves]
    if (share := min(one.inside for one in compared)) < _FEWEST_INSIDE:
        reason = f"{1 - share:.0%} of the images lie outside what was seen"
        return ElementVerdict(element.name, declared, (), reason)
    counts = compared[0].counts & compared[1].counts
    ends = any(half.held.terminated is not None and bool(half.held.terminated.any()) for half in halves)
    pays = any(bool(half.held.reward.any()) for half in halves)
    masks = [half.held.action_mask for half in halves]
    forbids = any(mask is not None and not bool(mask.all()) for mask in masks)
    verdicts = []
    for name in halves[0].fields:
        alone, planted, *others = (
            torch.cat(parts) for parts in zip(*(one.fields[name] for one in compared), strict=True)
        )
        leans = torch.cat([one.leans[name] for one in compared])
        still = all(float(half.spread[half.fields[name]].sum()) < STILL**2 for half in halves)
        # that it never changes is its law where it is seen; that of what never came is unknown
        may = _flags(spaces).get(name, True) and may_come(name, ends, pays, forbids)
        turns = bool((moved[..., halves[0].fields[name]].abs() > _TURNED).any())
        of_nothing = concluded(name, float(turns), 0.0, broken=turns, p_value=float(may))
        verdicts.append(of_nothing if still else _judged(name, alone, planted[:, counts], others, leans))
    found = ElementVerdict(element.name, declared, (*verdicts, *_unrecorded(spaces, halves[0].fields)))
    if found.outcome == "holds" and not by_itself and is_unheld(element, spaces):
        return replace(found, fields=(), reason=_BESIDE_OTHERS)
    powers = (1, 2, 4) if found.outcome == "broken" else (1, 2)  # in a square turns by 45 degrees show in the fourth
    shift = _shift(first.obs, image.obs, powers)
    if shift > (_PREFERS if found.outcome == "broken" else _ELSEWHERE):
        return ElementVerdict(element.name, declared, (), f"the starts differ from their image by {shift:.2f} s.d.")
    preference = _shift(done(first, spaces), done(image, spaces), powers)
    if preference > _PREFERS and found.outcome == "broken":
        reason = f"the first actions differ from their image by {preference:.2f} s.d."
        return ElementVerdict(element.name, declared, (), reason)
    return found


def _flags(spaces: Spaces) -> dict[str, bool]:
    """Return whether a task has masks and ends, by field; spaces alone may say so of masks, and never that none are."""
    if isinstance(spaces, TaskSpec):
        return {"action mask": spaces.masks, "end": spaces.terminates, "alive": spaces.agents_end}
    return {"action mask": True} if spaces.masks else {}


def _unrecorded(spaces: Spaces, recorded: Collection[str]) -> list[FieldVerdict]:
    """Say that masks and ends of a task of which transitions hold nothing are not covered."""
    missing = (name for name, has in _flags(spaces).items() if has and name not in recorded)
    return [FieldVerdict(name, "not covered", 0.0, 0.0) for name in missing]


def _judged(name: str, alone: Tensor, planted: Tensor, others: Sequence[Tensor], leans: Tensor) -> FieldVerdict:
    """Judge one field by how much larger errors are on images, as shares of the variance.

    `alone` [M] are squared errors of what follows, `planted` [M, functions] those with a breaking of the tolerance's
    size, and `others` [M] those of squares and products. `leans` [M, numbers] are of chance, see `_Compared`.
    """
    (gap, error), p_value = _mean(alone), 1.0
    if planted.shape[1] and not _is_beyond(gap, error, _DOUBTFUL):
        expected, errors = _mean(planted - alone.unsqueeze(1))[0], _mean(planted)[1]
        p_value = float(torch.special.ndtr((gap - expected) / errors).max())
    for other, its_error in map(_mean, others if name.startswith("obs.") else ()):
        if other / its_error > gap / error and _is_beyond(other, its_error):
            gap, error = other, its_error
    size, broken = float(gap.clamp_min(0).sqrt()), _is_beyond(gap, error)
    error_of_size = min(float(error) / max(2 * size, 1e-12), float(error) ** 0.5)
    if name.startswith("obs.") and not broken:
        lean, errors = (x.abs() for x in _mean(leans))
        most = int((lean / errors).argmax())
        if lean[most] > max(SIGNIFICANT * float(errors[most]), _LEANS):
            size, error_of_size, broken = float(lean[most]), float(errors[most]), True
    return concluded(name, size, error_of_size, broken, p_value)


class _Half:
    """A predictor of one half of the episodes, and what it errs by on the other, which is `held`."""

    def __init__(self, spaces: Spaces, controls: Controls, fitted: Transitions, held: Transitions) -> None:
        parts = outputs_of(fitted)
        outputs = _outputs(fitted)
        self._width, self._controls, self.held = outputs.shape[-1], controls, held
        self._mean, self._deviation = outputs.mean((0, 1, 2)), outputs.flatten(0, 2).std(0)
        places = spaces.observation.slices().values()
        self._next = [k for where in places for k in (*range(where.start + 1, where.stop), where.start)]
        targets, products = self._true(fitted).tensor_split([2 * self._width], -1)
        self._predict = Predictor(spaces, fitted, targets, torch.cat([controls(fitted), products], -1))
        self._planted = controls(held)
        self._here = self._sides(held, self._planted)
        self._trust = trust_in(self._here.said, self._here.true)
        self._errors = (self._trust * self._here.said - self._here.true).square()
        self.spread = self._here.true.flatten(0, 2).var(0)
        self.fields = {f"obs.{name}": where for name, where in spaces.observation.slices().items()}
        stops = accumulate(part.shape[-1] for part in parts.values())
        self.fields |= {name: slice(*ends) for name, ends in zip([*parts][1:], pairwise(stops), strict=True)}

    @torch.no_grad()
    def compared(self, transform: Transform) -> _Compared:
        """Compare errors on images with those on originals."""
        image = turned(self.held, transform)
        inside = self._predict.covers(image).float().unsqueeze(-1)
        weight = inside / inside.mean().clamp_min(STILL)
        carried = transform.per_agent(self._planted.movedim(-1, 0)).movedim(0, -1)
        there, (size, counts) = self._sides(image, carried), strength(carried, self._controls(image), weight)
        worse = weight * ((self._trust * there.said - there.true).square() - self._errors)
        leans = (weight * (self._lean(there) - self._lean(self._here))).mean((1, 2)).double()
        fields, skewed = {}, {}
        for name, where in self.fields.items():
            main = where.start + int(self._deviation[where].argmax())
            variance = self.spread[where].sum().clamp_min(STILL**2)
            amounts = TOLERATED * (variance / size).sqrt()
            sides = self._here.planted(main, amounts), there.planted(main, amounts)
            trust = trust_in(*sides[0])
            before, after = ((weight * (trust * said - true).square()).mean((1, 2)) for said, true in sides)
            others = (worse[..., where].sum(-1) - worse[..., main]).mean((1, 2)).unsqueeze(-1)
            alone, *of_chance = (
                worse[..., begin:][..., where].sum(-1).mean((1, 2))
                / self.spread[begin:][where].sum().clamp_min(STILL**2)
                for begin in (0, self._width, 2 * self._width)
            )
            parts = alone, (after - before + others) / variance, *of_chance
            fields[name] = tuple(part.double() for part in parts)
            skewed[name] = leans[:, where]
        return _Compared(float(inside.mean()), counts, fields, skewed)

    def _lean(self, side: Sides) -> Tensor:
        """Return 1 or -1 where numbers lie above or below what is expected by more than little, [M, T, N, O]."""
        off = (side.true - self._trust * side.said)[..., : self._width]
        return torch.where(off.abs() > _LITTLE * self.spread[: self._width].sqrt(), off.sign(), 0.0)

    def _sides(self, data: Transitions, functions: Tensor) -> Sides:
        said, others = self._predict(data)
        planted, products = others.tensor_split([functions.shape[-1]], -1)
        mean = torch.cat([self._mean, torch.ones_like(self._mean), products.new_zeros(products.shape[-1])])
        return Sides(torch.cat([said, products], -1) - mean, self._true(data) - mean, planted, functions)

    def _true(self, data: Transitions) -> Tensor:
        """Return what follows for each agent, its squares, and products of neighbours in a field of what is seen.

        Squares and products are of standard deviations from the mean.
        """
        outputs = _outputs(data)
        centred = (outputs - self._mean) / self._deviation.clamp_min(STILL)
        return torch.cat([outputs, centred.square(), centred[..., : len(self._next)] * centred[..., self._next]], -1)


class _Compared(NamedTuple):
    """How errors on images compare with those on originals.

    Of each field, as shares of the variance, there are the excess of squared errors [M], with each control planted
    [M, functions], and of those of squares and of products [M].
    """

    inside: float  # share of the images that lie where transitions do
    counts: Tensor  # which controls the element changes, [functions] bool
    fields: dict[str, tuple[Tensor, ...]]
    leans: dict[str, Tensor]  # how much more often each number of a field lies above than below, [M, numbers]


def _mean(samples: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean of independent samples [M, ...], and its standard error."""
    samples = samples.double()
    return samples.mean(0), (samples.std(0) / len(samples) ** 0.5).clamp_min(1e-12)


def _is_beyond(gap: Tensor | float, error: Tensor | float, errors: float = SIGNIFICANT) -> bool:
    return bool(gap > errors * error) and bool(gap > _SEEN * TOLERATED**2)


def _without_tails(reward: Tensor) -> Tensor:
    """Return rewards with the rarest hundredth clamped where it hides what is usual: no regression follows it."""
    low, high = torch.quantile(reward.flatten()[: 1 << 24], torch.tensor([0.005, 0.995])).tolist()
    clamped = reward.clamp(low, high)
    return clamped if low < high and clamped.var() < (1 - _HIDES) * reward.var() else reward


def _outputs(data: Transitions) -> Tensor:
    """Return all that follows for each agent, [M, T, N, numbers]."""
    return torch.cat([*outputs_of(data).values()], -1)


def _shift(start: Tensor, turned: Tensor, powers: Sequence[int]) -> float:
    """Return the largest shift of moments of starts [M, 1, N, D] in standard deviations that is no chance, else 0."""
    start, turned = start.flatten(1).double(), turned.flatten(1).double()
    spread = torch.cat([start, turned]).std(0).clamp_min(1e-3)
    worst = 0.0
    for power in powers:
        gap = (start / spread) ** power - (turned / spread) ** power
        size, error = gap.mean(0).abs(), gap.std(0) / len(gap) ** 0.5
        worst = max(worst, float(torch.where(size > SIGNIFICANT * error, size, 0.0).max()))
    return worst
