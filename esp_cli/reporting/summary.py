"""What tables state of results: means with intervals, differences from the reference, numbers over all panels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from esp_cli.defaults import Mode
from esp_cli.policies.statistics import (
    Floats,
    aggregate,
    average_improvement,
    difference,
    interquartile_mean,
    leader,
    normalise,
    probability_of_improvement,
    summarise,
)
from esp_cli.reporting.results import Aggregate, CellResult, CellSummary, Gap, Results, Side
from esp_cli.studies.paper import NUM_SEEDS

MIN_SEEDS_TO_RANK = 3  # of either side; a probability of improvement of fewer seeds says nothing


def summarised(results: Results) -> Results:
    """Return results with the statistics of each cell and over all panels, computed from its numbers."""
    cells = tuple(cell.model_copy(update={"summary": summarise_cell(results, cell)}) for cell in results.cells)
    return results.model_copy(update={"cells": cells, "aggregates": aggregates(results)})


def summarise_cell(results: Results, cell: CellResult) -> CellSummary | None:
    """Return the statistics of one cell; None where it has no returns yet."""
    values = returns_of(cell, results.mode)
    if values is None:
        return None
    returns = summarise(values)
    good = values[np.isfinite(values)]
    if not good.size or returns.mean is None:
        return CellSummary(returns)
    scores, ours = _normalised(cell, good), (returns.mean, returns.sem, good.size)
    return CellSummary(
        returns,
        iqm=interquartile_mean(good),
        normalised=None if scores is None else summarise(scores),
        area=None if cell.area_under_curve is None else summarise(floats(cell.area_under_curve)),
        gap=_gap(results, cell, values),
        leader=None if cell.paper is None else leader(ours, (*cell.paper, NUM_SEEDS)),
    )


def aggregates(results: Results) -> dict[str, Aggregate]:
    """Return numbers over all panels by variant, with intervals whose bootstrap redraws seeds within each panel.

    Only variants with two or more panels, all of them finished and with anchors.
    """
    out: dict[str, Aggregate] = {}
    for variant in dict.fromkeys(cell.variant for cell in results.cells):
        own = [cell for cell in results.cells if cell.variant == variant]
        scores: dict[str, Floats] = {}
        pairs: dict[str, tuple[Floats, Floats]] = {}
        for cell in own:
            values = returns_of(cell, results.mode)
            normalised = None if values is None or not np.isfinite(values).all() else _normalised(cell, values)
            if values is None or normalised is None:
                break
            scores[cell.panel] = normalised
            other = results.reference_of(cell)
            others = None if other is None or other.seeds != cell.seeds else returns_of(other, results.mode)
            if others is not None and np.isfinite(others).all() and others.size >= MIN_SEEDS_TO_RANK:
                pairs[cell.panel] = (values, others)
        if len(scores) < max(2, len(own)):
            continue
        whole = len(pairs) == len(own) and len({x.size for x, _ in pairs.values()}) == 1
        improvement = average_improvement(pairs) if whole else None
        out[variant] = Aggregate(aggregate(scores, "iqm"), aggregate(scores, "mean"), improvement)
    return out


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
    return Gap(gained, paired, chance, of_all, None if of_all is None else side_of(gained.ci95))


def side_of(interval: tuple[float, float] | None) -> Side | None:
    """Return where an interval of a difference lies; None where there is none."""
    if interval is None:
        return None
    low, high = interval
    return "ahead" if low > 0 else "behind" if high < 0 else "level"


def _normalised(cell: CellResult, values: Floats) -> Floats | None:
    heuristics = [value for name, value in cell.anchors.items() if name != "random"]
    if "random" not in cell.anchors or not heuristics or cell.anchors["random"] >= max(heuristics):
        return None
    return normalise(values, cell.anchors["random"], max(heuristics))
