"""What the study of broken symmetry says: returns over the strength of breaking, and a verdict for each method."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from esp_cli.policies.statistics import Floats, difference, summarise
from esp_cli.reporting.results import CellResult, Results
from esp_cli.reporting.summary import Side, floats, returns_of, side_of
from esp_cli.studies.kinds import UNBROKEN, kind_of

PLAIN, ESP = "plain", "ESP"


@dataclass(frozen=True)
class Series:
    """The cells of one task and algorithm, by strength of breaking (smallest first) and method.

    Attributes:
        name: "navigation, MAPPO, 1M".
        setting: what breaks the symmetry.
        cells: by strength, then by method.
    """

    name: str
    setting: str
    cells: Mapping[float, Mapping[str, CellResult]]


@dataclass(frozen=True)
class Verdict:
    """Whether a method meets the bar of a default; None where runs are missing.

    Attributes:
        method: its name.
        unbroken: whether it is at most one standard error behind ESP where nothing is broken, in every series.
        largest: whether it is not behind the plain learner at the largest strength, in every series.
        between: whether it is ahead of the plain learner and of ESP or level with them, at all strengths in between.
    """

    method: str
    unbroken: bool | None
    largest: bool | None
    between: bool | None


def series_of(results: Results) -> list[Series]:
    """Return the series of a study of broken symmetry; none of other studies."""
    found: dict[tuple[str, str], dict[float, dict[str, CellResult]]] = {}
    heads = [
        (task, setting, strength, f"{task}, {setting} {strength:g}, " if strength else f"{task}, {UNBROKEN}, ")
        for task, settings in kind_of(results.kind).breakings.items()
        for setting, strengths in settings.items()
        for strength in (0.0, *strengths)
    ]
    for cell in results.cells:
        for task, setting, strength, head in heads:
            if cell.panel.startswith(head):
                name = f"{task}, {cell.panel.removeprefix(head)}"
                found.setdefault((name, setting), {}).setdefault(strength, {})[cell.variant] = cell
    whole = {key: dict(sorted(cells.items())) for key, cells in found.items() if set(cells) != {0.0}}
    return [Series(name, setting, cells) for (name, setting), cells in whole.items()]


def verdicts(results: Results) -> list[Verdict]:
    """Return one verdict for each method beside the plain learner and ESP."""
    series = series_of(results)
    methods = dict.fromkeys(cell.variant for one in series for cells in one.cells.values() for cell in cells.values())
    tests = (_unbroken, _largest, _between)
    return [
        Verdict(method, *(_all(test(results, one, method) for one in series) for test in tests))
        for method in methods
        if method not in (PLAIN, ESP)
    ]


def side(results: Results, cell: CellResult, other: CellResult | None, early: bool = False) -> Side | None:
    """Return whether a cell is ahead of another, by the 95 % interval of the difference of their means.

    Args:
        results: of the study.
        cell: one cell.
        other: the other, if there is one.
        early: at the evaluation nearest to a fifth of the run instead of its end.
    """
    values = at(results, cell, early)
    others = None if other is None else at(results, other, early)
    if other is None or values is None or others is None or not _finite(values, others):
        return None
    found = difference(values, others, cell.seeds == other.seeds)
    interval = found.ci95
    if interval is None:  # of one seed, or of runs that differ by the same number for every seed, as equal ones do
        if min(values.size, others.size) < 2:
            return None
        interval = (found.value, found.value)
    return side_of(interval)


def at(results: Results, cell: CellResult, early: bool) -> Floats | None:
    """Return the returns by seed, nearest to a fifth of the run or at its end; None where it was not run so far."""
    if not early:
        return returns_of(cell, results.mode)
    return None if cell.early is None else floats(cell.early)


def leaders(results: Results, cells: Mapping[str, CellResult], early: bool) -> set[str]:
    """Return the method with the highest mean, and those that are not told apart from it."""
    known = {method: values for method, cell in cells.items() if (values := at(results, cell, early)) is not None}
    best = max((method for method in known if _finite(known[method])), key=lambda one: known[one].mean(), default=None)
    if best is None:
        return set()
    return {best} | {one for one in known if side(results, cells[one], cells[best], early) == "level"}


def _finite(*values: Floats) -> bool:
    return all(bool(np.isfinite(one).all()) for one in values)


def _all(found: Iterator[bool | None]) -> bool | None:
    """Return whether all hold; None where one is not known and none fails."""
    answers = list(found)
    if False in answers:
        return False
    return None if None in answers or not answers else True


def _unbroken(results: Results, one: Series, method: str) -> bool | None:
    cells = one.cells.get(0.0, {})
    pair = [cells.get(name) for name in (method, ESP)]
    values = [None if cell is None else returns_of(cell, results.mode) for cell in pair]
    found = [None if own is None or not _finite(own) else summarise(own) for own in values]
    if found[0] is None or found[1] is None or found[0].mean is None or found[1].mean is None:
        return None
    error = max(found[0].sem or 0.0, found[1].sem or 0.0)
    return found[0].mean >= found[1].mean - error


def _largest(results: Results, one: Series, method: str) -> bool | None:
    cells = one.cells[max(one.cells)]
    return _holds(results, cells, method, (PLAIN,))


def _between(results: Results, one: Series, method: str) -> bool | None:
    inner = [value for value in one.cells if 0 < value < max(one.cells)]
    return _all(_holds(results, one.cells[value], method, (PLAIN, ESP)) for value in inner)


def _holds(results: Results, cells: Mapping[str, CellResult], method: str, others: tuple[str, ...]) -> bool | None:
    """Return whether a method is behind none of the others."""
    cell = cells.get(method)
    if cell is None:
        return None
    sides = [side(results, cell, cells.get(name)) for name in others]
    return _all(None if one is None else one != "behind" for one in sides)
