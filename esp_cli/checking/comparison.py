"""Compare a step from a state with the step from the transformed state, as distributions.

From each state s and joint action a, runs with chance of their own give outcomes X and X', transformed by g; as many
from L_g s with K_g a give Y and Y'. The energy distance

    E |X - Y| - (E |X - X'| + E |Y - Y'|) / 2

is 0 if and only if both have one distribution (eq. 5 and 6), for noise of any kind. A random prey or a noisy sensor is
thus no false alarm, and no task has to turn its own noise along. It is small, though, where only means or spreads
differ: twice the deviation gives 0.06 deviations. So means are compared by themselves, spreads by Gini's mean
difference, E |X - X'| = 2 sigma / sqrt(pi) of normal chance, and skewness by how far the mean of three lies from
their median.

Two cases need no statistics. A field without chance is judged state by state: one that differs by more than rounding is
a proof. And where a run from the images that meets the chance of X gives X itself, both have one distribution, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import combinations, product

import torch
from torch import Tensor

from esp_cli.checking.shifting import Unmoved
from esp_cli.checking.stepping import is_told
from esp_cli.checking.verdicts import NEGLIGIBLE, RANK, SIGNIFICANT, FieldVerdict, concluded
from esp_cli.symmetry import Transform
from esp_envs.base import Step
from esp_envs.spec import TaskSpec

TOLERATED = 0.15  # standard deviations that a field with chance may be off, where it is not found broken
FEW = 0.05
"""Share of the states further out that may differ: in some that play never reaches, contacts are solved in the order
in which a simulator numbers them."""
_BOUND = 0.05  # where the bounded distance levels off, in standard deviations of the field
_ROUNDINGS, _UNCLEAR = 10.0, 0.05
"""How often what rounding does may be exceeded without being a mismatch, and the share of the states that differ by no
more than that, from which nothing is said."""
_SMALL = 0.01
"""Share of a field's spread below which a number's own spread, or that of its changes, is what counts: else a large
number would hide a small one beside it, and a large world slow steps."""
_OF_GINI = math.pi**0.5 / 2  # standard deviations of normal chance in one of its mean difference
_ULPS = 1e-6  # rounding of a number as a share of it, at least
Distance = Callable[[Tensor], Tensor]  # of differences [M, numbers]
Outcomes = dict[str, Tensor]  # what a step gives, by field: [M, numbers]


def the_same(name: str, first: Outcomes, alike: Outcomes) -> FieldVerdict | None:
    """Find that a field holds from outcomes with the chance of `first` that are equal, number by number."""
    x, y = first[name], alike[name]
    same = len(x) > 0 and torch.equal(x, y) and bool(x.isfinite().all())
    return concluded(name, 0.0, 0.0, False, 0.0, 0.0) if same else None


def state_by_state(
    name: str, first: Outcomes, second: Outcomes, alike: Outcomes, near: Outcomes
) -> FieldVerdict | None:
    """Judge one field from outcomes [M, numbers] state by state, where that tells; else return None.

    `first` are transformed outcomes, `second` the same with other chance, `alike` outcomes from the transformed states
    with the chance of `first`, `near` transformed ones from states that differ by about a rounding, with that chance.
    """
    sides = [outcomes[name] for outcomes in (first, second, alike, near)]
    own, again, image, close = (side.isfinite().all(1) for side in sides)
    if (share := float(((again == own) & (close == own) & (image != own)).float().mean())) > 0:
        return FieldVerdict(name, "broken", share, 0.0, share=share)  # numbers on one side alone
    known = own & again & image
    x, x2, y, close = (side[known] for side in sides)
    if not len(x):
        return FieldVerdict(name, "not covered", float("nan"), float("nan"))
    units, scale = _units(x, y, _before(name, first, known))
    rounding = torch.maximum((x - close).abs().amax(1).nan_to_num(), _ULPS * x.abs().amax(1))
    found = _each_state(name, (x - y).abs(), _ROUNDINGS * rounding, scale, units)
    is_certain = bool(((x - x2).abs() <= NEGLIGIBLE * units).all())
    return found if is_certain or found.outcome == "holds" else None


def beside_what_is_seen(name: str, sides: Sequence[Outcomes], near: Outcomes) -> FieldVerdict | None:
    """Find a field with chance broken by how often runs agree in it and in all that is seen before the step.

    Episodes may draw a goal that no state holds and that agents see. Then rewards may be alike by themselves, and yet
    not beside the goal. Distances of continuous chance never agree, and of these this says nothing.
    """
    names = dict.fromkeys([*(one for one in near if one.startswith("start obs.")), name])
    rows, _ = _known(*(torch.cat([side[one] for one in names], 1) for side in (*sides, near)))
    tolerance = NEGLIGIBLE * rows[0].std(0).clamp_min(1e-6)
    is_clear = (_ROUNDINGS * (rows[0] - rows[-1]).abs() <= tolerance).all(1)
    clear = _halves([side[is_clear] for side in rows[:-1]])
    samples = _excess(lambda gap: (gap.abs() > tolerance).any(-1, keepdim=True).double(), *clear)
    if len(samples) < 2:
        return None
    share, error = float(samples.mean()), float(samples.std()) / len(samples) ** 0.5
    return FieldVerdict(name, "broken", share, error, share=share) if share > max(SIGNIFICANT * error, FEW) else None


def by_distances(
    name: str, sides: Sequence[Outcomes], together: Sequence[str] = (), worlds: Tensor | None = None
) -> FieldVerdict:
    """Judge one field with chance, or some together, from runs: half of them are transformed, half are from images.

    Rows are independent, or else those of each of the `worlds`, [M] numbers from 0, count once.
    """
    fields = together or [name]
    rows, known = _known(*(torch.cat([side[field] for field in fields], 1) for side in sides))
    if not len(rows[0]):
        return FieldVerdict(name, "not covered", float("nan"), float("nan"))
    pairs = ((sides[0][field][known], sides[-1][field][known], _before(field, sides[0], known)) for field in fields)
    each = [_units(*pair)[0] for pair in pairs]
    units, shares = torch.cat(each), torch.cat([torch.full_like(unit, len(unit) ** -0.5) for unit in each])
    here, there = _halves([side / units for side in rows])
    # of all numbers at once, since chance may tie them together
    tests = [_excess(lambda gap: (gap * shares).norm(dim=-1, keepdim=True), here, there)]
    if not together:
        # The second distance is bounded, so that rare large chance (a touch, a capture) hides no small constant fault.
        distances = (Tensor.abs, lambda gap: _BOUND * -torch.expm1(-gap.abs() / _BOUND))
        tests += [_excess(distance, here, there) for distance in distances]
        tests.append(_over(lambda gap: gap, product(here, there)))
        tests.append((_within(Tensor.abs, here) - _within(Tensor.abs, there)) * _OF_GINI)
        tests.append(_lean(here) - _lean(there))
    samples = torch.cat(tests, 1).double()
    if worlds is not None:
        _, worlds, counts = worlds[known].unique(return_inverse=True, return_counts=True)
        sums = samples.new_zeros(len(counts), samples.shape[1]).index_add_(0, worlds, samples)
        samples = sums * len(counts) / counts.sum()
    gaps, errors = samples.mean(0).abs(), samples.std(0) / len(samples) ** 0.5
    tolerated = torch.full_like(gaps, TOLERATED)
    tolerated[: 0 if together else 3] = TOLERATED**2  # the distances grow as the square of a shift
    chances = torch.special.ndtr((gaps - tolerated) / errors.clamp_min(1e-12))
    if worlds is None:
        of_pairs = _covariances(here[0] - here[1], there[0] - there[1])
        gaps, errors = torch.cat([gaps, of_pairs[0]]), torch.cat([errors, of_pairs[1]])
    broken = (gaps > SIGNIFICANT * errors) & (gaps > NEGLIGIBLE)
    worst = int(torch.where(broken, gaps, gaps * (not broken.any()))[: None if broken.any() else len(chances)].argmax())
    gap, error = float(gaps[worst]), float(errors[worst])
    return concluded(name, gap, error, bool(broken.any()), float(chances.max()))


def _covariances(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return by how much covariances differ, and standard errors, from differences of two runs on each side [M, D].

    Variances are left out: rare large chance has large ones.
    """
    count, both = len(x), x * y
    gap = (x.mT @ x - y.mT @ y) / (2 * count)
    square = (x.square().mT @ x.square() - 2 * both.mT @ both + y.square().mT @ y.square()) / (4 * count)
    error = ((square - gap.square()).clamp_min(0) / count).sqrt()
    return gap.fill_diagonal_(0).abs().flatten().double(), error.flatten().double()


def _known(*sides: Tensor) -> tuple[list[Tensor], Tensor]:
    """Return the rows that are finite on all sides, and which these are."""
    known = torch.isfinite(torch.stack(sides)).all(-1).all(0)
    return [side[known] for side in sides], known


def _before(name: str, first: Outcomes, known: Tensor) -> Tensor | None:
    """Return what a field was at the start, in some rows; None where a simulator of others does not say so."""
    before = first.get(f"start {name}", first[name])
    return before[known] if len(before) == len(known) else None


def _units(x: Tensor, y: Tensor, before: Tensor | None) -> tuple[Tensor, float]:
    """Return in which unit each number of a field is compared, and the field's spread: the unit, or a larger one."""
    scale = max(float(torch.cat([x, y]).std(0).max()), 1e-6)
    change = torch.zeros_like(x) if before is None else x - before
    own = torch.where(change.any(0), torch.minimum(x.std(0), change.nan_to_num().std(0)), x.std(0))
    return torch.where(own < _SMALL * scale, own.clamp_min(NEGLIGIBLE * scale), scale).clamp_min(1e-6), scale


def _each_state(name: str, apart: Tensor, rounding: Tensor, scale: float, units: Tensor) -> FieldVerdict:
    """Judge a field without chance by how far apart the two sides are, [M, numbers], and rounding could be, [M]."""
    unlike = (apart > NEGLIGIBLE * scale).any(1)
    differ = ((apart > NEGLIGIBLE * units) & (apart > rounding.unsqueeze(1))).any(1)
    share, unclear = float(differ.float().mean()), float((unlike & ~differ).float().mean())
    # in small units a gap counts up to 1, so that what is told stays one in deviations of the field
    sizes = torch.minimum(apart / units, (apart / scale).clamp_min(1.0))
    gap = float((sizes.amax(1) * differ).mean())
    return concluded(name, gap, 0.0, bool(differ.any()), float(unclear > _UNCLEAR), share)


def _halves(runs: Sequence[Tensor]) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
    return runs[: len(runs) // 2], runs[len(runs) // 2 :]


def _over(distance: Distance, pairs: Iterable[tuple[Tensor, Tensor]]) -> Tensor:
    """Return the mean distance [M, ...] of pairs of runs, of which one difference at a time is in memory."""
    total, count = torch.zeros(()), 0
    for x, y in pairs:
        total, count = total + distance(x - y), count + 1
    return total / count


def _within(distance: Distance, runs: Sequence[Tensor]) -> Tensor:
    return _over(distance, combinations(runs, 2))


def _lean(runs: Sequence[Tensor]) -> Tensor:
    """Return by how much the mean of three runs is above their median, on average [M, D].

    It is expected to be 0 where chance is symmetric about its centre (as its sign in the triples test; Randles et al.,
    1980, JASA 75).
    """
    threes = [torch.stack(three) for three in combinations(runs, 3)]
    return torch.stack([three.mean(0) - three.median(0).values for three in threes]).mean(0)


def _excess(distance: Distance, here: Sequence[Tensor], there: Sequence[Tensor]) -> Tensor:
    """Return by how much outcomes of the two sides lie further apart than those of one side [M, 1]."""
    own = (_within(distance, here) + _within(distance, there)) / 2
    return (_over(distance, product(here, there)) - own).mean(1, keepdim=True)


def merged(verdicts: Sequence[FieldVerdict]) -> list[FieldVerdict]:
    """Keep one verdict for each field: the start's and the reached observation are of one field."""
    best: dict[str, FieldVerdict] = {}
    for verdict in verdicts:
        renamed = replace(verdict, field=verdict.field.removeprefix("start "))
        known = best.setdefault(renamed.field, renamed)
        best[renamed.field] = max(known, renamed, key=lambda v: (RANK[v.outcome], v.gap))
    return list(best.values())


def by_field(step: Step, spec: TaskSpec, transform: Transform | Unmoved) -> Outcomes:
    """Return everything that a step gave by field, transformed; see `stepping.outcomes`."""
    found = Outcomes()

    def add(name: str, rows: Tensor) -> None:
        found[name] = rows.float().flatten(0, 1).flatten(1)

    for prefix, seen in (("start ", step.next), ("", step.reached)):
        if prefix and not is_told(seen):
            continue
        rows = [("obs", spec.observation, transform.obs(seen.obs))]
        rows += [] if spec.is_joint else [("state", spec.state, transform.state(seen.state))]
        for what, layout, row in rows:
            for name, where in layout.slices().items():
                add(f"{prefix}{what}.{name}", row[..., where])
        if seen.action_mask is not None:
            add(f"{prefix}action mask", transform.push_outputs(seen.action_mask))
        if seen.alive is not None:
            add(f"{prefix}alive", transform.per_agent(seen.alive))
    add("reward", transform.per_agent(step.reward))
    add("end", step.terminated.unsqueeze(-1))
    return found
