"""Figures of whole studies: the paper's panels of learning curves, and returns over the coefficient (figure 5c)."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter
from numpy.typing import ArrayLike

from esp_cli.policies.statistics import bootstrap_interval, mean_and_sem
from esp_cli.reporting.plots import CAPTION, Curve, appearance, draw_curve, written_figure
from esp_envs.errors import UserError

_PANEL_INCHES = (4.0, 3.2)
_LEGEND_INCHES = 0.8
_MAX_COLUMNS = 3
_JITTER = 0.08
"""Horizontal distance of the lines of `sensitivity`, so that intervals do not lie upon each other."""
_WIDEST = 0.4
"""All lines together, at one value."""
_BELOW_RANDOM = 0.15
"""How far below the random policy a panel of curves goes, as a share of what is above it."""
_NAME_HEIGHT = 0.05
"""Height of an anchor's name as a share of a panel."""


@dataclass(frozen=True)
class Panel:
    """One picture of several.

    Attributes:
        title: heading, such as "navigation, 500k".
        curves: in the order of their colours; the same label has the same colour in every panel.
        anchors: dotted lines: name -> value.
    """

    title: str
    curves: Sequence[Curve]
    anchors: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Sensitivity:
    """Returns over a setting.

    Attributes:
        label: name of the line.
        values: by value of the setting, one number per seed [S].
        paper: by value of the setting, the paper's mean.
    """

    label: str
    values: Mapping[str, ArrayLike]
    paper: Mapping[str, float] = field(default_factory=dict)


def curve_panels(panels: Sequence[Panel], path: str | os.PathLike[str], ylabel: str) -> tuple[Path, Path]:
    """Draw learning curves in panels side by side with one legend, as in figure 4 of the paper.

    Args:
        panels: at least one, each with at least one curve.
        path: where to; ``.png`` and ``.svg`` are appended, or take the place of either.
        ylabel: what is plotted.

    Returns:
        The PNG and the SVG file.

    Raises:
        UserError: nothing to draw, shapes that do not fit, or a file that cannot be written.
    """
    if not panels or not all(panel.curves for panel in panels):
        raise UserError("there is no curve to draw")
    labels = list(dict.fromkeys(curve.label for panel in panels for curve in panel.curves))
    columns = min(len(panels), _MAX_COLUMNS)
    rows = math.ceil(len(panels) / columns)
    width, height = columns * _PANEL_INCHES[0], rows * _PANEL_INCHES[1] + _LEGEND_INCHES
    with written_figure(path, (max(width, 6.0), height)) as (figure, files):
        grid = figure.subplots(rows, columns, squeeze=False)
        handles: dict[str, Artist] = {}
        for axes, panel in zip(grid.flat, panels, strict=False):
            for curve in panel.curves:
                draw_curve(axes, curve, labels.index(curve.label))
                handles.setdefault(curve.label, axes.lines[-1])
            _draw_anchors(axes, panel.anchors)
            axes.set_title(panel.title, loc="left", fontweight="bold")
            axes.set_xlabel("environment steps per seed")
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
        for row in grid:
            row[0].set_ylabel(ylabel)
        figure.legend(
            [handles[label] for label in labels],
            labels,
            loc="outside lower center",
            ncols=min(len(labels), 2 * columns),
            title=CAPTION,
        )
    return files


def _draw_anchors(axes: Axes, anchors: Mapping[str, float]) -> None:
    """Draw a dotted line for each anchor in view, with its name; names that would lie upon each other stand in a row.

    The view ends a little below the random policy: what is worse, as the first greedy policy often is, would press the
    rest of the curves together.
    """
    low, high = axes.get_ylim()
    random = anchors.get("random", low)
    if random < high:
        low = max(low, random - _BELOW_RANDOM * (high - random))
        axes.set_ylim(low, high)
    shown = sorted((value, name) for name, value in anchors.items() if low <= value <= high)
    names: list[tuple[float, str]] = []
    for value, name in shown:
        axes.axhline(value, linestyle=":", color="#777777", linewidth=1.0, zorder=1)
        beside = names and value - names[-1][0] < _NAME_HEIGHT * (high - low)
        names.append((value, f"{names.pop()[1]}, {name}" if beside else name))
    for value, name in names:
        axes.annotate(name, (1.0, value), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=7)


def sensitivity(
    lines: Sequence[Sensitivity],
    path: str | os.PathLike[str],
    title: str,
    xlabel: str,
    ylabel: str,
    order: Iterable[str] = (),
) -> tuple[Path, Path]:
    """Draw returns over a setting, a line for each horizon, with intervals and the paper's means as crosses.

    Args:
        lines: at least one, each with at least one value.
        path: where to; ``.png`` and ``.svg`` are appended, or take the place of either.
        title: heading.
        xlabel: the setting; its values stand at equal distances, as in figure 5c.
        ylabel: what is plotted.
        order: the setting's values from left to right, where not every line has all of them.

    Returns:
        The PNG and the SVG file.

    Raises:
        UserError: nothing to draw, or a file that cannot be written.
    """
    if not lines or not all(line.values for line in lines):
        raise UserError("there is no line to draw")
    known_values = dict.fromkeys(v for line in lines for v in line.values)
    ordered = [value for value in dict.fromkeys([*order, *known_values]) if value in known_values]
    places = {value: k for k, value in enumerate(ordered)}
    with written_figure(path, (6.4, 4.4)) as (figure, files):
        axes = figure.add_subplot()
        apart = min(_JITTER, _WIDEST / len(lines))
        for index, line in enumerate(lines):
            colour, style = appearance(index)
            at = np.array([places[value] for value in line.values]) + apart * (index - (len(lines) - 1) / 2)
            means = np.array([mean_and_sem(values)[0] for values in line.values.values()])
            intervals = [bootstrap_interval(values) for values in line.values.values()]
            axes.plot(at, means, color=colour, linestyle=style, marker="o", label=line.label)
            for x, interval in zip(at, intervals, strict=True):
                if interval is not None:
                    axes.plot([x, x], interval, color=colour, linewidth=1.6)
            known = {places[value]: mean for value, mean in line.paper.items() if value in places}
            if known:
                label = f"paper, {line.label}"
                axes.plot(list(known), list(known.values()), "x", color=colour, markersize=8, label=label)
        axes.set_xticks(range(len(places)), list(places))
        axes.set_title(title, loc="left", fontweight="bold")
        axes.set_xlabel(f"{xlabel}\n{CAPTION}")
        axes.set_ylabel(ylabel)
        figure.legend(loc="outside lower center", ncols=2)
    return files
