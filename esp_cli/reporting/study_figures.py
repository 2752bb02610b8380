"""Which figures a report has: learning curves, and returns as dots or over what a study varies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from esp_cli.reporting.collect import Material
from esp_cli.reporting.figures import Picture, dots, over_setting
from esp_cli.reporting.learning_curves import Curve, Hover, Panel, learning_curves
from esp_cli.reporting.results import CellResult, Results
from esp_cli.reporting.summary import floats
from esp_cli.studies.kinds import UNBROKEN, kind_of


@dataclass(frozen=True)
class Series:
    """The cells of one task and algorithm, by strength of breaking (smallest first) and method."""

    name: str  # "navigation, MAPPO, 1M"
    setting: str  # what breaks the symmetry
    cells: Mapping[float, Mapping[str, CellResult]]  # by strength, then by method


def series_of(results: Results) -> list[Series]:
    """Return the series of a study of broken symmetry; none of other studies."""
    series: dict[tuple[str, str], dict[float, dict[str, CellResult]]] = {}
    heads = [
        (task, setting, strength, f"{task}, {setting} {strength:g}, " if strength else f"{task}, {UNBROKEN}, ")
        for task, settings in kind_of(results.kind).breakings.items()
        for setting, strengths in settings.items()
        for strength in (0.0, *strengths)
    ]
    for cell in results.cells:
        for task, setting, strength, head in heads:
            if cell.panel.startswith(head):
                name = f"{task}, {cell.panel.removeprefix(head)}"
                series.setdefault((name, setting), {}).setdefault(strength, {})[cell.variant] = cell
    whole = {key: dict(sorted(cells.items())) for key, cells in series.items() if set(cells) != {0.0}}
    return [Series(name, setting, cells) for (name, setting), cells in whole.items()]


def draw_curves(
    material: Material,
    path: Path,
    references: Mapping[str, float] | None = None,
    view: tuple[float, float] | None = None,
) -> tuple[Picture, tuple[Hover, ...]]:
    """Draw the learning curves by panel, with the anchors of a run that has its final evaluation.

    Runs that are compared at several steps have the same curves at each, which are drawn once.

    Args:
        material: with a curve.
        path: where to.
        references: lines at numbers of others: name -> return.
        view: the lowest and the highest return shown, by default all.
    """
    entries = {entry.name: entry for entry in material.results.cells}
    panels: dict[tuple[int, ...], Panel] = {}
    for name in material.study.panels:
        cells = [cell for cell in material.study.cells if cell.panel == name and cell.name in material.curves]
        drawn = [material.curves[cell.name] for cell in cells]
        anchors: dict[str, float] = next((dict(a) for cell in cells if (a := entries[cell.name].anchors)), {})
        if kind_of(material.study.kind).network_cost:
            own = (entries[cell.name] for cell in cells)
            anchors |= {f"paper {entry.variant}": entry.paper[0] for entry in own if entry.paper}
        if drawn:
            title = cells[0].config.task if entries[cells[0].name].at is not None else name
            title = title.rpartition(":")[2]  # of a task of the caller, the class
            curves = [Curve(cell.variant, c.steps, c.values) for cell, c in zip(cells, drawn, strict=True)]
            panels.setdefault(tuple(map(id, drawn)), Panel(title, curves, anchors, references or {}))
    conventions = {entry.convention for entry in entries.values() if entry.convention}
    convention = f" ({conventions.pop()})" if len(conventions) == 1 and len(panels) == 1 else ""
    return learning_curves([*panels.values()], path, f"{material.results.mode} return{convention}", view)


def draw_variants(results: Results, out: Path) -> list[Picture]:
    """Draw the returns of a study of variants, over what it varies where that has an order; of others none.

    Args:
        results: of the study.
        out: folder.
    """
    if results.rows == "panels":
        return []
    if results.kind == "ablate-coefficient" or kind_of(results.kind).breakings:
        stem = "coefficient" if results.kind == "ablate-coefficient" else "breaking"
        return draw_over_setting(results, out / stem)
    pictures = []
    for k, (panel, cells) in enumerate(_finished(results).items(), 1):
        groups = {variant: floats(cell.returns[results.mode]) for variant, cell in cells.items()}
        anchors = {key: round(value, 1) for key, value in next(iter(cells.values())).anchors.items()}
        pictures.append(dots(groups, out / f"returns-{k}", panel, f"{results.mode} return", anchors))
    return pictures


def draw_over_setting(results: Results, path: Path) -> list[Picture]:
    """Draw returns over the weight of the consistency loss, or over each strength of breaking.

    Args:
        results: of a study that varies either.
        path: of the picture; of breaking `path`-1, `path`-2 and so on, one for each task and setting.
    """
    label, mode = f"{results.mode} return", results.mode
    if results.kind == "ablate-coefficient":
        panels = _finished(results)
        lines = {
            panel: {name: floats(cell.returns[mode]) for name, cell in own.items()} for panel, own in panels.items()
        }
        paper = {p: {name: cell.paper[0] for name, cell in own.items() if cell.paper} for p, own in panels.items()}
        title, order = "Return over the weight of the consistency loss", [cell.variant for cell in results.cells]
        return [over_setting(lines, path, title, ("weight", label), order, paper)] if lines else []
    pictures = []
    for k, one in enumerate(series_of(results), 1):
        lines = {}
        for strength, cells in one.cells.items():
            for method, cell in cells.items():
                if cell.returns and None not in cell.returns[mode]:
                    lines.setdefault(method, {})[f"{strength:g}"] = floats(cell.returns[mode])
        if lines:
            order, title = [f"{strength:g}" for strength in one.cells], f"{one.name}, {one.setting}"
            target = path.with_name(f"{path.name}-{k}")
            pictures.append(over_setting(lines, target, title, (one.setting, label), order))
    return pictures


def _finished(results: Results) -> dict[str, dict[str, CellResult]]:
    """Return the cells whose seeds all have a return, by panel and variant."""
    finished: dict[str, dict[str, CellResult]] = {}
    for cell in results.cells:
        if cell.returns and None not in cell.returns[results.mode]:
            finished.setdefault(cell.panel, {})[cell.variant] = cell
    return finished
