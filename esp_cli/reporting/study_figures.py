"""Which figures a report has: learning curves with bands over seeds, returns as dots or over what a study varies."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter

from esp_cli.policies.statistics import curve_band
from esp_cli.reporting.collect import Material, RunCurve
from esp_cli.reporting.figures import Style, appearance, caption, dots, over_setting, written_figure
from esp_cli.reporting.results import CellResult, Results, floats
from esp_cli.studies.kinds import UNBROKEN, kind_of

_ONE_PANEL, _PANEL = (7.2, 4.2), (4.0, 3.2)  # width and height of a panel, inches
_LEGEND_INCHES = 0.8
_MAX_COLUMNS = 3
_LABEL_CHARACTERS = 44  # of one line beside the vertical axis
_BELOW_RANDOM = 0.15  # how far below the random policy a panel of curves goes, as a share of what is above it
_NAME_HEIGHT = 0.05  # height of a level's name as a share of a panel


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


def draw_curves(material: Material, path: Path, style: Style = "screen") -> Path:
    """Draw the learning curves by panel, with the anchors of a run that has its final evaluation."""
    results, panels = material.results, dict[tuple[int, ...], Panel]()
    for name in dict.fromkeys(cell.panel for cell in results.cells):
        cells = [cell for cell in results.cells if cell.panel == name and cell.name in material.curves]
        drawn = [material.curves[cell.name] for cell in cells]
        anchors: dict[str, float] = next((dict(cell.anchors) for cell in cells if cell.anchors), {})
        if kind_of(results.kind).network_cost:
            anchors |= {f"paper {cell.variant}": cell.paper[0] for cell in cells if cell.paper}
        if drawn:
            title = name if cells[0].at is None else drawn[0].config.task
            title = title.rpartition(":")[2]  # of a task of the caller, the class
            panels.setdefault(tuple(map(id, drawn)), Panel(title, drawn, anchors))
    conventions = {cell.convention for cell in results.cells if cell.convention}
    convention = f" ({conventions.pop()})" if len(conventions) == 1 and len(panels) == 1 else ""
    return learning_curves([*panels.values()], path, f"{results.mode} return{convention}", style)


def draw_variants(results: Results, out: Path, style: Style = "screen") -> list[Path]:
    """Draw the returns of a study of variants into a folder, over what it varies where that has an order."""
    if results.rows == "panels":
        return []
    if results.kind == "ablate-coefficient" or kind_of(results.kind).breakings:
        stem = "coefficient" if results.kind == "ablate-coefficient" else "breaking"
        return draw_over_setting(results, out / stem, style)
    pictures = []
    for k, (panel, cells) in enumerate(_finished(results).items(), 1):
        groups = {variant: floats(cell.returns[results.mode]) for variant, cell in cells.items()}
        anchors = next(iter(cells.values())).anchors
        pictures.append(dots(groups, out / f"returns-{k}", panel, f"{results.mode} return", anchors, style))
    return pictures


def draw_over_setting(results: Results, path: Path, style: Style = "screen") -> list[Path]:
    """Draw returns over the weight of the consistency loss, or over strengths of breaking: `path`-1, `path`-2."""
    label, mode = f"{results.mode} return", results.mode
    if results.kind == "ablate-coefficient":
        panels = _finished(results)
        lines = {
            panel: {name: floats(cell.returns[mode]) for name, cell in own.items()} for panel, own in panels.items()
        }
        paper = {p: {name: cell.paper[0] for name, cell in own.items() if cell.paper} for p, own in panels.items()}
        title, order = "Return over the weight of the consistency loss", [cell.variant for cell in results.cells]
        return [over_setting(lines, path, title, ("weight", label), order, paper, style)] if lines else []
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
            pictures.append(over_setting(lines, target, title, (one.setting, label), order, style=style))
    return pictures


@dataclass(frozen=True)
class Panel:
    """One pair of axes of learning curves."""

    title: str  # heading, such as "navigation, 500k"
    curves: Sequence[RunCurve]  # in the order of their colours; the same label has the same colour in every panel
    anchors: Mapping[str, float] = field(default_factory=dict)  # dotted lines where they are in view: name -> value


def learning_curves(
    panels: Sequence[Panel], path: str | os.PathLike[str], ylabel: str, style: Style = "screen"
) -> Path:
    """Draw means over seeds with their 95 % bootstrap intervals, in panels with one legend, as in figure 4."""
    labels = list(dict.fromkeys(curve.label for panel in panels for curve in panel.curves))
    columns = min(len(panels), _MAX_COLUMNS)
    rows = math.ceil(len(panels) / columns)
    width, height = _ONE_PANEL if len(panels) == 1 else _PANEL
    with written_figure(path, (max(columns * width, 6.0), rows * height + _LEGEND_INCHES), style) as (figure, png):
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes, panel in zip(grid.flat, panels, strict=False):
            for curve in panel.curves:
                _draw_curve(axes, curve, labels.index(curve.label))
            _draw_levels(axes, panel)
            axes.set_title(panel.title, loc="left", fontweight="bold")
            axes.set_xlabel("environment steps per seed")
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
        for row in grid:
            row[0].set_ylabel(fill(ylabel, _LABEL_CHARACTERS))
        handles = {label: line for axes in grid.flat for line in axes.lines if (label := line.get_label()) in labels}
        counts = [np.shape(curve.values)[1] for panel in panels for curve in panel.curves]
        figure.legend(
            [handles[label] for label in labels],
            labels,
            loc="outside lower center",
            ncols=min(len(labels), 2 * columns),
            title=caption(counts),
        )
    return png


def _finished(results: Results) -> dict[str, dict[str, CellResult]]:
    finished: dict[str, dict[str, CellResult]] = {}
    for cell in results.cells:
        if cell.returns and None not in cell.returns[results.mode]:
            finished.setdefault(cell.panel, {})[cell.variant] = cell
    return finished


def _draw_curve(axes: Axes, curve: RunCurve, index: int) -> None:
    mean, low, high = curve_band(curve.values)
    steps = np.asarray(curve.steps, dtype=np.float64)
    colour, style = appearance(index)
    marker = "o" if steps.size == 1 else None
    axes.plot(steps, mean, color=colour, linestyle=style, linewidth=1.8, marker=marker, label=curve.label)
    if np.shape(curve.values)[1] > 1:
        axes.fill_between(steps, low, high, color=colour, alpha=0.18, linewidth=0)


def _draw_levels(axes: Axes, panel: Panel) -> None:
    """Draw the horizontal lines in view with their names; names that would lie upon each other stand in a row."""
    low, high = axes.get_ylim()
    random = panel.anchors.get("random", low)
    if random < high:
        low = max(low, random - _BELOW_RANDOM * (high - random))
    axes.set_ylim(low, high)
    levels = [(value, name) for name, value in panel.anchors.items() if low <= value <= high]
    names: list[tuple[float, str]] = []
    for value, name in sorted(levels):
        beside = names and value - names[-1][0] < _NAME_HEIGHT * (high - low)
        names.append((value, f"{names.pop()[1]}, {name}" if beside else name))
    for value, name in names:
        axes.annotate(name, (1.0, value), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=7)
    for value, _ in levels:
        axes.axhline(value, linestyle=":", color="#777777", linewidth=1.0, zorder=1)
