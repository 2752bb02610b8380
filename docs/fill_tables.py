"""Compute the tables of the documentation from results files: python docs/fill_tables.py [PAGE...].

A table stands between two comments, each at the beginning of its line:

    <!-- results: measured/table1.json paper -->
    ... written by this script, never by hand ...
    <!-- end of results -->

A table of evaluations or of learning curves stands between `<!-- scores: FILE... -->` and the same end.
The file is found from the page's own folder; the word behind it is a name of TABLES. Several files of one kind of
study, with spaces between, give one table. A last word, `greedy` or `stochastic`, says which final returns it takes.
"""

from __future__ import annotations

import re
import runpy
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from esp_cli.files.formatting import NOTHING
from esp_cli.files.opening import read_regular
from esp_cli.files.writing import write_file
from esp_cli.policies.statistics import Floats, difference, summarise
from esp_cli.reporting.results import CellResult, Results, Side, floats, read_results, returns_of, side_of, summarised
from esp_cli.reporting.study_figures import Series, series_of
from esp_cli.reporting.tables import TABLES as REPORT_TABLES
from esp_cli.reporting.tables import Table, mean_text, on_the_way
from esp_cli.studies.kinds import UNBROKEN
from esp_envs.errors import UserError

DOCS = Path(__file__).parent
PLAIN, ESP = "plain", "ESP"
_MAX_BYTES = 2**24
_OF_EITHER_MODE = ("returns", "paper", "comparison", "pairs")
"""Tables of final returns, which files keep of greedy and of drawn actions; of curves they keep one."""
_BLOCK = re.compile(
    r"^(<!-- results: (?P<files>\S+(?: \S+)*?) (?P<table>\S+)(?: (?P<mode>greedy|stochastic))? -->\n)"
    r".*?^(?P<end><!-- end of results -->)",
    re.DOTALL | re.MULTILINE,
)
_SCORES = re.compile(
    r"^(<!-- scores: (?P<files>\S+(?: \S+)*) -->\n).*?^(?P<end><!-- end of results -->)", re.DOTALL | re.MULTILINE
)
scores_table = runpy.run_path(str(DOCS / "score_tables.py"))["scores_table"]
_beside = runpy.run_path(str(DOCS / "result_tables.py"))


def filled(page: Path) -> str:
    """Return the text of a page with every such table recomputed.

    Raises:
        UserError: the page, a file or a table is not there, a file is damaged, or the page has no such comments.
    """
    try:
        text = (read_regular(page, _MAX_BYTES) or b"").decode()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"cannot read {page}: {error}") from None

    @cache
    def summarised_results(files: str, mode: str | None) -> Results:
        results = join([read_results(page.parent / file) for file in files.split()])
        return summarised(results.model_copy(update={"mode": mode} if mode else {}))

    def compute(match: re.Match[str]) -> str:
        name, mode = match["table"], match["mode"]
        if name not in TABLES or (mode and name not in _OF_EITHER_MODE):
            known = f"{', '.join(TABLES)}; {', '.join(_OF_EITHER_MODE)} take a mode"
            raise UserError(f"{page} asks for the table '{' '.join(filter(None, (name, mode)))}'; there are {known}")
        table = TABLES[name](summarised_results(match["files"], mode))
        return f"{match[1]}\n{table.markdown() if table.rows else 'Nothing yet.'}\n\n{match['end']}"

    def score(match: re.Match[str]) -> str:
        table = scores_table([page.parent / file for file in match["files"].split()])
        return f"{match[1]}\n{table.markdown()}\n\n{match['end']}"

    page_text, count = _BLOCK.subn(compute, text)
    page_text, scores = _SCORES.subn(score, page_text)
    if not count + scores:
        raise UserError(f"{page} has no table to compute; write '<!-- results: FILE TABLE -->' and its end")
    return page_text


def files_of(page: Path) -> list[str]:
    """Return the results files that a page's tables come from, each once."""
    blocks = _BLOCK.finditer(page.read_text(encoding="utf-8"))
    return list(dict.fromkeys(file for match in blocks for file in match["files"].split()))


def join(several: Sequence[Results]) -> Results:
    """Return the results of studies of one kind as those of one study, the cells in their order.

    A cell that two of them have with the same returns, as a run and its repetition do, counts once; of a cell that one
    of them has not finished, the other one's returns count. Cells of one name in other panels are other cells.

    Raises:
        UserError: kinds or evaluations that do not go together, or a cell that two of them have with other returns.
    """
    first = several[0]
    if any((r.kind, r.mode, r.rows) != (first.kind, first.mode, first.rows) for r in several):
        raise UserError("results of studies of different kinds, or of different evaluations, have no table in common")
    cells: dict[str, CellResult] = {}
    for results in several:
        own = results.cells
        if any(cell.name in cells and cells[cell.name].panel != cell.panel for cell in own):
            own = tuple(in_panel(cell) for cell in own)
        for cell in own:
            there = cells.get(cell.name)
            if there is None or (cell.returns and not there.returns):
                whole = {"config": results.config | cell.config, "episodes": cell.episodes or results.episodes}
                cells[cell.name] = cell.model_copy(update=whole)
            elif cell.returns and (there.returns, there.seeds, there.step) != (cell.returns, cell.seeds, cell.step):
                raise UserError(f"{cell.name} stands in two of the results files, with different returns")
    command = "\n".join(dict.fromkeys(results.command for results in several))
    return first.model_copy(update={"command": command, "config": {}, "cells": tuple(cells.values())})


def in_panel(cell: CellResult) -> CellResult:
    """Return a cell whose name, and whose reference's, begin with the panel."""
    reference = cell.reference and f"{cell.panel}: {cell.reference}"
    return cell.model_copy(update={"name": f"{cell.panel}: {cell.name}", "reference": reference})


def methods_table(results: Results, early: bool = False) -> Table:
    """Return the returns with one column for each method of a study of broken symmetry."""
    series = series_of(results)
    shared = series[0].name if len({one.name for one in series}) == 1 else None
    lines = {
        (one.name, f"{one.setting} {strength:g}" if strength else UNBROKEN): cells
        for one in series
        for strength, cells in one.cells.items()
    }
    methods = tuple(dict.fromkeys(method for cells in lines.values() for method in cells))
    rows = []
    for (name, breaking), cells in lines.items():
        best = leaders(results, cells, early)
        known = {m: values for m, cell in cells.items() if (values := returns_at(results, cell, early)) is not None}
        texts = {method: mean_text(summarise(values)) for method, values in known.items()}
        label = breaking if shared else f"{name}, {breaking}"
        rows.append((label, *(f"{texts.get(one, NOTHING)}{' (*)' if one in best else ''}" for one in methods)))
    when = "at the evaluation nearest to a fifth of the run" if early else "at the end of the run"
    compared = "(*): the highest of its row, or not told apart from it"
    caption = f"Mean ± standard error over seeds {when}{on_the_way(results) if early else ''}; {compared}."
    return Table(f"Returns {when}", (shared or "run", *(f"{m}>" for m in methods)), tuple(rows), caption)


class Verdict(NamedTuple):
    """Whether a method meets the bar of a default, in every series; None where runs are missing.

    Attributes:
        method: its name.
        unbroken: whether it is at most one standard error behind ESP where nothing is broken.
        largest: whether it is not behind the plain learner at the largest strength.
        between: whether it is ahead of the plain learner and of ESP or level with them, at all strengths in between.
    """

    method: str
    unbroken: bool | None
    largest: bool | None
    between: bool | None


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


def verdicts_table(results: Results) -> Table:
    """Return for each method of a study of broken symmetry whether it could be the default."""
    words = {True: "yes", False: "no", None: NOTHING}
    rows = tuple((v.method, words[v.unbroken], words[v.largest], words[v.between]) for v in verdicts(results))
    caption = (
        "Where nothing is broken, a default is at most one standard error (the larger of the two) behind ESP. At the "
        "largest strength it is not behind the plain learner. In between it is ahead of both or level with them. All "
        f"holds in every task. {NOTHING}: runs are missing."
    )
    headings = ("method", "not behind ESP unbroken", "not behind plain at the largest", "ahead or level in between")
    return Table("Could it be the default?", headings, rows, caption)


def side(results: Results, cell: CellResult, other: CellResult | None, early: bool = False) -> Side | None:
    """Return whether a cell is ahead of another, by the 95 % interval of the difference of their means."""
    values = returns_at(results, cell, early)
    others = None if other is None else returns_at(results, other, early)
    if other is None or values is None or others is None or not _finite(values, others):
        return None
    found = difference(values, others, cell.seeds == other.seeds)
    interval = found.ci95
    if interval is None:  # of one seed, or of runs that differ by the same number for every seed, as equal ones do
        if min(values.size, others.size) < 2:
            return None
        interval = (found.value, found.value)
    return side_of(interval)


def returns_at(results: Results, cell: CellResult, early: bool) -> Floats | None:
    """Return the returns by seed, nearest to a fifth of the run or at its end; None where it was not run so far."""
    if not early:
        return returns_of(cell, results.mode)
    return None if cell.early is None else floats(cell.early)


def leaders(results: Results, cells: Mapping[str, CellResult], early: bool) -> set[str]:
    """Return the method with the highest mean, and those that are not told apart from it."""
    known = {m: values for m, cell in cells.items() if (values := returns_at(results, cell, early)) is not None}
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
    values = [returns_of(cells[name], results.mode) if name in cells else None for name in (method, ESP)]
    own, others = (None if found is None or not _finite(found) else summarise(found) for found in values)
    if own is None or others is None or own.mean is None or others.mean is None:
        return None
    return own.mean >= others.mean - max(own.sem or 0.0, others.sem or 0.0)


def _largest(results: Results, one: Series, method: str) -> bool | None:
    return _holds(results, one.cells[max(one.cells)], method, (PLAIN,))


def _between(results: Results, one: Series, method: str) -> bool | None:
    inner = [value for value in one.cells if 0 < value < max(one.cells)]
    return _all(_holds(results, one.cells[value], method, (PLAIN, ESP)) for value in inner)


def _holds(results: Results, cells: Mapping[str, CellResult], method: str, others: tuple[str, ...]) -> bool | None:
    """Return whether a method is behind none of the others."""
    if method not in cells:
        return None
    sides = [side(results, cells[method], cells.get(name)) for name in others]
    return _all(None if one is None else one != "behind" for one in sides)


TABLES = {
    **REPORT_TABLES,
    "paper": _beside["paper_table"],
    "pairs": _beside["pairs_table"],
    "references": _beside["references_table"],
    "methods": methods_table,
    "methods-early": lambda results: methods_table(results, early=True),
    "verdicts": verdicts_table,
}
"""By the name that a page asks for."""


def main() -> None:
    """Fill the named pages, or all."""
    named = [Path(name) for name in sys.argv[1:]]
    for page in named or [
        page for page in sorted(DOCS.rglob("*.md")) if "<!-- end of results -->" in page.read_text(encoding="utf-8")
    ]:
        write_file(page, filled(page).encode())
        print(f"tables -> {page}")


if __name__ == "__main__":
    main()
