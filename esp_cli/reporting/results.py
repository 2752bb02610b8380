"""The results of a study or of runs as one typed document: every seed's numbers, what was run, and their statistics.

All statistics are computed from the numbers by `summarised`, so a small file without them gives the tables again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, JsonValue

from esp_cli.defaults import Mode
from esp_cli.files.documents import DocumentFormat
from esp_cli.policies.statistics import (
    CONFIDENCE,
    Estimate,
    Floats,
    Passing,
    SeedSummary,
    difference,
    holm,
    interquartile_mean,
    leader,
    normalised,
    probability_of_improvement,
    rank_sum_p,
    summarise,
)
from esp_cli.studies.kinds import kind_of
from esp_cli.studies.paper import NUM_SEEDS
from esp_envs.base import BLIND

RESULTS_FORMAT = DocumentFormat("esp-results", 1, "the results of a study")
Numbers = tuple[float | None, ...]  # one number per seed; None where the seed stopped
Side = Literal["ahead", "behind", "level", "blind"]  # blind: both are below the policy that sees nothing
MIN_SEEDS_TO_RANK = 3  # of either side; a probability of improvement of fewer seeds says nothing


@dataclass(frozen=True)
class Gap:
    """A run beside its reference."""

    difference: Estimate  # of the means
    paired: bool  # whether both have the same seeds, which are compared one by one
    # of improvement over the reference, seed by seed if `paired`; None for fewer than three seeds
    probability: Estimate | None
    over_all_pairs: Estimate | None  # the same with every seed against every seed, as Agarwal et al. define it
    # by whether the interval of the difference holds 0, or by `holm`; None for fewer than three seeds, or no interval
    ahead: Side | None
    holm: float | None = None  # in a benchmark, p of the rank-sum test, corrected for the comparisons of the panel


@dataclass(frozen=True)
class CellSummary:
    """Statistics of one cell; None where its seeds do not allow one."""

    returns: SeedSummary  # over seeds
    iqm: Estimate | None = None  # interquartile mean
    normalised: SeedSummary | None = None  # 0 is the random policy, 1 the best of the task's heuristics
    area: SeedSummary | None = None  # mean height of the learning curve
    normalised_area: SeedSummary | None = None  # the same, normalised, in a benchmark
    gap: Gap | None = None  # to the cell's reference
    # "first" where our mean is higher than the paper's, "second" where the paper's is
    leader: Literal["first", "second", "neither"] | None = None


class CellResult(BaseModel):
    """What came out of one run of a study; fields at their default are left out of the document."""

    model_config = ConfigDict(frozen=True)

    name: str  # of the cell, as are panel and variant
    panel: str
    variant: str
    reference: str | None  # name of the cell that it is compared with; None for such a cell itself
    # mean and standard error of the paper; the latter is None where it was read off a figure
    paper: tuple[float, float | None] | None
    # "unfinished" also says that a run put together by hand did not reach the step in question
    status: Literal["finished", "unfinished", "not run"]
    step: int  # environment steps per seed at which the run stands
    at: int | None = None  # step at which runs put together by hand are compared; None for the final evaluation
    steps: int  # that the run is to take
    seeds: tuple[int, ...]  # of the run
    config: dict[str, JsonValue]  # settings by dotted name, those that not all cells share
    seconds: float | None = None  # of training
    esp_version: str | None = None  # of the program that evaluated
    task_version: int | None = None
    convention: str | None = None
    episodes: int | None = None  # per seed, where they are not those of all cells
    returns: dict[Mode, Numbers] = {}  # by mode, of the final evaluation, or of the evaluation at `at`
    anchors: dict[str, float] = {}  # mean returns of the reference policies
    roles: tuple[str, ...] = ()  # of the agents, where they have some: a mean over unlike roles has no scale
    metrics: dict[str, float | None] = {}  # the task's measures of the greedy policy
    evaluations: int | None = None  # on the way
    # returns by seed at the evaluation nearest to a fifth of the run, in a study of broken symmetry or a benchmark
    early: Numbers | None = None
    area_under_curve: Numbers | None = None  # mean height of the learning curve, by seed
    steps_to: tuple[Passing, ...] = ()  # first steps at thresholds
    parameters: dict[str, int] = {}  # weights by network, of one seed
    flops_per_action: float | None = None  # of the policy
    # statistics of these numbers; None before `summarised`, or where there are no returns yet
    summary: CellSummary | None = None

    @property
    def has_stopped(self) -> bool:
        """Whether a seed has no return at the end."""
        return any(None in values for values in self.returns.values())


class Results(BaseModel):
    """The results of a study, finished or not."""

    model_config = ConfigDict(frozen=True)

    kind: str  # of the study, as are title, command, rows and episodes
    title: str
    command: str
    esp_version: str  # of the program that planned the study
    mode: Mode  # which evaluations tables state
    rows: Literal["panels", "variants"]
    episodes: int
    config: dict[str, JsonValue]  # settings by dotted name that all cells share
    cells: tuple[CellResult, ...] = Field(min_length=1)  # in the study's order
    left_out: dict[str, str] = {}  # by "TASK: METHOD" why there is no such cell

    def reference_of(self, cell: CellResult) -> CellResult | None:
        return next((other for other in self.cells if other.name == cell.reference), None)

    def document(self, statistics: bool = False) -> dict[str, Any]:
        """Return the document as `esp report --json` writes it with statistics, and `--results` without."""
        computed: Any = None if statistics else {"cells": {"__all__": {"summary"}}}
        return RESULTS_FORMAT.document(self.model_dump(mode="json", exclude_defaults=True, exclude=computed))


def read_results(path: Path) -> Results:
    """Read a results file."""
    return RESULTS_FORMAT.parse(path, Results)


def summarised(results: Results) -> Results:
    """Return results with the statistics of each cell, computed from its numbers."""
    cells = tuple(cell.model_copy(update={"summary": summarise_cell(results, cell)}) for cell in results.cells)
    if kind_of(results.kind).benchmark:
        cells = _corrected(results, cells)
    return results.model_copy(update={"cells": cells})


def summarise_cell(results: Results, cell: CellResult) -> CellSummary | None:
    """Return the statistics of one cell; None where it has no returns yet."""
    values = returns_of(cell, results.mode)
    if values is None:
        return None
    returns = summarise(values)
    good = values[np.isfinite(values)]
    if not good.size or returns.mean is None:
        return CellSummary(returns)
    scale = {} if cell.roles else cell.anchors
    scores, ours = normalised(good, scale), (returns.mean, returns.sem, good.size)
    area = None if cell.area_under_curve is None else floats(cell.area_under_curve)
    scaled = None if area is None or not kind_of(results.kind).benchmark else normalised(area, scale)
    return CellSummary(
        returns,
        iqm=interquartile_mean(good),
        normalised=None if scores is None else summarise(scores),
        area=None if area is None else summarise(area),
        normalised_area=None if scaled is None else summarise(scaled),
        gap=_gap(results, cell, values),
        leader=None if cell.paper is None or good.size < values.size else leader(ours, (*cell.paper, NUM_SEEDS)),
    )


def returns_of(cell: CellResult, mode: Mode) -> Floats | None:
    """Return the returns of a cell [S], NaN where a seed stopped; None where it has none."""
    return floats(cell.returns[mode]) if mode in cell.returns else None


def floats(values: Sequence[float | None]) -> Floats:
    """Return numbers [S], NaN for None."""
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)


def _gap(results: Results, cell: CellResult, values: Floats) -> Gap | None:
    """Compare a cell with its reference; None where a seed of either stopped: the others are no fair sample."""
    other = results.reference_of(cell)
    others = None if other is None else returns_of(other, results.mode)
    if other is None or others is None or not (np.isfinite(values).all() and np.isfinite(others).all()):
        return None
    paired = cell.seeds == other.seeds
    gained, chance, of_all = difference(values, others, paired), None, None
    if min(values.size, others.size) >= MIN_SEEDS_TO_RANK:
        of_all = probability_of_improvement(values, others)
        chance = probability_of_improvement(values, others, paired=True) if paired else of_all
    side = None if of_all is None else side_of(gained.ci95)
    floor = cell.anchors.get(BLIND, -math.inf)
    if side is not None and max(values.mean(), others.mean()) < floor:
        side = "blind"
    return Gap(gained, paired, chance, of_all, side)


def _corrected(results: Results, cells: tuple[CellResult, ...]) -> tuple[CellResult, ...]:
    """Return cells that are ahead or behind by the rank-sum test, with Holm's correction for those of their panel."""
    ranked: dict[str, dict[str, tuple[CellSummary, Gap, float]]] = {}
    for cell in cells:
        other, summary = results.reference_of(cell), cell.summary
        if other is not None and summary is not None and summary.gap is not None and summary.gap.over_all_pairs:
            p = rank_sum_p(*(floats(one.returns[results.mode]) for one in (cell, other)))
            ranked.setdefault(cell.panel, {})[cell.name] = summary, summary.gap, p
    changed: dict[str, CellSummary] = {}
    for own in ranked.values():
        corrected = holm([p for *_, p in own.values()])
        for (name, (summary, gap, _)), p in zip(own.items(), corrected, strict=True):
            better = gap.over_all_pairs is not None and gap.over_all_pairs.value > 1 / 2
            side: Side = "level" if p > 1 - CONFIDENCE else "ahead" if better else "behind"
            side = "blind" if gap.ahead == "blind" else side
            changed[name] = replace(summary, gap=replace(gap, ahead=side, holm=p))
    return tuple(c.model_copy(update={"summary": changed[c.name]}) if c.name in changed else c for c in cells)


def side_of(interval: tuple[float, float] | None) -> Side | None:
    """Return where an interval of a difference lies; None where there is none."""
    if interval is None:
        return None
    low, high = interval
    return "ahead" if low > 0 else "behind" if high < 0 else "level"
