"""The report of a study or of some runs: Markdown with pictures, and one page that needs nothing but a browser."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader

from esp_cli import __version__
from esp_cli.drawing.rendering import default_episodes, open_painter, record, shots, stride, write_film
from esp_cli.files.documents import encode
from esp_cli.files.writing import replace_file
from esp_cli.reporting.charts import chart
from esp_cli.reporting.curves import RunCurve
from esp_cli.reporting.marl_eval import marl_eval
from esp_cli.reporting.panels import Panel, Sensitivity, curve_panels, sensitivity
from esp_cli.reporting.plots import Bar, Curve, bars
from esp_cli.reporting.recipes import command_of
from esp_cli.reporting.results import returns_of
from esp_cli.reporting.tables import all_tables
from esp_cli.studies.study import Cell, Study
from esp_cli.training.build import build_environment
from esp_cli.training.loading import load_policy

PAGE, MARKDOWN, RESULTS, MARL_EVAL, FILM = "report.html", "report.md", "results.json", "marl-eval.json", "film.gif"
_TEMPLATES = Path(__file__).with_name("templates")
_FILM_PIXELS, _FILM_FRAMES_PER_SECOND = 240, 12.0
_FILM_SECONDS = 15.0
"""A film is sped up to last no longer."""


@dataclass(frozen=True)
class Material:
    """All that a report is made from.

    Attributes:
        study: what was planned.
        results: what came out, see `results.collect`.
        curves: by name of the cell, those that have begun.
        runs: run folders by name of the cell.
    """

    study: Study
    results: Mapping[str, Any]
    curves: Mapping[str, RunCurve]
    runs: Mapping[str, Path] = field(default_factory=dict)


def write_report(material: Material, out: Path) -> list[Path]:
    """Write a report.

    Args:
        material: what it is made from.
        out: folder; missing ones are made.

    Returns:
        The files: the page, the Markdown, the pictures, the results and the form for marl-eval.

    Raises:
        ValueError: no run has an evaluation yet, or a file cannot be written.
    """
    if not material.curves:
        raise ValueError("no run of this study has an evaluation yet; run it first, or wait a little")
    out.mkdir(parents=True, exist_ok=True)
    panels = _panels(material)
    pictures = _pictures(material, panels, out)
    scores = marl_eval(material.study, material.curves, material.results)
    for path, content in ((out / RESULTS, material.results), (out / MARL_EVAL, scores)):
        replace_file(path, encode(content, path))
    labels = list(dict.fromkeys(curve.label for panel in panels for curve in panel.curves))
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    content = {
        "title": material.study.title,
        "version": __version__,
        "command": material.study.command,
        "tables": all_tables(material.results),
        "charts": [chart(panel, labels) for panel in panels],
        "legend": [(label, *_legend(labels, label)) for label in labels],
        "pictures": [(png.stem, _data_uri(svg, "image/svg+xml")) for png, svg in pictures[1:]],  # curves are charts
        "films": [(name, _data_uri(path, "image/gif")) for name, path in _films(material)],
        "runs": [_run(cell) for cell in material.study.cells],
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
        if (run / "policy.safetensors").is_file() and not (run / FILM).is_file():
            trained = load_policy(run / "policy.safetensors")
            env = build_environment(trained.config, 1, "film")
            period = trained.spec.control_period_s
            episodes = default_episodes(trained.spec)
            speed = max(1.0, episodes * trained.spec.horizon * period / _FILM_SECONDS)
            with open_painter(env, "top", _FILM_PIXELS) as painter:
                recorded = record(trained, env, trained.config.seeds[0], episodes)
                taken = shots(recorded, stride(period, speed, _FILM_FRAMES_PER_SECOND))
                write_film(run / FILM, painter, taken, period / speed, lambda _: None)
        watch(count)


def _panels(material: Material) -> list[Panel]:
    """Return the learning curves by panel, with the anchors of a judged run."""
    entries = {entry["name"]: entry for entry in material.results["cells"]}
    panels = []
    for name in material.study.panels:
        cells = [cell for cell in material.study.cells if cell.panel == name and cell.name in material.curves]
        curves = [Curve(cell.variant, *_evaluations(material.curves[cell.name])) for cell in cells]
        anchors: dict[str, float] = next((a for cell in cells if (a := entries[cell.name].get("anchors"))), {})
        if curves:
            panels.append(Panel(name, curves, anchors))
    return panels


def _evaluations(curve: RunCurve) -> tuple[Any, Any]:
    return curve.steps, curve.values


def _pictures(material: Material, panels: Sequence[Panel], out: Path) -> list[tuple[Path, Path]]:
    """Draw the curves, and for an ablation its bars or its coefficient; each as PNG and SVG."""
    results, kind = material.results, material.study.kind
    pictures = [curve_panels(panels, out / "curves", f"{results['mode']} return")]
    finished = [
        cell for cell in results["cells"] if cell.get("returns") and None not in cell["returns"][results["mode"]]
    ]
    if kind == "ablate-coefficient" and finished:
        names = list(dict.fromkeys(cell["panel"] for cell in finished))
        lines = [
            Sensitivity(
                name,
                {c["variant"]: returns_of(c, results["mode"]) for c in finished if c["panel"] == name},
                {c["variant"]: c["paper"][0] for c in finished if c["panel"] == name and c["paper"]},
            )
            for name in names
        ]
        title = "Return over the weight of the consistency loss"
        weights, label = [cell["variant"] for cell in results["cells"]], f"{results['mode']} return"
        pictures.append(sensitivity(lines, out / "coefficient", title, "weight", label, weights))
    elif results["rows"] == "variants":
        for k, name in enumerate(dict.fromkeys(cell["panel"] for cell in finished)):
            own = [cell for cell in finished if cell["panel"] == name]
            groups = [Bar(cell["variant"], returns_of(cell, results["mode"])) for cell in own]
            anchors = {key: round(value, 1) for key, value in (own[0].get("anchors") or {}).items()}
            label = f"{results['mode']} return"
            baseline = anchors.get("random", 0.0)
            pictures.append(bars(groups, out / f"bars-{k + 1}", name, label, baseline, anchors))
    return pictures


def _legend(labels: Sequence[str], label: str) -> tuple[str, str]:
    """Return the colour and dashes of a label as the charts have them."""
    own = chart(Panel("", [Curve(label, [0, 1], [[0.0], [1.0]])]), labels)["curves"][0]
    return own["colour"], own["dashes"]


def _films(material: Material) -> list[tuple[str, Path]]:
    titles = {cell.name: f"{cell.panel}: {cell.variant}" for cell in material.study.cells}
    return [(titles[name], run / FILM) for name, run in material.runs.items() if (run / FILM).is_file()]


def _run(cell: Cell) -> dict[str, str]:
    return {
        "name": f"{cell.panel}: {cell.variant}",
        "command": command_of(cell.config),
        "config": json.dumps(cell.config.model_dump(mode="json"), indent=1),
    }


def _data_uri(path: Path, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _markdown(material: Material, pictures: Sequence[tuple[Path, Path]]) -> str:
    parts = [f"# {material.study.title}", f"```sh\n{material.study.command}\n```"]
    parts += [f"## {table.title}\n\n{table.markdown()}" for table in all_tables(material.results)]
    parts += [f"![{png.stem}]({png.name})" for png, _ in pictures]
    commands = "\n".join(command_of(cell.config) for cell in material.study.cells)
    return "\n\n".join([*parts, "## Each run by itself", f"```sh\n{commands}\n```"]) + "\n"
