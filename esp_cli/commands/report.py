"""`esp report`: a study or runs side by side, as tables, a page, pictures and JSON."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from esp_cli import console
from esp_cli.commands.options import JsonOption, parse_count

if TYPE_CHECKING:
    from esp_cli.reporting.curves import RunCurve
    from esp_cli.reporting.page import Material

EPILOG = """Examples:\n
    esp report runs/table1\n
    esp report runs/table1 --films --results docs/measured/table1.json\n
    esp report runs/cn-mappo runs/cn-mappo-esp\n
    esp report plain=runs/cn-mappo ESP=runs/cn-mappo-esp --at 500k --at 3M --threshold -125 --plot curves.png\n
    esp report plain=runs/cn-mappo ESP=runs/cn-mappo-esp --out comparison"""


def report(
    runs: Annotated[
        list[str] | None,
        typer.Argument(help="One study folder, or run folders, each as PATH or LABEL=PATH.", metavar="STUDY|RUN..."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder of the page and its pictures; of a study by default STUDY/report."),
    ] = None,
    films: Annotated[bool, typer.Option("--films", help="Draw the trained policies for the page.")] = False,
    results: Annotated[
        Path | None,
        typer.Option(
            "--results", help="Also write every seed's numbers and the configurations as JSON.", metavar="FILE"
        ),
    ] = None,
    fill: Annotated[
        Path | None,
        typer.Option("--fill", help="Compute the tables of this Markdown page from its results files.", metavar="PAGE"),
    ] = None,
    at: Annotated[
        list[str] | None, typer.Option("--at", help="Runs: state returns at this step.", metavar="STEPS")
    ] = None,
    threshold: Annotated[
        list[float] | None, typer.Option("--threshold", help="State when this return is first reached.")
    ] = None,
    reference: Annotated[
        list[str] | None,
        typer.Option("--reference", help="Runs: draw a line at somebody else's number.", metavar="NAME=VALUE"),
    ] = None,
    mode: Annotated[Literal["greedy", "stochastic"], typer.Option("--mode", help="Which evaluations.")] = "greedy",
    view: Annotated[
        tuple[float, float] | None, typer.Option("--view", help="Lowest and highest return in the picture.")
    ] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="Draw the curves as PNG and SVG.", metavar="FILE")] = None,
    json: JsonOption = None,
) -> None:
    """Tabulate a study or compare runs of one task: intervals, differences, steps to thresholds; curves and a page."""
    from esp_cli.studies.study import StudyFolder

    if fill is not None:
        _fill(fill)
    if not runs:
        if fill is None:
            raise ValueError("there is nothing to report; name a study folder or run folders")
        return
    if StudyFolder.is_one(Path(runs[0])):
        if len(runs) > 1 or at or reference or plot or view:
            raise ValueError(
                "a study is reported by itself: leave out the other runs, --at, --reference, --plot, --view"
            )
        _report_study(Path(runs[0]), out, mode, threshold or [], films, results, json)
        return
    _report_runs(runs, out, mode, threshold or [], films, results, json, at or [], reference or [], plot, view)


def _report_study(
    path: Path,
    out: Path | None,
    mode: Literal["greedy", "stochastic"],
    thresholds: Sequence[float],
    films: bool,
    small: Path | None,
    json: str | None,
) -> None:
    """Print the tables of a study and write its page."""
    from esp_cli.reporting.page import Material
    from esp_cli.reporting.results import collect, read_curve_of
    from esp_cli.studies.study import StudyFolder

    folder = StudyFolder.open(path)
    cells = folder.study.cells
    found = collect(folder, mode, thresholds)
    curves = {cell.name: read_curve_of(folder.run_path(cell), cell, mode) for cell in cells}
    begun = {name: curve for name, curve in curves.items() if curve is not None}
    material = Material(folder.study, found, begun, {cell.name: folder.run_path(cell) for cell in cells})
    if json != "-":
        print_tables(found)
    if json is not None:
        console.write_json(json, found)
    _write(material, out or path / "report", films, small)


def _report_runs(
    runs: Sequence[str],
    out: Path | None,
    mode: Literal["greedy", "stochastic"],
    thresholds: Sequence[float],
    films: bool,
    small: Path | None,
    json: str | None,
    at: Sequence[str],
    reference: Sequence[str],
    plot: Path | None,
    view: tuple[float, float] | None,
) -> None:
    """Compare runs put together by hand."""
    from esp_cli.reporting import curves as comparison

    steps = [parse_count(text) for text in at]
    lines = _references(reference)
    places = [_labelled(text) for text in runs]
    curves = [comparison.read_curve(path, label, mode) for label, path in places]
    result = comparison.compare(curves, steps, thresholds)
    if json != "-":
        _print(result)
    if json is not None:
        console.write_json(json, result)
    if plot is not None:
        for file in comparison.plot(curves, plot, result["convention"], mode, lines, view):
            console.note(f"curves -> {file}")
    if out is not None or small is not None or films:
        command = shlex.join(["esp", "report", *runs])
        material = _material(curves, [path for _, path in places], command, mode, thresholds)
        _write(material, out, films, small)


def _material(
    curves: Sequence[RunCurve],
    paths: Sequence[Path],
    command: str,
    mode: Literal["greedy", "stochastic"],
    thresholds: Sequence[float],
) -> Material:
    """Return runs put together by hand as a study, the first of which the others are held against."""
    from esp_cli.reporting.page import Material
    from esp_cli.reporting.results import of_runs
    from esp_cli.studies.study import Cell, Study

    names = [f"{k}-{curve.label}" for k, curve in enumerate(curves)]
    cells = [
        Cell(
            name=name,
            panel=curve.config.task,
            variant=curve.label,
            config=curve.config,
            reference=names[0] if name != names[0] else None,
        )
        for name, curve in zip(names, curves, strict=True)
    ]
    title = f"{' and '.join(curve.label for curve in curves)} on {curves[0].config.task}"
    episodes = curves[0].config.evaluation.episodes
    study = Study(kind="runs", title=title, command=command, episodes=episodes, rows="variants", cells=tuple(cells))
    by_name = dict(zip(names, curves, strict=True))
    results = of_runs(study, by_name, mode, thresholds)
    return Material(study, results, by_name, dict(zip(names, paths, strict=True)))


def _write(material: Material, out: Path | None, films: bool, small: Path | None) -> None:
    """Write what was asked for beside the tables."""
    from esp_cli.reporting.page import draw_films, write_report

    if films:
        with console.TrainingProgress(len(material.runs), description="draw") as progress:
            draw_films(material.runs, progress.update)
    if out is not None and (material.curves or material.study.kind == "runs"):
        for file in write_report(material, out):
            console.note(f"report -> {file}")
    elif out is not None:
        console.note("no run has an evaluation yet, so there is nothing to draw")
    if small is not None:
        console.write_json(small, material.results)
        console.note(f"results -> {small}")


def _fill(page: Path) -> None:
    from esp_cli.files.writing import write_file
    from esp_cli.reporting.pages import filled

    write_file(page, filled(page).encode())
    console.note(f"tables -> {page}")


def print_tables(results: dict[str, Any]) -> None:
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
            raise ValueError(f"--reference {item} is no line to draw; write --reference NAME=VALUE")
    return out


def _print(result: dict[str, Any]) -> None:
    rows = []
    for run in result["runs"]:
        for step, verdict in run["returns"].items():
            seeds = sum(x is not None for x in verdict["per_seed"]) if verdict else 0
            rows.append((run["label"], console.format_count(int(step)), seeds, *_cells(verdict)))
    episodes = console.format_span({run["config"]["evaluation"]["episodes"] for run in result["runs"]})
    title = f"{result['task']} version {result['task_version']}, {episodes} episodes a seed"
    caption = f"convention {result['convention']}; mean ± s.e.m. over seeds; difference from the first run"
    headings = ("run", "steps>", "seeds>", "return>", "95 % interval>", "difference>", "95 % interval>")
    console.table(headings, rows, title=title, caption=caption)
    limits = [
        (run["label"], limit, passed["mean"]) for run in result["runs"] for limit, passed in run["steps_to"].items()
    ]
    if limits:
        cells = [
            (label, limit, console.format_count(step) if step is not None else "-") for label, limit, step in limits
        ]
        console.table(("run", "return>", "first reached at>"), cells)


def _cells(verdict: dict[str, Any] | None) -> tuple[str, str, str, str]:
    if verdict is None or verdict["mean"] is None:
        return ("-",) * 4
    interval = console.format_interval(verdict["ci95"]) if verdict["ci95"] else "-"
    gap = verdict.get("difference")
    if gap is None:
        return console.format_mean(verdict["mean"], verdict["sem"]), interval, "", ""
    gap_interval = console.format_interval(gap["ci95"]) if gap["ci95"] else "-"
    return console.format_mean(verdict["mean"], verdict["sem"]), interval, f"{gap['mean']:+.2f}", gap_interval
