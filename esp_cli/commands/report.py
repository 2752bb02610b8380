"""`esp report`: runs side by side, as a table, a JSON file and a picture."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from esp_cli import console
from esp_cli.commands.options import JsonOption, parse_count

EPILOG = """Examples:\n
    esp report runs/cn-mappo runs/cn-mappo-esp\n
    esp report plain=runs/cn-mappo ESP=runs/cn-mappo-esp --at 500k --at 3M --threshold -125 --plot curves.png"""


def report(
    runs: Annotated[list[str], typer.Argument(help="Run folders, each as PATH or LABEL=PATH.", metavar="RUN...")],
    at: Annotated[list[str] | None, typer.Option("--at", help="State returns at this step.", metavar="STEPS")] = None,
    threshold: Annotated[
        list[float] | None, typer.Option("--threshold", help="State when this return is first reached.")
    ] = None,
    reference: Annotated[
        list[str] | None,
        typer.Option("--reference", help="Draw a line at somebody else's number.", metavar="NAME=VALUE"),
    ] = None,
    mode: Annotated[Literal["greedy", "stochastic"], typer.Option("--mode", help="Which evaluations.")] = "greedy",
    view: Annotated[
        tuple[float, float] | None, typer.Option("--view", help="Lowest and highest return in the picture.")
    ] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="Draw the curves as PNG and SVG.", metavar="FILE")] = None,
    json: JsonOption = None,
) -> None:
    """Compare runs of one task: returns with intervals, differences from the first run, steps to thresholds."""
    from esp_cli.experiments import comparison

    steps = [parse_count(text) for text in at or []]
    lines = _references(reference or [])
    curves = [comparison.read_curve(path, label, mode) for label, path in map(_labelled, runs)]
    result = comparison.compare(curves, steps, threshold or [])
    if json != "-":
        _print(result)
    if json is not None:
        console.write_json(json, result)
    if plot is not None:
        for file in comparison.plot(curves, plot, result["convention"], mode, lines, view):
            console.note(f"curves -> {file}")


def _labelled(text: str) -> tuple[str | None, Path]:
    """Split LABEL=PATH; either may itself have a "=", so the longest path that exists is taken."""
    splits = [(text[:k], Path(text[k + 1 :])) for k, character in enumerate(text) if character == "="]
    if Path(text).exists() or not splits:
        return None, Path(text)
    return next((split for split in splits if split[1].exists()), splits[-1])


def _references(items: list[str]) -> dict[str, float]:
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
    title = f"{result['task']} version {result['task_version']}, {result['episodes_per_evaluation']} episodes a seed"
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


def print_tables(results: dict[str, Any]) -> None:
    """Print every table of a study's results."""
    from esp_cli.experiments.tables import all_tables

    for table in all_tables(results):
        console.table(table.headings, table.rows, title=table.title, caption=table.caption)
