"""The report of a study or of some runs: Markdown with pictures, and one page that needs nothing but a browser."""

from __future__ import annotations

import base64
import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jinja2 import Environment, FileSystemLoader

from esp_cli.defaults import __version__
from esp_cli.drawing.draw import draw
from esp_cli.files.documents import encode
from esp_cli.files.writing import replace_file
from esp_cli.policies.loading import load_policy
from esp_cli.policies.statistics import Floats
from esp_cli.reporting.breaking import series_of
from esp_cli.reporting.charts import chart, stroke
from esp_cli.reporting.collect import Material
from esp_cli.reporting.marl_eval import marl_eval
from esp_cli.reporting.panels import Panel, Sensitivity, curve_panels, sensitivity
from esp_cli.reporting.plots import Curve, Group, dots
from esp_cli.reporting.results import RESULTS_FORMAT, CellResult, Results
from esp_cli.reporting.summary import floats, returns_of
from esp_cli.reporting.tables import all_tables, markdown_text
from esp_cli.studies.kinds import kind_of
from esp_cli.training.folder_names import POLICY
from esp_envs.errors import UserError

PAGE, MARKDOWN, RESULTS, MARL_EVAL, FILM = "report.html", "report.md", "results.json", "marl-eval.json", "film.gif"
CURVES = "curves"
_TEMPLATES = Path(__file__).with_name("templates")
_FILM_PIXELS, _FILM_FRAMES_PER_SECOND = 240, 12.0
_FILM_SECONDS = 15.0
"""A film is sped up to last no longer."""
Pictures = list[tuple[Path, Path]]
"""Each as PNG and SVG."""


@dataclass(frozen=True)
class RunText:
    """A run by itself: its name, the command that trains it, and its configuration as JSON."""

    name: str
    command: str
    config: str


def write_report(material: Material, out: Path) -> list[Path]:
    """Write a report.

    Args:
        material: what it is made from.
        out: folder; missing ones are made.

    Returns:
        The files: the page, the Markdown, the pictures, the results and the form for marl-eval.

    Raises:
        UserError: no run has an evaluation yet, the folder has a report of something else, or a file cannot be
            written.
    """
    if not material.curves:
        raise UserError("no run of this study has an evaluation yet; run it first, or wait a little")
    own = (MARKDOWN, RESULTS, PAGE, MARL_EVAL, f"{CURVES}.png", f"{CURVES}.svg")
    foreign = next((out / name for name in own if os.path.lexists(out / name)), None)
    if foreign is not None and not RESULTS_FORMAT.is_one(out / RESULTS):
        raise UserError(f"{foreign} is not of a report by esp; move it away, or write the report to another folder")
    out.mkdir(parents=True, exist_ok=True)
    panels = _panels(material)
    # Names in this folder are the program's own: links there are replaced, where drawing would follow them.
    with TemporaryDirectory() as scratch:
        drawn = _pictures(material, panels, Path(scratch))
        for file in (file for pair in drawn for file in pair):
            replace_file(out / file.name, file.read_bytes())
    pictures = [(out / png.name, out / svg.name) for png, svg in drawn]
    RESULTS_FORMAT.write(out / RESULTS, material.results.content())
    replace_file(out / MARL_EVAL, encode(marl_eval(material), out / MARL_EVAL))
    labels = list(dict.fromkeys(curve.label for panel in panels for curve in panel.curves))
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    content = {
        "title": material.study.title,
        "version": __version__,
        "command": material.study.command,
        "tables": all_tables(material.results),
        "charts": [chart(panel, labels, f"{material.results.mode} return") for panel in panels],
        "legend": [(label, *stroke(index)) for index, label in enumerate(labels)],
        "pictures": [(png.stem, _data_uri(svg, "image/svg+xml")) for png, svg in pictures[1:]],  # curves are charts
        "films": [(name, _data_uri(path, "image/gif")) for path, name in _films(material).items()],
        "runs": _runs(material),
    }
    page, markdown = out / PAGE, out / MARKDOWN
    replace_file(page, environment.get_template("report.html").render(content).encode())
    replace_file(markdown, _markdown(material, pictures).encode())
    return [page, markdown, *(png for png, _ in pictures), out / RESULTS, out / MARL_EVAL]


def draw_films(runs: Mapping[str, Path], watch: Callable[[int], None]) -> None:
    """Draw the policy of each trained run that has no film yet, into its folder.

    Args:
        runs: run folders by name.
        watch: told how many are done.
    """
    for count, run in enumerate(runs.values(), start=1):
        if (run / POLICY).is_file() and not _is_film(run / FILM):
            trained = load_policy(run / POLICY)
            speed = max(1.0, trained.spec.horizon * trained.spec.control_period_s / _FILM_SECONDS)
            with TemporaryDirectory() as scratch:
                film = Path(scratch) / FILM
                draw(trained, film, view="top", size=_FILM_PIXELS, speed=speed, fps=_FILM_FRAMES_PER_SECOND)
                replace_file(run / FILM, film.read_bytes())
        watch(count)


def _panels(material: Material) -> list[Panel]:
    """Return the learning curves by panel, with the anchors of a run that has its final evaluation.

    Runs that are compared at several steps have the same curves at each, which are drawn once.
    """
    entries = {entry.name: entry for entry in material.results.cells}
    panels: dict[tuple[int, ...], Panel] = {}
    for name in material.study.panels:
        cells = [cell for cell in material.study.cells if cell.panel == name and cell.name in material.curves]
        found = [material.curves[cell.name] for cell in cells]
        lines: dict[str, float] = next((dict(a) for cell in cells if (a := entries[cell.name].anchors)), {})
        if kind_of(material.study.kind).network_cost:
            own = (entries[cell.name] for cell in cells)
            lines |= {f"paper {entry.variant}": entry.paper[0] for entry in own if entry.paper}
        if found:
            title = cells[0].config.task if entries[cells[0].name].at is not None else name
            title = title.rpartition(":")[2]  # of a task of the caller, the class
            curves = [Curve(cell.variant, c.steps, c.values) for cell, c in zip(cells, found, strict=True)]
            panels.setdefault(tuple(map(id, found)), Panel(title, curves, lines))
    return list(panels.values())


def _pictures(material: Material, panels: Sequence[Panel], out: Path) -> Pictures:
    """Draw the curves, and for variants their returns, or the returns over their coefficient."""
    results = material.results
    label = f"{results.mode} return"
    pictures = [curve_panels(panels, out / CURVES, label)]
    if results.rows == "panels":
        return pictures
    if over_strength := draw_over_strength(results, out / "breaking"):
        return [*pictures, *over_strength]
    if results.kind == "ablate-coefficient":
        return [*pictures, *draw_over_coefficient(results, out / "coefficient")]
    for k, (panel, own) in enumerate(_finished(results).items()):
        groups = [Group(variant, floats(cell.returns[results.mode])) for variant, cell in own.items()]
        anchors = {key: round(value, 1) for key, value in next(iter(own.values())).anchors.items()}
        pictures.append(dots(groups, out / f"returns-{k + 1}", panel, label, anchors))
    return pictures


def _finished(results: Results) -> dict[str, dict[str, CellResult]]:
    """Return the cells whose seeds all have a return, by panel and variant."""
    finished: dict[str, dict[str, CellResult]] = {}
    for cell in results.cells:
        if cell.returns and None not in cell.returns[results.mode]:
            finished.setdefault(cell.panel, {})[cell.variant] = cell
    return finished


def draw_over_coefficient(results: Results, out: Path) -> Pictures:
    """Draw the return over the weight of the consistency loss, one line for each panel, into the picture `out`."""
    lines = [
        Sensitivity(
            panel,
            {variant: floats(cell.returns[results.mode]) for variant, cell in own.items()},
            {variant: cell.paper[0] for variant, cell in own.items() if cell.paper},
        )
        for panel, own in _finished(results).items()
    ]
    title, weights = "Return over the weight of the consistency loss", [cell.variant for cell in results.cells]
    return [sensitivity(lines, out, title, "weight", f"{results.mode} return", weights)] if lines else []


def draw_over_strength(results: Results, out: Path) -> Pictures:
    """Draw the return over the strength of breaking, one line for each method.

    Args:
        results: of any study; one that breaks nothing has no such pictures.
        out: the pictures are `out`-1, `out`-2 and so on, one for each task and setting.
    """
    pictures: Pictures = []
    for k, one in enumerate(series_of(results), 1):
        lines: dict[str, dict[str, Floats]] = {}
        for strength, cells in one.cells.items():
            for method, cell in cells.items():
                values = returns_of(cell, results.mode)
                if values is not None and bool(np.isfinite(values).all()):
                    lines.setdefault(method, {})[f"{strength:g}"] = values
        drawn = [Sensitivity(method, values) for method, values in lines.items()]
        if drawn:
            order = [f"{strength:g}" for strength in one.cells]
            path, title = out.with_name(f"{out.name}-{k}"), f"{one.name}, {one.setting}"
            pictures.append(sensitivity(drawn, path, title, one.setting, f"{results.mode} return", order))
    return pictures


def _films(material: Material) -> dict[Path, str]:
    titles = {cell.name: f"{cell.panel}: {cell.variant}" for cell in material.study.cells}
    return {run / FILM: titles[name] for name, run in material.runs.items() if _is_film(run / FILM)}


def _is_film(path: Path) -> bool:
    """Return whether a film is there; a link is not followed."""
    if path.is_symlink() or not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(4) == b"GIF8"


def _runs(material: Material) -> list[RunText]:
    """Return every run once, whatever the number of steps at which it is compared."""
    cells = {material.runs.get(cell.name, cell.name): cell for cell in material.study.cells}
    return [
        RunText(
            f"{cell.panel}: {cell.variant}",
            cell.config.command(),
            json.dumps(cell.config.model_dump(mode="json"), indent=1),
        )
        for cell in cells.values()
    ]


def _data_uri(path: Path, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _markdown(material: Material, pictures: Pictures) -> str:
    parts = [f"# {markdown_text(material.study.title)}", _fenced(material.study.command)]
    parts += [f"## {markdown_text(table.title)}\n\n{table.markdown()}" for table in all_tables(material.results)]
    parts += [f"![{png.stem}]({png.name})" for png, _ in pictures]
    commands = "\n".join(run.command for run in _runs(material))
    return "\n\n".join([*parts, "## Each run by itself", _fenced(commands)]) + "\n"


def _fenced(command: str) -> str:
    """Return a block of shell commands, in a fence that is longer than any row of backticks in it."""
    fence = "`" * max(3, *(len(row) + 1 for row in re.findall("`+", command)), 0)
    return f"{fence}sh\n{command}\n{fence}"
