"""`esp report`: a study or runs side by side, as tables, a page, pictures and JSON."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from esp_cli import console
from esp_cli.commands.counts import parse_count
from esp_cli.commands.options import (
    JsonOption,
    OwnAlgoOption,
    OwnNetworkOption,
    OwnTaskOption,
    check_finite,
    not_over_a_run,
    register_named,
)
from esp_cli.defaults import Mode
from esp_envs.errors import UserError

if TYPE_CHECKING:
    from esp_cli.reporting.collect import Material
    from esp_cli.reporting.results import Results

EPILOG = """Examples:\n
    esp report runs/table1\n
    esp report runs/table1 --films --results docs/measured/table1.json\n
    esp report runs/cn-mappo runs/cn-mappo-esp\n
    esp report plain=runs/cn-mappo ESP=runs/cn-mappo-esp --at 500k --at 3M --threshold -125 --plot curves.png\n
    esp report plain=runs/cn-mappo ESP=runs/cn-mappo-esp --out comparison"""

RunsArgument = Annotated[
    list[str] | None,
    typer.Argument(help="One study folder, or run folders, each as PATH or LABEL=PATH.", metavar="STUDY|RUN..."),
]
OutOption = Annotated[
    Path | None,
    typer.Option("--out", "-o", help="Folder of the page and its pictures; of a study by default STUDY/report."),
]
ResultsOption = Annotated[
    Path | None,
    typer.Option(
        "--results",
        help="Also write every seed's numbers and the configurations as JSON.",
        metavar="FILE",
        callback=not_over_a_run,
    ),
]
FillOption = Annotated[
    Path | None,
    typer.Option("--fill", help="Compute the tables of this Markdown page from its results files.", metavar="PAGE"),
]
AtOption = Annotated[
    list[str] | None,
    typer.Option("--at", help="Runs: compare at this step; by default the last that all reached.", metavar="STEPS"),
]
ReferenceOption = Annotated[
    list[str] | None,
    typer.Option("--reference", help="Runs: draw a line at a published number.", metavar="NAME=VALUE"),
]
ThresholdOption = Annotated[
    list[float] | None, typer.Option("--threshold", help="State when this return is first reached.")
]
ModeOption = Annotated[
    Mode | None, typer.Option("--mode", help="Which evaluations; greedy, unless the study is about others.")
]
LimitsOption = Annotated[
    tuple[float, float] | None,
    typer.Option("--y-limits", help="Runs: lowest and highest return in the picture.", metavar="LOW HIGH"),
]
CsvOption = Annotated[
    Path | None,
    typer.Option(
        "--csv",
        help="Write every logged number of every seed as a table.",
        metavar="FILE",
        callback=not_over_a_run,
    ),
]
PlotOption = Annotated[Path | None, typer.Option("--plot", help="Draw the curves as PNG and SVG.", metavar="FILE")]


def report(
    runs: RunsArgument = None,
    out: OutOption = None,
    films: Annotated[bool, typer.Option("--films", help="Draw the trained policies for the page.")] = False,
    results: ResultsOption = None,
    fill: FillOption = None,
    at: AtOption = None,
    threshold: ThresholdOption = None,
    reference: ReferenceOption = None,
    mode: ModeOption = None,
    y_limits: LimitsOption = None,
    plot: PlotOption = None,
    csv: CsvOption = None,
    task: OwnTaskOption = None,
    algo: OwnAlgoOption = None,
    network: OwnNetworkOption = None,
    json: JsonOption = None,
) -> None:
    """Tabulate a study or compare runs of one task: intervals, differences, steps to thresholds; curves and a page."""
    from esp_cli.reporting import collect, curves, loose
    from esp_cli.reporting.csv_file import write_csv
    from esp_cli.studies.study import StudyFolder
    from esp_cli.studies.tuning import TUNING_FORMAT
    from esp_cli.training.folder_names import FRESH, TUNING

    register_named(task, algo, network)
    of_the_picture = reference or y_limits
    of_runs = any((out, films, results, at, threshold, of_the_picture, mode, plot, csv, json))
    if not runs and (of_runs or fill is None):
        raise UserError("there is nothing to report; name a study folder or run folders")
    if fill is not None:
        _fill(fill)
    if not runs:
        return
    limits, lines = threshold or [], _references(reference or [])
    check_finite("--threshold", *limits)
    _check_limits(y_limits)
    if TUNING_FORMAT.is_one(Path(runs[0]) / TUNING):  # the report of a tuning has a file of this name too
        fresh = shlex.quote(str(Path(runs[0]) / FRESH))
        raise UserError(f"{runs[0]} is a tuning with a report of its own; report its study by: esp report {fresh}")
    is_study = StudyFolder.is_one(Path(runs[0]))
    if is_study:
        if len(runs) > 1 or at or reference or plot or y_limits:
            raise UserError(
                "a study is reported by itself: leave out the other runs, --at, --reference, --plot, --y-limits"
            )
        out = out or Path(runs[0]) / "report"
        material = collect.collect(StudyFolder.open(Path(runs[0])), mode, limits)
        document, folders = material.results.document(), material.runs
    else:
        _refuse_idle(films and out is None, plot is None and bool(of_the_picture))
        steps, asked = [parse_count(text) for text in at or []], mode or "greedy"
        places = [_labelled(text) for text in runs]
        found = [curves.read_curve(path, label, asked) for label, path in places]
        first, *others = (curve.config for curve in found)
        command = _command(runs, at or [], limits, mode, out, first.own_words(*others))
        folders = {curve.label: path for curve, (_, path) in zip(found, places, strict=True)}
        material = loose.put_together(found, [path for _, path in places], command, asked, steps, limits)
        document = loose.comparison(material, limits)

    def show() -> None:
        with console.paged():
            print_tables(material.results)

    console.result(json, document, show)
    if csv is not None:
        console.note(f"{write_csv(csv, folders)} rows -> {csv}")
    if plot is not None:
        for file in loose.plot(material, plot, lines, y_limits):
            console.note(f"curves -> {file}")
    _write(material, out, films, results)


def _refuse_idle(films: bool, of_the_picture: bool) -> None:
    """Refuse options of what is not written.

    Raises:
        UserError: films without a page, or lines and limits without a picture.
    """
    if films:
        raise UserError("--films draws for the page that --out writes; add --out FOLDER, or leave it out")
    if of_the_picture:
        raise UserError("--reference and --y-limits are of the picture that --plot draws; add --plot FILE")


def _check_limits(limits: tuple[float, float] | None) -> None:
    """Refuse limits of the picture that leave nothing to see."""
    check_finite("--y-limits", *(limits or ()))
    if limits is not None and limits[0] >= limits[1]:
        raise UserError(f"--y-limits {limits[0]:g} {limits[1]:g} is empty; write the lowest return before the highest")


def threshold_words(thresholds: Sequence[float]) -> list[str]:
    """Return the words of the command line that name these thresholds."""
    return [word for limit in thresholds for word in ("--threshold", repr(limit).removesuffix(".0"))]


def _command(
    runs: Sequence[str],
    at: Sequence[str],
    thresholds: Sequence[float],
    mode: str | None,
    out: Path | None,
    own: Sequence[str],
) -> str:
    """Return the command line that gives the same report of the same runs."""
    words = ["esp", "report", *runs, *own, *(word for text in at for word in ("--at", text))]
    words += threshold_words(thresholds)
    words += ["--mode", mode] if mode else []
    return shlex.join(words + (["--out", str(out)] if out else []))


def _write(material: Material, out: Path | None, films: bool, small: Path | None) -> None:
    """Write what was asked for beside the tables."""
    from esp_cli.reporting.page import draw_films, write_report

    if films:
        with console.TrainingProgress(len(material.runs), description="draw") as progress:
            draw_films(material.runs, progress.update)
    if out is not None and material.curves:
        for file in write_report(material, out):
            console.note(f"report -> {file}")
    elif out is not None:
        console.note("no run has an evaluation yet, so there is nothing to draw")
    if small is not None:
        console.write_json(small, material.results.document())
        console.note(f"results -> {small}")


def _fill(page: Path) -> None:
    from esp_cli.files.writing import write_file
    from esp_cli.reporting.pages import filled

    write_file(page, filled(page).encode())
    console.note(f"tables -> {page}")


def print_tables(results: Results) -> None:
    """Print every table of a study's results."""
    from esp_cli.reporting.tables import all_tables

    for table in all_tables(results):
        console.table(table.headings, table.rows, title=table.title, caption=table.caption)


def _labelled(text: str) -> tuple[str | None, Path]:
    """Split LABEL=PATH; either may itself have a "=", so the longest path that exists is taken."""
    splits = [(text[:k], Path(text[k + 1 :])) for k, character in enumerate(text) if character == "="]
    if Path(text).exists() or not splits:
        return None, Path(text)
    return next((split for split in splits if split[1].exists()), splits[-1])


def _references(items: Sequence[str]) -> dict[str, float]:
    out = {}
    for item in items:
        name, _, value = item.rpartition("=")
        try:
            out[name] = float(value)
        except ValueError:
            name = ""
        if not name or not math.isfinite(out[name]):
            raise UserError(f"--reference {item} is no line to draw; write --reference NAME=VALUE")
    return out
