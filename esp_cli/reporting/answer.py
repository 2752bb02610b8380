"""What came out of a study or of runs side by side, in at most three sentences that are made from the numbers."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from esp_cli.files.formatting import format_count, format_interval, format_mean
from esp_cli.policies.statistics import steps_to_threshold
from esp_cli.reporting.collect import Material
from esp_cli.reporting.results import CellResult, Results, Side

_VERDICTS: dict[Side, str] = {"ahead": "is better than", "behind": "is worse than", "level": "is not told apart from"}
_SCALE = "where 0 is the random policy and 1 the best hand-written one"


def answer(material: Material) -> list[str]:
    """Return the answer: of one run beside its reference in full, of several how many are ahead."""
    results = material.results
    finished = [cell for cell in results.cells if cell.summary is not None and cell.summary.returns.mean is not None]
    pairs = [(cell, other) for cell in finished if (other := results.reference_of(cell)) is not None]
    pairs = [(cell, other) for cell, other in pairs if other in finished]
    if len(pairs) == 1:
        both = pairs[0]
        return [_returns(results, *both), _verdict(*both), *_steps(material, *both)]
    texts = _count(pairs) if pairs else [_returns(results, cell) for cell in finished[:2]]
    if means := [f"{name} {one.mean.value:.2f}" for name, one in results.aggregates.items()]:
        texts.append(f"Mean normalised return over all panels, {_SCALE}: {', '.join(means)}.")
    return texts or ["No run has a return yet."]


def _returns(results: Results, *cells: CellResult) -> str:
    """State what each run has reached, with its normalised return where the task has reference policies."""
    summaries = [cell.summary for cell in cells if cell.summary is not None]
    means = [format_mean(one.returns.mean, one.returns.sem) for one in summaries]
    ours = [f"{cell.variant} has {mean}" for cell, mean in zip(cells, means, strict=True)]
    scores = [f"{one.normalised.mean:.2f}" for one in summaries if one.normalised is not None]
    normalised = f"; normalised {' and '.join(scores)}, {_SCALE}" if scores else ""
    seeds = len(cells[0].seeds)
    what = f"{results.mode} return, {seeds} seed{'s'[: seeds - 1]}{normalised}"
    return f"{cells[0].panel}: {' and '.join(ours)} ({what})."


def _verdict(cell: CellResult, other: CellResult) -> str:
    gap = None if cell.summary is None else cell.summary.gap
    if gap is None or gap.ahead is None:
        return "There is no interval of the difference, so this tells nothing for sure; take three seeds or more."
    interval = f"the difference is {gap.difference.value:+.2f}, 95 % interval {format_interval(gap.difference.ci95)}"
    return f"{cell.variant} {_VERDICTS[gap.ahead]} {other.variant}: {interval}."


def _steps(material: Material, cell: CellResult, other: CellResult) -> list[str]:
    """State when both mean curves first have the highest return that both of them have."""
    curves = [material.curves[one.name] for one in (cell, other) if one.name in material.curves]
    curves = [curve for whole in curves if (curve := whole.until(cell.at or whole.last_step)) is not None]
    highest = [float(np.nanmax(curve.values.mean(axis=1), initial=-math.inf)) for curve in curves]
    if len(curves) < 2 or not math.isfinite(limit := min(highest)):
        return []
    first = [steps_to_threshold(curve.steps, curve.values, limit).of_mean or 0 for curve in curves]
    ours, theirs = map(format_count, first)
    return [
        f"The mean over seeds first has {limit:.2f} after {ours} steps of {cell.variant}, {theirs} of {other.variant}."
    ]


def _count(pairs: list[tuple[CellResult, CellResult]]) -> list[str]:
    """Count who is ahead, and name the largest and the smallest difference."""
    gaps = [(cell, cell.summary.gap) for cell, _ in pairs if cell.summary is not None and cell.summary.gap is not None]
    sides = Counter(gap.ahead for _, gap in gaps)
    counts = f"better {sides['ahead']}, not told apart {sides['level']}, worse {sides['behind']}"
    texts = [f"Of {len(pairs)} runs beside their reference: {counts} (95 % intervals of the difference)."]
    if gaps:
        ordered = sorted(gaps, key=lambda pair: pair[1].difference.value)
        largest, smallest = (
            f"{gap.difference.value:+.2f} {format_interval(gap.difference.ci95)} ({cell.variant}; {cell.panel})"
            for cell, gap in (ordered[-1], ordered[0])
        )
        texts.append(f"The largest difference is {largest}, the smallest {smallest}.")
    return texts
