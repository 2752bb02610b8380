"""Results as tables: the paper's own layout, every statistic of every cell, and numbers over all panels."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from pydantic import JsonValue

from esp_cli.files.formatting import NOTHING, format_count, format_duration, format_interval, format_mean, format_span
from esp_cli.policies.curve_statistics import median_steps
from esp_cli.policies.statistics import Estimate, SeedSummary, summarise
from esp_cli.reporting.breaking import ESP, PLAIN, at, leaders, series_of, side, verdicts
from esp_cli.reporting.results import CellResult, Results
from esp_cli.reporting.summary import CellSummary, aggregates, summarise_cell
from esp_cli.studies import paper
from esp_cli.studies.catalogue import paper_cells
from esp_cli.studies.kinds import UNBROKEN, kind_of

NOT_RUN, _STOPPED = "not run", "every seed stopped"
_AHEAD = {"ahead": "yes", "behind": "no", "level": "not told apart", None: NOTHING}
_LEADER = {"first": "ours", "second": "paper", "neither": "not told apart", None: NOTHING}
_GAP = ("minus reference>", "P(improvement)>", "over all pairs>", "ahead of reference")
_COMPARED = ("return>", "95 % interval>", *_GAP)
_PAPER_SIDE = ("paper>", "ours or paper ahead")
_MARKUP = re.compile(r"[\\`*<|]|\](?=\()")


def markdown_text(text: str) -> str:
    """Return a text that Markdown shows as it is, in a cell of a table too."""
    return _MARKUP.sub(r"\\\g<0>", " ".join(text.splitlines()))


def markdown_rows(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table of texts in Markdown; a heading that ends in ">" is aligned to the right."""
    names = [heading.removesuffix(">") for heading in headings]
    rule = ["---:" if heading.endswith(">") else "---" for heading in headings]
    first, *others = ([markdown_text(cell) for cell in row] for row in (names, *rows))
    return [f"| {' | '.join(cells)} |" for cells in (first, rule, *others)]


@dataclass(frozen=True)
class Table:
    """A table before it is drawn.

    Attributes:
        title: one line above.
        headings: of the columns; one that ends in ">" is aligned to the right.
        rows: texts.
        caption: one line below.
    """

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""

    def markdown(self) -> str:
        """Return the table as Markdown, without its title."""
        lines = markdown_rows(self.headings, self.rows)
        return "\n".join([*lines, *(["", markdown_text(self.caption)] if self.caption else [])])


def returns_table(results: Results, whole: bool = False) -> Table:
    """Return the study in its own layout, ours above the paper's.

    Args:
        results: of the study.
        whole: with all that the paper's table has; what we did not run is marked so.
    """
    cells = {(cell.panel, cell.variant): cell for cell in results.cells}
    most = max(len(cell.seeds) for cell in results.cells)
    entries = {place: _short(results, cell) + _fewer_seeds(cell, most) for place, cell in cells.items()}
    theirs = {place: cell.paper for place, cell in cells.items() if cell.paper}
    if whole:
        listed = {(panel, variant): paper.reported(key) for panel, variant, key in paper_cells(results.kind)}
        entries = dict.fromkeys(listed, NOT_RUN) | entries
        theirs = {place: (n.mean, n.sem) for place, n in listed.items() if n is not None} | theirs
    panels = list(dict.fromkeys(panel for panel, _ in entries))
    variants = list(dict.fromkeys(variant for _, variant in entries))
    by_panel = results.rows == "panels"
    rows, columns = (panels, variants) if by_panel else (variants, panels)
    lines: list[tuple[str, ...]] = []
    for row in rows:
        places = [(row, column) if by_panel else (column, row) for column in columns]
        lines.append((row, *(["ours"] if theirs else []), *(entries.get(place, NOTHING) for place in places)))
        if any(place in theirs for place in places):
            numbers = [theirs.get(place) for place in places]
            lines.append(("", "paper", *(format_mean(*number) if number else NOTHING for number in numbers)))
    headings = ("", *([""] if theirs else []), *(f"{column}>" for column in columns))
    return Table(results.title, headings, tuple(lines), _caption(results))


def comparison_table(results: Results) -> Table:
    """Return each cell beside its reference and the paper's number: intervals, and who is ahead."""
    rows, by_seed = [], True
    has_paper = any(cell.paper for cell in results.cells)
    columns = _COMPARED + (_PAPER_SIDE if has_paper else ())
    columns = ("trained to>", *columns) if any(cell.at is not None for cell in results.cells) else columns
    for cell in results.cells:
        found = summarise_cell(results, cell)
        texts = {"trained to>": format_count(cell.step), "return>": _short(results, cell)}
        if found is not None and found.returns.mean is not None:
            texts |= _compared(cell, found)
            by_seed &= found.gap is None or found.gap.paired
        rows.append((cell.panel, cell.variant, *(texts.get(heading, NOTHING) for heading in columns)))
    welch = "Ours and the paper's means are compared by Welch's test at 5 %. " if has_paper else ""
    drawn = "Returns are those of drawn actions. " if results.mode == "stochastic" else ""
    caption = (
        f"The reference is {_reference(results)}, compared seed by seed"
        f"{'' if by_seed else ' where both have the same seeds'}; over all pairs: "
        f"every seed with every seed. Ahead: the 95 % interval of the difference lies above 0. {welch}{drawn}"
        "No interval is widened for the number of comparisons."
    )
    title = f"Beside the reference{' and the paper' if has_paper else ''}"
    return Table(title, ("panel", "run", *columns), tuple(rows), caption)


def statistics_table(results: Results) -> Table:
    """Return what else can be said of each cell: robust mean, scale, and how fast it learned."""
    rows = []
    for cell in results.cells:
        found = summarise_cell(results, cell)
        if found is None or found.returns.mean is None:
            continue
        seeds = sum(x is not None for x in found.returns.per_seed)
        duration = NOTHING if cell.seconds is None else format_duration(cell.seconds)
        texts = (_estimate(found.iqm), _mean_of(found.normalised), _mean_of(found.area))
        rows.append((cell.panel, cell.variant, str(seeds), *texts, duration))
    caption = (
        "IQM: mean without the lowest and the highest quarter of the seeds, rounded down. Normalised: 0 is the random "
        "policy, 1 the best heuristic. Mean over the run: area under the curve."
    )
    headings = ("panel", "run", "seeds>", "IQM>", "normalised>", "mean over the run>", "training>")
    return Table("Seeds and scale", headings, tuple(rows), caption)


def steps_table(results: Results) -> Table | None:
    """Return when each cell first reaches a return, by default what its reference ended with; None where none does."""
    rows = []
    runs = {(cell.variant, cell.panel if cell.at is None else None): cell for cell in results.cells}
    for cell in runs.values():  # of runs compared at several steps the last
        run = results.reference_of(cell) or cell
        for passing in cell.steps_to:
            mean = math.inf if passing.of_mean is None else passing.of_mean
            median, interval = median_steps(passing.per_seed)
            reached = (_within(mean, cell.step), _within(median, cell.step))
            span = f"[{', '.join(_within(end, cell.step) for end in interval)}]" if interval else NOTHING
            its = [median_steps(p.per_seed)[0] for p in run.steps_to if p.threshold == passing.threshold]
            shares = (_share(median, run.step), _share(median, its[0]) if its and run is not cell else "")
            rows.append((cell.panel, cell.variant, f"{passing.threshold:.2f}", *reached, span, *shares))
    caption = (
        "Environment steps to what the reference ended with, or to a return that was asked for. Curves are of the "
        f"evaluations on the way{_on_the_way(results)}; a run may stay below what it has in its final evaluation on "
        "new episodes. Mean: of the mean curve. The interval is that of the median; its ends are seeds, of ten the "
        "second and the ninth. Of the run, of its steps: the median seed's steps as a share of the reference's whole "
        "run, and of the steps of the reference's own median seed."
    )
    headings = ("panel", "run", "return>", "mean>", "median seed>", "95 % interval>", "of the run>", "of its steps>")
    return Table("Steps to a return", headings, tuple(rows), caption) if rows else None


def networks_table(results: Results) -> Table | None:
    """Return the sizes of the networks, or None where no cell states them."""
    rows = tuple(
        (cell.panel, cell.variant, format_count(cell.parameters["policy"]), format_count(cell.flops_per_action))
        for cell in results.cells
        if cell.parameters and cell.flops_per_action is not None
    )
    caption = "Weights of the policy of one seed, and operations of its matrix products for one agent's action."
    return Table("Networks", ("panel", "run", "weights>", "FLOPs an action>"), rows, caption) if rows else None


def aggregates_table(results: Results) -> Table | None:
    """Return the numbers over all panels, or None where no variant is finished in two."""
    rows = tuple(
        (variant, _estimate(found.iqm), _estimate(found.mean), _estimate(found.improvement))
        for variant, found in aggregates(results).items()
    )
    caption = "Of normalised returns over all panels; 95 % intervals by a bootstrap that is stratified by panel."
    headings = ("run", "IQM>", "mean>", "P(improvement over the reference)>")
    return Table("Over all panels", headings, rows, caption) if rows else None


def breaking_table(results: Results) -> Table | None:
    """Return the returns over the strength of breaking, or None of a study that breaks nothing."""
    rows = []
    for one in series_of(results):
        for strength, cells in one.cells.items():
            for method, cell in cells.items():
                beside = [
                    _AHEAD[side(results, cell, cells.get(name))] if method != name else "" for name in (PLAIN, ESP)
                ]
                short = _return_at(results, cell, early=True)
                rows.append((one.name, f"{one.setting} {strength:g}", method, short, _short(results, cell), *beside))
    caption = (
        f"Mean ± standard error over seeds at the evaluation nearest to a fifth of the run{_on_the_way(results)} and "
        "at its end; ahead: at its end, by intervals."
    )
    headings = ("run", "breaking", "method", "at 20 %>", "at 100 %>", "ahead of plain", "ahead of ESP")
    return Table("Returns over the strength of breaking", headings, tuple(rows), caption) if rows else None


def methods_table(results: Results, early: bool = False) -> Table | None:
    """Return the returns with one column for each method, or None of a study that breaks nothing."""
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
        texts = {method: _return_at(results, cell, early) for method, cell in cells.items()}
        label = breaking if shared else f"{name}, {breaking}"
        rows.append((label, *(f"{texts.get(one, NOTHING)}{' (*)' if one in best else ''}" for one in methods)))
    when = "at the evaluation nearest to a fifth of the run" if early else "at the end of the run"
    episodes = _on_the_way(results) if early else ""
    compared = "(*): the highest of its row, or not told apart from it"
    caption = f"Mean ± standard error over seeds {when}{episodes}; {compared}."
    headings = (shared or "run", *(f"{method}>" for method in methods))
    return Table(f"Returns {when}", headings, tuple(rows), caption) if rows else None


def verdicts_table(results: Results) -> Table | None:
    """Return for each method whether it could be the default, or None of a study that breaks nothing."""
    said = {True: "yes", False: "no", None: NOTHING}
    rows = tuple((v.method, said[v.unbroken], said[v.largest], said[v.between]) for v in verdicts(results))
    caption = (
        "Where nothing is broken, a default is at most one standard error (the larger of the two) behind ESP. At the "
        "largest strength it is not behind the plain learner. In between it is ahead of both or level with them. All "
        f"holds in every task. {NOTHING}: runs are missing."
    )
    headings = ("method", "not behind ESP unbroken", "not behind plain at the largest", "ahead or level in between")
    return Table("Could it be the default?", headings, rows, caption) if rows else None


def times_table(results: Results) -> Table:
    """Return what was run, by which version, and how long it took."""
    # each run once: a report may look at several of its steps, and it may not have reached the last of them
    ordered = sorted(results.cells, key=lambda cell: cell.status == "finished")
    runs = {(cell.variant, str(cell.config)): cell for cell in ordered}.values()
    total = sum(run.seconds or 0.0 for run in runs)
    trained_by = {run.esp_version for run in runs if run.seconds is not None and run.esp_version}
    versions = sorted(trained_by) or [results.esp_version]
    rows = (
        ("command", "; ".join(results.command.splitlines())),
        ("version of esp", ", ".join(versions)),
        ("runs finished", f"{sum(run.status == 'finished' for run in runs)} of {len(runs)}"),
        ("training", f"{format_duration(total)}, all runs added up"),
    )
    return Table("Provenance", ("", ""), rows)


TABLES: dict[str, Callable[[Results], Table | None]] = {
    "returns": returns_table,
    "paper": lambda results: returns_table(results, whole=True),
    "comparison": comparison_table,
    "statistics": statistics_table,
    "steps": steps_table,
    "networks": networks_table,
    "breaking": breaking_table,
    "methods": methods_table,
    "methods-early": lambda results: methods_table(results, early=True),
    "verdicts": verdicts_table,
    "aggregates": aggregates_table,
    "provenance": times_table,
}
"""By the name that a page asks for."""
_AGAIN = {"paper", "methods", "methods-early"}
"""Those that say what another one says, in the layout of a page."""


def all_tables(results: Results) -> list[Table]:
    """Return every table that has something to say, each once."""
    made = [make(results) for name, make in TABLES.items() if name not in _AGAIN]
    return [table for table in made if table is not None and table.rows]


def _compared(cell: CellResult, found: CellSummary) -> dict[str, str]:
    """Return the texts of a finished cell by heading."""
    returns, gap = found.returns, found.gap
    texts = {"return>": _mean_of(returns), "95 % interval>": format_interval(returns.ci95)}
    if cell.reference is None:
        texts |= dict.fromkeys(_GAP, "")
    elif gap is not None:
        change = f"{gap.difference.value:+.2f} {format_interval(gap.difference.ci95)}"
        said = (change, _estimate(gap.probability), _estimate(gap.over_all_pairs), _AHEAD[gap.ahead])
        texts |= dict(zip(_GAP, said, strict=True))
    if cell.paper:
        texts |= {"paper>": format_mean(*cell.paper), "ours or paper ahead": _LEADER[found.leader]}
    return texts


def _short(results: Results, cell: CellResult) -> str:
    """Return the number of a cell, or how far it is."""
    found = summarise_cell(results, cell)
    if found is not None:
        return _mean_of(found.returns) if found.returns.mean is not None else _STOPPED
    return NOT_RUN if cell.status == "not run" else f"at {format_count(cell.step)}"


def _fewer_seeds(cell: CellResult, most: int) -> str:
    """Say how many seeds a finished cell has where others have more."""
    count = len(cell.seeds)
    return f" (n = {count})" if count < most and cell.status == "finished" else ""


def _caption(results: Results) -> str:
    conventions = list(dict.fromkeys(cell.convention for cell in results.cells if cell.convention is not None))
    seeds = format_span({len(cell.seeds) for cell in results.cells})
    episodes = format_span({cell.episodes or results.episodes for cell in results.cells})
    said = f" Convention of the returns: {'; '.join(conventions)}." if conventions else ""
    return f"Mean ± standard error over {seeds} seeds of the {results.mode} return, {episodes} episodes a seed.{said}"


def _reference(results: Results) -> str:
    """Say what runs are compared with."""
    kind = kind_of(results.kind)
    firsts = [results.config | cell.config for cell in results.cells if cell.reference is None]
    return kind.reference if all(map(_is_plain, firsts)) else kind.otherwise


def _is_plain(config: Mapping[str, JsonValue]) -> bool:
    """Return whether a run, by its settings with dotted names, has no symmetry in its prior or its network."""
    symmetric = config.get("network.name") in ("equivariant", "empn") or config.get("network.symmetrise")
    return config.get("prior.kind") == "none" and not symmetric


def _on_the_way(results: Results) -> str:
    """Say how many episodes the evaluations of the curves have: " (32 episodes a seed)"."""
    counts = {(results.config | cell.config).get("evaluation.episodes") for cell in results.cells}
    known = {count for count in counts if isinstance(count, int)}
    return f" ({format_span(known)} episodes a seed)" if known else ""


def _share(steps: float, of: float) -> str:
    """Return steps as a share of others, a dash where either never came."""
    return f"{steps / of:.2f}" if math.isfinite(steps) and math.isfinite(of) and of else NOTHING


def _within(steps: float, run: int) -> str:
    """Return a number of steps, or that it is more than a run took."""
    return format_count(steps) if math.isfinite(steps) else f"> {format_count(run)}"


def _mean_of(summary: SeedSummary | None) -> str:
    """Return mean and standard error, and how many seeds stopped and are not in them."""
    if summary is None or summary.mean is None:
        return NOTHING
    stopped = summary.per_seed.count(None)
    return format_mean(summary.mean, summary.sem) + (f" ({stopped} stopped)" if stopped else "")


def _return_at(results: Results, cell: CellResult, early: bool) -> str:
    values = at(results, cell, early)
    return NOTHING if values is None else _mean_of(summarise(values))


def _estimate(found: Estimate | None) -> str:
    if found is None:
        return NOTHING
    return f"{found.value:.2f}" + (f" {format_interval(found.ci95)}" if found.ci95 else "")
