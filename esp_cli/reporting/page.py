"""What a report writes: Markdown with pictures, and one page that needs nothing but a browser."""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jinja2 import Environment, FileSystemLoader, Template

from esp_cli.defaults import __version__
from esp_cli.drawing.draw import Request, draw
from esp_cli.files.documents import encode
from esp_cli.files.formatting import escaped, format_count, format_interval, format_mean, format_p, markdown_text
from esp_cli.files.opening import read_regular
from esp_cli.files.writing import replace_file
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.policies.statistics import CONFIDENCE, steps_to_threshold
from esp_cli.reporting.collect import Material
from esp_cli.reporting.figures import Style
from esp_cli.reporting.results import RESULTS_FORMAT, CellResult, Results, Side
from esp_cli.reporting.study_figures import draw_curves, draw_variants
from esp_cli.reporting.tables import NOT_RUN, all_tables
from esp_cli.studies.kinds import kind_of
from esp_cli.training.folder_names import POLICY
from esp_envs.errors import UserError

PAGE, MARKDOWN, RESULTS, FILM = "report.html", "report.md", "results.json", "film.gif"
CURVES = "curves"
_TEMPLATES = Path(__file__).with_name("templates")
_FILM_PIXELS, _FILM_FRAMES_PER_SECOND = 240, 12.0
_FILM_SECONDS = 15.0  # a film is sped up to last no longer
_MAX_FILM_BYTES = 2**26


def write_report(material: Material, out: Path, style: Style = "screen") -> list[Path]:
    """Write a report into a folder; return its files: page, Markdown, pictures and results."""
    if not material.curves:
        raise UserError("no run of this study has an evaluation yet; run it first, or wait a little")
    # Names in this folder are the program's own: links there are replaced, where drawing would follow them.
    with TemporaryDirectory() as scratch:
        pictures = [draw_curves(material, Path(scratch) / CURVES, style)]
        pictures += draw_variants(material.results, Path(scratch), style)
        images = [(png.stem, data_uri(png.with_suffix(".svg").read_bytes(), "image/svg+xml")) for png in pictures]
        drawn = sorted(Path(scratch).iterdir())
        _refuse_foreign(out, [MARKDOWN, RESULTS, PAGE, *(file.name for file in drawn)])
        out.mkdir(parents=True, exist_ok=True)
        for file in drawn:
            replace_file(out / file.name, file.read_bytes())
    tables, study = all_tables(material.results), material.study
    named = {material.runs[cell.name]: (f"{cell.panel}: {cell.variant}", cell.config) for cell in study.cells}
    runs = [
        {"name": name, "command": config.command(), "config": json.dumps(config.model_dump(mode="json"), indent=1)}
        for name, config in named.values()
    ]
    films = [(name, data_uri(film, "image/gif")) for run, (name, _) in named.items() if (film := _film(run / FILM))]
    content = {
        "title": study.title,
        "version": __version__,
        "command": study.command,
        "answer": answer(material),
        "tables": tables,
        "images": images,
        "films": films,
        "runs": runs,
    }
    markdown = [f"# {markdown_text(study.title)}", _fenced(study.command)]
    markdown += [f"## {markdown_text(table.title)}\n\n{table.markdown()}" for table in tables]
    markdown += [f"![{png.stem}]({png.name})" for png in pictures]
    markdown += ["## Each run by itself", _fenced("\n".join(run["command"] for run in runs))]
    files = {
        PAGE: escaped(template("report.html").render(content)).encode(),
        MARKDOWN: (escaped("\n\n".join(markdown)) + "\n").encode(),
        RESULTS: encode(material.results.document(), out / RESULTS),
    }
    for name, text in files.items():
        replace_file(out / name, text)
    return [out / name for name in (PAGE, MARKDOWN, *(png.name for png in pictures), RESULTS)]


def draw_films(runs: Mapping[str, Path], watch: Callable[[int], None]) -> list[Path]:
    """Draw the policy of each trained run that has no film yet, into its folder; tell `watch` how many are done.

    Return the runs that have none, since their task does not say how it looks.
    """
    unseen = []
    for count, run in enumerate(runs.values(), start=1):
        if (run / POLICY).is_file() and not _film(run / FILM):
            trained = TrainedPolicy.read(run / POLICY)
            if trained.worlds(1, "film").has("scene"):
                replace_file(run / FILM, draw_film(trained, _FILM_PIXELS))
            else:
                unseen.append(run)
        watch(count)
    return unseen


def draw_film(trained: TrainedPolicy, size: int, episodes: int | None = None) -> bytes:
    """Draw a GIF of a policy for a page, so many pixels large; an episode takes no longer than a page's film may."""
    speed = max(1.0, trained.spec.horizon * trained.spec.control_period_s / _FILM_SECONDS)
    with TemporaryDirectory() as scratch:
        film = Path(scratch) / FILM
        request = Request(film, episodes=episodes, view="top", size=size, speed=speed, fps=_FILM_FRAMES_PER_SECOND)
        draw(request, [trained])
        return film.read_bytes()


def template(name: str) -> Template:
    """Return a page's template, which escapes what it is given."""
    folder = FileSystemLoader(_TEMPLATES)
    return Environment(loader=folder, autoescape=True, trim_blocks=True, lstrip_blocks=True).get_template(name)


def _refuse_foreign(out: Path, names: Sequence[str]) -> None:
    """Refuse a folder whose files of these names are not of a report."""
    foreign = next((out / name for name in names if os.path.lexists(out / name)), None)
    if foreign is not None and not RESULTS_FORMAT.is_one(out / RESULTS):
        raise UserError(f"{foreign} is not of a report by esp; move it away, or write the report to another folder")


def _film(path: Path) -> bytes:
    """Return a film that was drawn before; empty where there is none. A link is not followed."""
    with contextlib.suppress(OSError):
        if not path.is_symlink() and (content := read_regular(path, _MAX_FILM_BYTES) or b"").startswith(b"GIF8"):
            return content
    return b""


def data_uri(content: bytes, kind: str) -> str:
    """Return content of a MIME type as an address that a page needs no file for."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _fenced(command: str) -> str:
    """Return a block of shell commands, in a fence that is longer than any row of backticks in it."""
    fence = "`" * max(3, *(len(row) + 1 for row in re.findall("`+", command)), 0)
    return f"{fence}sh\n{command}\n{fence}"


_VERDICTS: dict[Side, str] = {
    "ahead": "is better than",
    "behind": "is worse than",
    "level": "is not told apart from",
    "blind": "is below a policy that sees nothing, as is",
}
_FEW = "Fewer than three seeds tell nothing for sure."
_SCALE = "where 0 is the random policy and 1 the best hand-written one"


def answer(material: Material, thresholds: Sequence[float] = ()) -> list[str]:
    """Return the answer: of one run beside its reference in full, of several how many are ahead; then thresholds."""
    return _outcome(material) + [_reached(material.results, limit) for limit in dict.fromkeys(thresholds)]


def _outcome(material: Material) -> list[str]:
    results = material.results
    finished = [cell for cell in results.cells if cell.summary is not None and cell.summary.returns.mean is not None]
    pairs = [(cell, other) for cell in finished if (other := results.reference_of(cell)) is not None]
    pairs = [(cell, other) for cell, other in pairs if other in finished]
    stopped = [f"{c.variant}, {c.panel}" for c in results.cells if c.has_stopped]
    left_out = [f"Not compared, since a seed stopped: {'; '.join(stopped)}."] if stopped else []
    if len(pairs) == 1 and len(finished) == len(results.cells):
        both = pairs[0]
        return [_returns(results, *both), _verdict(*both), *_too_few(pairs), *_steps(material, *both)]
    if pairs and kind_of(results.kind).benchmark:
        ranked = [_ranking(panel, results) for panel in dict.fromkeys(cell.panel for cell, _ in pairs)]
        return [*ranked, *_too_few(pairs), *left_out]
    texts = _count(pairs) if pairs else _uncompared(results, finished)
    return [*texts, *left_out] or ["No run has a return yet."]


def _uncompared(results: Results, finished: Sequence[CellResult]) -> list[str]:
    """State the returns of runs of which none has its reference beside it."""
    more = [f"The table has {len(finished) - 2} more."] if len(finished) > 2 else []
    alone = ["Nothing is compared: the reference of no run has a return here."]
    return [_returns(results, cell) for cell in finished[:2]] + more + alone * any(c.reference for c in finished)


def _ranking(panel: str, results: Results) -> str:
    """State which method of a panel is highest, and which are ahead of the reference or behind it."""
    own = [cell for cell in results.cells if cell.panel == panel and not cell.has_stopped]
    cells = [(cell, cell.summary) for cell in own if cell.summary is not None]
    missing = ", ".join(cell.variant for cell in own if cell.summary is None)
    if not cells:
        return f"{panel}: a seed of every method stopped, so none is ranked."
    iqm, best = max((summary.iqm.value, cell.variant) for cell, summary in cells if summary.iqm)
    sides = {side: [c.variant for c, s in cells if s.gap is not None and s.gap.ahead == side] for side in _VERDICTS}
    first = next(cell.variant for cell in results.cells if cell.panel == panel and cell.reference is None)
    counts = "; ".join(f"{_VERDICTS[side][3:]} {first}: {', '.join(names)}" for side, names in sides.items() if names)
    counts = f"{counts or 'nothing is compared'}{missing and f'; not finished: {missing}'}"
    return f"{panel}: {best} has the highest IQM, {iqm:.2f}; after Holm's correction, {counts}."


def _returns(results: Results, *cells: CellResult) -> str:
    summaries = [cell.summary for cell in cells if cell.summary is not None]
    means = [format_mean(one.returns.mean, one.returns.sem) for one in summaries]
    ours = [f"{cell.variant} has {mean}" for cell, mean in zip(cells, means, strict=True)]
    scores = [f"{one.normalised.mean:.2f}" for one in summaries if one.normalised is not None]
    normalised = f"; normalised {' and '.join(scores)}, {_SCALE}" if scores else ""
    counts = [sum(x is not None for x in cell.returns[results.mode]) for cell in cells]
    seeds = f"{' and '.join(map(str, dict.fromkeys(counts)))} seed{'s' if max(counts) > 1 else ''}"
    what = f"{results.mode} return, {seeds}{normalised}"
    return f"{cells[0].panel}: {' and '.join(ours)} ({what})."


def _verdict(cell: CellResult, other: CellResult) -> str:
    gap = None if cell.summary is None else cell.summary.gap
    if gap is None:
        stopped = [one.variant for one in (cell, other) if one.has_stopped]
        seeds = f"a seed of {' and of '.join(stopped)} stopped"
        return f"There is no interval of the difference: {seeds}, and the others are no fair sample."
    interval = f"95 % interval {format_interval(gap.difference.ci95)}"
    if gap.ahead is None:
        differ = f"{cell.variant} and {other.variant} differ by {gap.difference.value:+.2f}"
        if gap.over_all_pairs is not None:
            return f"{differ} with every seed."
        return f"{differ}{f', {interval}' if gap.difference.ci95 else ''}. {_FEW}"
    by = interval if gap.holm is None else f"p {format_p(gap.holm)} by the rank-sum test"
    return (
        f"{cell.variant} {_VERDICTS[gap.ahead]} {other.variant}: the difference is {gap.difference.value:+.2f}, {by}."
    )


def _too_few(pairs: Sequence[tuple[CellResult, CellResult]]) -> list[str]:
    """Say where the seeds are so few that the rank-sum test tells nothing apart, however large a difference is."""
    tested = [pair for pair in pairs if (summary := pair[0].summary) and summary.gap and summary.gap.holm is not None]
    few = dict[tuple[int, int], list[str]]()  # panels by the seeds that they have and need
    for panel, comparisons in Counter(cell.panel for cell, _ in tested).items():
        sizes = [[len(one.seeds) for one in pair] for pair in tested if pair[0].panel == panel]
        enough = next(n for n in itertools.count() if comparisons * 2 / math.comb(2 * n, n) <= 1 - CONFIDENCE)
        if all(comparisons * 2 / math.comb(sum(both), both[0]) > 1 - CONFIDENCE for both in sizes):
            few.setdefault((min(map(min, sizes)), enough), []).append(panel)
    return [
        f"With {seeds} seeds the rank-sum test can tell nothing apart on {'; '.join(panels)}; take {enough} or more."
        for (seeds, enough), panels in few.items()
    ]


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


def _reached(results: Results, threshold: float) -> str:
    """State when the mean curve of each run first has a return."""
    firsts = {}
    several = results.kind != "runs" and len({cell.panel for cell in results.cells}) > 1
    for cell in results.cells:
        of_mean = next((p.of_mean for p in cell.steps_to if math.isclose(p.threshold, threshold, abs_tol=1e-4)), None)
        name = f"{cell.variant} ({cell.panel})" if several else cell.variant
        if of_mean is not None:
            when = f"after {format_count(of_mean)} steps"
        elif cell.has_stopped:
            when = "at no step that is known, since a seed stopped"
        elif cell.status == "finished" and (cell.at is None or cell.step >= cell.steps):
            when = "never"
        else:
            when = f"not up to {format_count(cell.step)} steps" if cell.step else NOT_RUN
        firsts[name] = when
    return f"The mean over seeds first has {threshold:g}: {', '.join(map(' '.join, firsts.items()))}."


def _count(pairs: list[tuple[CellResult, CellResult]]) -> list[str]:
    gaps = [(cell, cell.summary.gap) for cell, _ in pairs if cell.summary is not None and cell.summary.gap is not None]
    if not gaps:
        return []
    sides = Counter(gap.ahead for _, gap in gaps if gap.over_all_pairs is not None)
    counts = f"better {sides['ahead']}, not told apart {sides['level']}, worse {sides['behind']}"
    counts += f", both below a policy that sees nothing {sides['blind']}" if sides["blind"] else ""
    counts += f", by the same with every seed {sides[None]}" if sides[None] else ""
    number = sides.total()
    told = f"Of {number} run{'s'[: number - 1]} beside their reference: {counts} (95 % intervals of the difference)."
    ordered = sorted(gaps, key=lambda pair: pair[1].difference.value)
    largest, smallest = (
        f"{gap.difference.value:+.2f} {format_interval(gap.difference.ci95) if gap.difference.ci95 else ''}".rstrip()
        + f" ({cell.variant}; {cell.panel})"
        for cell, gap in (ordered[-1], ordered[0])
    )
    return [told if number else _FEW, f"The largest difference is {largest}, the smallest {smallest}."]
