"""Results as tables: the study's own layout, and every statistic of every cell."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import zip_longest
from typing import TypeVar

from pydantic import JsonValue

from esp_cli.defaults import Mode
from esp_cli.files.formatting import (
    NOTHING,
    format_count,
    format_duration,
    format_interval,
    format_mean,
    format_p,
    format_span,
    markdown_text,
    said_once,
)
from esp_cli.policies.statistics import Estimate, Interval, Passing, SeedSummary, median_steps, summarise
from esp_cli.reporting.results import CellResult, CellSummary, Gap, Results, floats
from esp_cli.studies.kinds import kind_of

NOT_RUN, _STOPPED = "not run", "every seed stopped"
AHEAD = {"ahead": "yes", "behind": "no", "level": "not told apart", "blind": "both below blind", None: NOTHING}
_LEADER = {"first": "ours", "second": "paper", "neither": "not told apart", None: NOTHING}
_BY_INTERVALS = "Ahead: the 95 % interval of the difference lies above 0."
_BY_RANKS = "Ahead: by the rank-sum test at 5 %, with Holm's correction for the comparisons of a panel."
_SHARES = ("share of reference run>", "ratio of median steps>")
Row = TypeVar("Row")
Columns = dict[str, Callable[[Row], str]]  # heading -> text of a row
_NAMES: Columns[CellResult] = {"panel": lambda cell: cell.panel, "run": lambda cell: cell.variant}


@dataclass(frozen=True)
class Table:
    """A table before it is drawn."""

    title: str  # one line above
    headings: tuple[str, ...]  # of the columns; one that ends in ">" is aligned to the right
    rows: tuple[tuple[str, ...], ...]  # texts
    caption: str = ""  # one line below

    def markdown(self) -> str:
        """Return the table as Markdown, without its title."""
        names = [heading.removesuffix(">") for heading in self.headings]
        rule = ["---:" if heading.endswith(">") else "---" for heading in self.headings]
        first, *others = ([markdown_text(cell) for cell in row] for row in (names, *self.rows))
        lines = [f"| {' | '.join(cells)} |" for cells in (first, rule, *others)]
        return "\n".join([*lines, *(["", markdown_text(self.caption)] if self.caption else [])])


def all_tables(results: Results) -> list[Table]:
    """Return every table that has something to say, of results with their statistics."""
    return [table for make in TABLES.values() if (table := make(results)).rows]


def returns_table(results: Results) -> Table:
    """Return the study in its own layout, ours above the paper's."""
    by_panel = results.rows == "panels"
    cells = {(c.panel, c.variant) if by_panel else (c.variant, c.panel): c for c in results.cells}
    rows, columns = (list(dict.fromkeys(names)) for names in zip(*cells, strict=True))
    most = max(len(cell.seeds) for cell in results.cells)
    has_paper = any(cell.paper for cell in results.cells)
    lines: list[tuple[str, ...]] = []

    def own_text(cell: CellResult) -> str:
        fewer = cell.status == "finished" and len(cell.seeds) < most
        return return_text(cell) + (f" (n = {len(cell.seeds)})" if fewer else "")

    for row in rows:
        placed = [cells.get((row, column)) for column in columns]
        ours = [NOTHING if cell is None else own_text(cell) for cell in placed]
        theirs = [format_mean(*cell.paper) if cell is not None and cell.paper else NOTHING for cell in placed]
        lines.append((row, *(["ours"] if has_paper else []), *ours))
        if set(theirs) != {NOTHING}:
            lines.append(("", "paper", *theirs))
    conventions = list(dict.fromkeys(cell.convention for cell in results.cells if cell.convention is not None))
    seeds = format_span({len(cell.seeds) for cell in results.cells})
    episodes = format_span({cell.episodes or results.episodes for cell in results.cells})
    caption = f"Mean ± standard error over {seeds} seeds of the {results.mode} return, {episodes} episodes a seed."
    caption += f" Convention: {said_once(conventions)}." if conventions else ""
    headings = ("", *([""] if has_paper else []), *(f"{column}>" for column in columns))
    return Table(results.title, headings, tuple(lines), caption)


def comparison_table(results: Results) -> Table:
    """Return each cell beside its reference and the paper's number: intervals, and who is ahead."""
    has_paper, has_steps = any(cell.paper for cell in results.cells), any(cell.at is not None for cell in results.cells)
    columns: Columns[CellResult] = dict(_NAMES)
    if has_steps:
        columns["trained to>"] = lambda cell: format_count(cell.step)
    columns |= {
        "return>": return_text,
        "95 % interval>": _known(lambda summary: format_interval(summary.returns.ci95)),
        "minus reference>": _beside(lambda gap: f"{gap.difference.value:+.2f} {format_interval(gap.difference.ci95)}"),
        "P(improvement)>": _beside(lambda gap: _estimate(gap.probability)),
        "over all pairs>": _beside(lambda gap: _estimate(gap.over_all_pairs)),
    }
    corrected = kind_of(results.kind).benchmark
    if corrected:
        columns["p, corrected>"] = _beside(lambda gap: format_p(gap.holm).removeprefix("= "))
    columns["ahead of reference"] = _beside(lambda gap: AHEAD[gap.ahead])
    if has_paper:
        columns |= {
            "paper>": lambda cell: format_mean(*cell.paper) if cell.paper and _summary(cell) else NOTHING,
            "ours or paper ahead": _known(lambda summary: _LEADER[summary.leader]),
        }
    by_seed = all(summary.gap is None or summary.gap.paired for cell in results.cells if (summary := _summary(cell)))
    welch = "Ours and the paper's means are compared by Welch's test at 5 %. " if has_paper else ""
    drawn = "Returns are those of drawn actions. " if results.mode == "stochastic" else ""
    caption = (
        f"The reference is {_reference(results)}, compared seed by seed"
        f"{'' if by_seed else ' where both have the same seeds'}; over all pairs: "
        f"every seed with every seed. {_BY_RANKS if corrected else _BY_INTERVALS} {welch}{drawn}"
        "No interval is widened for the number of comparisons."
    )
    return table(f"Beside the reference{' and the paper' if has_paper else ''}", columns, results.cells, caption)


def statistics_table(results: Results) -> Table:
    """Return further statistics of each cell: robust mean, scale, and how fast it learned."""
    benchmark = kind_of(results.kind).benchmark
    columns: Columns[CellResult] = {
        **_NAMES,
        "seeds>": _known(lambda summary: str(sum(value is not None for value in summary.returns.per_seed))),
        "IQM>": _known(lambda summary: _estimate(summary.iqm)),
        "normalised>": _known(lambda summary: mean_text(summary.normalised)),
        "mean over the run>": _known(lambda summary: mean_text(summary.area)),
        **({"normalised area>": _known(lambda one: mean_text(one.normalised_area))} if benchmark else {}),
        "training>": lambda cell: NOTHING if cell.seconds is None else format_duration(cell.seconds),
    }
    caption = (
        "IQM: mean without the lowest and the highest quarter of the seeds, rounded down. Normalised: 0 is the random "
        f"policy, 1 the best heuristic. Mean over the run: area under the curve{', also normalised' * benchmark}."
    )
    if any(cell.early for cell in results.cells):
        columns["return at 20 %>"] = lambda cell: mean_text(summarise(floats(cell.early))) if cell.early else NOTHING
        caption += f" Return at 20 %: at the evaluation nearest to a fifth of the run{on_the_way(results)}."
    if any(cell.flops_per_action is not None for cell in results.cells):
        columns["weights>"] = lambda cell: format_count(cell.parameters["policy"]) if cell.parameters else NOTHING
        columns["FLOPs an action>"] = lambda cell: NOTHING if (n := cell.flops_per_action) is None else format_count(n)
        caption += " Weights: of one seed's policy. FLOPs: of the matrix products for one agent's action."
    return table("Seeds and scale", columns, filter(_summary, results.cells), caption)


def steps_table(results: Results) -> Table:
    """Return when each cell first reaches a return, by default what its reference ended with."""
    rows = []
    runs = {(cell.variant, cell.panel if cell.at is None else None): cell for cell in results.cells}
    for cell in runs.values():  # of runs compared at several steps the last
        reference = results.reference_of(cell) or cell
        for passing in cell.steps_to:
            never = math.nan if cell.has_stopped else math.inf
            mean = never if passing.of_mean is None else passing.of_mean
            median, interval = _median_steps(cell, results.mode, passing)
            span = f"[{', '.join(_within(end, cell.step) for end in interval)}]" if interval else NOTHING
            reached = (_within(mean, cell.step), _within(median, cell.step), span)
            theirs = [p for p in reference.steps_to if p.threshold == passing.threshold and reference is not cell]
            ratio = _share(median, _median_steps(reference, results.mode, theirs[0])[0]) if theirs else ""
            shares = (_share(median, reference.step), ratio)
            rows.append((cell.panel, cell.variant, f"{passing.threshold:.2f}", *reached, *shares))
    caption = (
        "Environment steps to what the reference ended with, or to a return that was asked for. Curves are of the "
        f"evaluations on the way{on_the_way(results)}; a run may stay below what it has in its final evaluation on "
        "new episodes. Mean: of the mean curve. The interval is that of the median; its ends are seeds, of ten the "
        "second and the ninth. Share of reference run: the median seed's steps divided by all steps of the reference. "
        "Ratio of median steps: the same divided by the steps of the reference's median seed."
    )
    headings = ("panel", "run", "return>", "mean>", "median seed>", "95 % interval>", *_SHARES)

    return Table("Steps to a return", headings, tuple(rows), caption)


def left_out_table(results: Results) -> Table:
    """Return why a benchmark has no run of a method on a task."""
    alike: dict[tuple[str, str], list[str]] = {}
    for name, reason in results.left_out.items():
        task, _, method = name.rpartition(": ")
        alike.setdefault((task, reason), []).append(method)
    rows = tuple((task, "; ".join(methods), reason) for (task, reason), methods in alike.items())
    return Table("Left out", ("task", "methods", "reason"), rows)


def provenance_table(results: Results) -> Table:
    """Return what was run, by which version, and how long it took."""
    # each run once: a report may look at several of its steps, and it may not have reached the last of them
    ordered = sorted(results.cells, key=lambda cell: cell.status == "finished")
    runs = {(cell.variant, str(cell.config)): cell for cell in ordered}.values()
    trained = {(str(run.config), run.seconds) for run in runs}  # runs that train the same were trained once, and copied
    total = sum(seconds or 0.0 for _, seconds in trained)
    trained_by = {run.esp_version for run in runs if run.seconds is not None and run.esp_version}
    rows = (
        ("command", "; ".join(results.command.splitlines())),
        ("version of esp", ", ".join(sorted(trained_by) or [results.esp_version])),
        ("runs finished", f"{sum(run.status == 'finished' for run in runs)} of {len(runs)}"),
        ("training", f"{format_duration(total)}, all runs added up, those that train the same once"),
    )
    return Table("Provenance", ("", ""), rows)


TABLES: Mapping[str, Callable[[Results], Table]] = {
    "returns": returns_table,
    "comparison": comparison_table,
    "statistics": statistics_table,
    "steps": steps_table,
    "left-out": left_out_table,
    "provenance": provenance_table,
}
"""In the order of a report; each takes results with their statistics."""


def return_text(cell: CellResult) -> str:
    """Return the mean return of a cell with its standard error, or how far the run is."""
    if cell.summary is not None:
        return _STOPPED if cell.summary.returns.mean is None else mean_text(cell.summary.returns)
    return NOT_RUN if cell.status == "not run" else f"at {format_count(cell.step)}"


def mean_text(summary: SeedSummary | None) -> str:
    """Return mean and standard error, and how many seeds stopped and are not in them."""
    if summary is None or summary.mean is None:
        return NOTHING
    stopped = summary.per_seed.count(None)
    return format_mean(summary.mean, summary.sem) + (f" ({stopped} stopped)" if stopped else "")


def on_the_way(results: Results) -> str:
    """Say how many episodes the evaluations of the curves have: " (32 episodes a seed)"."""
    counts = {(results.config | cell.config).get("evaluation.episodes") for cell in results.cells}
    known = {count for count in counts if isinstance(count, int)}
    return f" ({format_span(known)} episodes a seed)" if known else ""


def table(title: str, columns: Columns[Row], rows: Iterable[Row], caption: str) -> Table:
    """Return a table from the description of its columns."""
    return Table(title, tuple(columns), tuple(tuple(text(row) for text in columns.values()) for row in rows), caption)


def _summary(cell: CellResult) -> CellSummary | None:
    return None if cell.summary is None or cell.summary.returns.mean is None else cell.summary


def _known(text: Callable[[CellSummary], str]) -> Callable[[CellResult], str]:
    return lambda cell: NOTHING if (summary := _summary(cell)) is None else text(summary)


def _beside(text: Callable[[Gap], str]) -> Callable[[CellResult], str]:
    def column(cell: CellResult) -> str:
        summary = _summary(cell)
        if summary is not None and cell.reference is None:
            return ""
        return NOTHING if summary is None or summary.gap is None else text(summary.gap)

    return column


def _reference(results: Results) -> str:
    kind = kind_of(results.kind)
    firsts = [results.config | cell.config for cell in results.cells if cell.reference is None]
    return kind.reference if all(map(_is_plain, firsts)) else kind.otherwise


def _is_plain(config: Mapping[str, JsonValue]) -> bool:
    """Return whether a run, by its settings with dotted names, has no symmetry in its prior or its network."""
    known = "equivariant", "set-equivariant", "empn"
    symmetric = config.get("network.name") in known or config.get("network.symmetrise")
    return config.get("prior.kind") == "none" and not symmetric


def _median_steps(cell: CellResult, mode: Mode, passing: Passing) -> tuple[float, Interval | None]:
    """Return median and interval, where they do not hang on when seeds that stopped would have got there."""
    unknown = [steps is end is None for steps, end in zip(passing.per_seed, cell.returns.get(mode, ()), strict=False)]
    early = [0 if left else steps for steps, left in zip_longest(passing.per_seed, unknown)]
    soonest, latest = median_steps(early), median_steps(passing.per_seed)
    return latest[0] if soonest[0] == latest[0] else math.nan, latest[1] if soonest == latest else None


def _share(steps: float, of: float) -> str:
    return f"{steps / of:.2f}" if math.isfinite(steps) and math.isfinite(of) and of else NOTHING


def _within(steps: float, run: int) -> str:
    if math.isnan(steps):
        return NOTHING
    return format_count(steps) if math.isfinite(steps) else f"> {format_count(run)}"


def _estimate(estimate: Estimate | None) -> str:
    if estimate is None:
        return NOTHING
    return f"{estimate.value:.2f}" + (f" {format_interval(estimate.ci95)}" if estimate.ci95 else "")
