"""`esp report`: a study or runs side by side, as tables, a page, pictures and JSON."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from typer import Argument, Option

from esp_cli import console
from esp_cli.commands import options
from esp_cli.commands.counts import parse_count
from esp_cli.defaults import Mode
from esp_cli.training.folder_names import FRESH
from esp_envs.errors import UserError

if TYPE_CHECKING:
    from esp_cli.reporting.collect import Material

EPILOG = """Examples:\n
    esp report runs/table1\n
    esp report runs/table1 --films --results docs/measured/table1.json\n
    esp report runs/cn-mappo runs/cn-mappo-esp\n
    esp report plain=runs/cn-mappo ESP=runs/cn-mappo-esp --at 500k --at 3M --threshold -125 --plot curves.png\n
    esp report plain=runs/cn-mappo ESP=runs/cn-mappo-esp --style paper --out comparison"""


def report(
    context: typer.Context,
    runs: Annotated[
        list[str],
        Argument(help="One study folder, or run folders, each as PATH or LABEL=PATH.", metavar="STUDY|RUN..."),
    ],
    out: Annotated[
        Path | None,
        Option("--out", "-o", help="Folder of the page and its pictures; of a study by default STUDY/report."),
    ] = None,
    films: Annotated[bool, Option("--films", help="Draw the trained policies for the page.")] = False,
    results: Annotated[
        Path | None,
        Option(
            "--results",
            help="Also write every seed's numbers and the configurations as JSON.",
            callback=options.not_over_a_run,
        ),
    ] = None,
    at: Annotated[
        list[str] | None,
        Option("--at", help="Runs: compare at this step; by default the last that all reached.", metavar="STEPS"),
    ] = None,
    threshold: Annotated[
        list[float] | None, Option("--threshold", help="State when this return is first reached.")
    ] = None,
    mode: Annotated[
        Mode | None, Option("--mode", help="Which evaluations; greedy, unless the study is about others.")
    ] = None,
    plot: Annotated[Path | None, Option("--plot", help="Draw the curves as PNG and SVG.")] = None,
    style: Annotated[
        Literal["screen", "paper"],
        Option("--style", help="Of figures; paper: as wide as a column or a page, small letters, also as PDF."),
    ] = "screen",
    full: Annotated[bool, Option("--full", help="Print every table, not only the answer.")] = False,
    task: options.OwnTaskOption = None,
    algo: options.OwnAlgoOption = None,
    network: options.OwnNetworkOption = None,
    json: options.JsonOption = None,
) -> None:
    """Compare a study or runs of one task: write page, curves and numbers, then say in short what came out."""
    from esp_cli.reporting.collect import collect_study
    from esp_cli.studies.study import StudyFolder

    options.register_named(task, algo, network)
    limits = threshold or []
    options.check_finite("--threshold", *limits)
    _refuse_trials(Path(runs[0]))
    if StudyFolder.is_one(Path(runs[0])):
        if len(runs) > 1 or at or plot:
            raise UserError("a study is reported by itself: leave out the other runs, --at and --plot")
        out = out or Path(runs[0]) / "report"
        material = collect_study(StudyFolder.open(Path(runs[0])), mode, limits)
    else:
        if films and out is None:
            raise UserError("--films draws for the page that --out writes; add --out FOLDER, or leave it out")
        if style == "paper" and out is None and plot is None:
            raise UserError("--style is of the figures that --out or --plot writes; add one of them, or leave it out")
        material = _side_by_side(runs, options.command_line(context), at or [], limits, mode)

    options.refuse_unused([cell.config for cell in material.study.cells], task, algo, network)
    _write_page(material, out, films, style)
    if results is not None:
        console.write_json(results, material.results.document())
        console.note(f"results -> {results}")
    if plot is not None:
        from esp_cli.reporting.study_figures import draw_curves

        png = draw_curves(material, plot, style)
        for ending in (".png", ".svg", *([".pdf"] if style == "paper" else [])):
            console.note(f"curves -> {png.with_suffix(ending)}")
    console.result(json, material.results.document(statistics=True), lambda: print_answer(material, full, limits))
    if not full and json != "-":
        console.note("every table: add --full")


def print_answer(material: Material, full: bool, thresholds: Sequence[float] = ()) -> None:
    """Print what came out, on request below every table."""
    from esp_cli.reporting.page import answer
    from esp_cli.reporting.tables import all_tables

    for table in all_tables(material.results) if full else ():
        console.table(table.headings, table.rows, title=table.title, caption=table.caption)
    for text in answer(material, thresholds):
        console.text(text)


def _side_by_side(
    runs: Sequence[str], command: str, at: Sequence[str], thresholds: Sequence[float], mode: Mode | None
) -> Material:
    from esp_cli.reporting.collect import collect_runs, read_curve

    steps, curves = [parse_count(text) for text in at], []
    for text in runs:
        label, path = _labelled(text)
        curves.append(read_curve(path, label, mode or "greedy"))
    return collect_runs(curves, command, mode or "greedy", steps, thresholds)


def _refuse_trials(path: Path) -> None:
    """Refuse the folder of a search's trials, of which what judges them has the report."""
    from esp_cli.studies.kinds import TRIALS
    from esp_cli.studies.study import StudyFolder

    if StudyFolder.is_one(path) and StudyFolder.open(path).study.kind.endswith(TRIALS):
        raise UserError(f"{path} holds trials; report what judges them by: esp report {shlex.quote(str(path / FRESH))}")


def _write_page(material: Material, out: Path | None, films: bool, style: Literal["screen", "paper"]) -> None:
    from esp_cli.reporting.page import draw_films, write_report

    if films:
        with console.TrainingProgress(len(material.runs), description="draw", unit="films") as progress:
            unseen = draw_films(material.runs, progress.update)
        for run in unseen:
            console.note(f"{run} has no film: its task does not draw itself")
    if out is not None and material.curves:
        for file in write_report(material, out, style):
            console.note(f"report -> {file}")
    elif out is not None:
        console.note("no run has an evaluation yet, so there is nothing to draw")


def _labelled(text: str) -> tuple[str | None, Path]:
    """Split LABEL=PATH; either may itself have a "=", so the longest path that exists is taken."""
    splits = [(text[:k], Path(text[k + 1 :])) for k, character in enumerate(text) if character == "="]
    if Path(text).exists() or not splits:
        return None, Path(text)
    return next((split for split in splits if split[1].exists()), splits[-1])
