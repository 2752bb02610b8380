"""Figures of the studies: learning curves with bands over seeds, and means with their intervals and every seed.

Each figure is written as PNG and as SVG, the same bytes for the same numbers. Colours are those of Okabe and Ito, which
people with any common colour blindness can tell apart; curves differ in their line style too.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator
from numpy.typing import ArrayLike

from esp_cli.files.failures import attempting
from esp_cli.files.writing import write_file
from esp_cli.policies.curve_statistics import curve_band
from esp_cli.policies.statistics import bootstrap_interval, mean_and_sem
from esp_envs.errors import UserError

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
"""Okabe and Ito, "Color Universal Design", 2008, without the yellow, too light for lines on white, and a grey."""

LineStyle = str | tuple[int, tuple[int, ...]]

_LINE_STYLES: tuple[LineStyle, ...] = ("-", "--", "-.", (0, (5, 1, 1, 1, 1, 1)))
_LABEL_CHARACTERS = 44
"""Of one line beside the vertical axis."""
_STYLE: dict[Any, Any] = {
    "figure.dpi": 100,
    "savefig.dpi": 150,
    "font.family": ["DejaVu Sans"],
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E5E5E5",
    "axes.axisbelow": True,
    "legend.frameon": False,
    # names are not mathematics: a dollar sign stays one
    "text.parse_math": False,
    # identifiers in SVG files are drawn at random unless salted
    "svg.hashsalt": "esp",
}
_LABEL_GAP = 0.045  # of the height of the axes
CAPTION = "mean and 95 % bootstrap interval over seeds"


@dataclass(frozen=True)
class Curve:
    """One learning curve.

    Attributes:
        label: its name in the legend.
        steps: env steps per seed [K].
        values: [K, S].
    """

    label: str
    steps: ArrayLike
    values: ArrayLike


@dataclass(frozen=True)
class Group:
    """What one run or one variant of a study brought.

    Attributes:
        label: its name on the axis.
        values: one number per seed [S].
    """

    label: str
    values: ArrayLike


def learning_curves(
    curves: Sequence[Curve],
    path: str | os.PathLike[str],
    title: str,
    ylabel: str,
    references: Mapping[str, float] | None = None,
    ylim: tuple[float, float] | None = None,
) -> tuple[Path, Path]:
    """Draw means over seeds with their 95 % bootstrap intervals, beside horizontal lines for numbers of others.

    Args:
        curves: at least one.
        path: where to; ``.png`` and ``.svg`` are appended, or take the place of either.
        title: heading.
        ylabel: what is plotted, with its convention.
        references: dashed lines: name -> value, as of a paper.
        ylim: lowest and highest value in view; by default all of the curves and lines.

    Returns:
        The PNG and the SVG file.

    Raises:
        UserError: no curve, shapes that do not fit, or a file that cannot be written.
    """
    if not curves:
        raise UserError("there is no curve to draw")
    with _figure(path, title) as (figure, axes, files):
        for index, curve in enumerate(curves):
            draw_curve(axes, curve, index)
        if ylim is not None:
            axes.set_ylim(*ylim)
        for value in (references or {}).values():
            axes.axhline(value, linestyle=(0, (8, 4)), color="#333333", linewidth=1.0, zorder=1)
        _label_lines(axes, references or {})
        axes.set_xlabel("environment steps per seed")
        axes.set_ylabel(fill(ylabel, _LABEL_CHARACTERS))
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        # below the axes: inside, it would cover a curve sooner or later
        columns = 2 if len(curves) > 1 else 1
        figure.legend(loc="outside lower left", ncols=columns, title=_caption([np.shape(c.values)[1] for c in curves]))
    return files


def draw_curve(axes: Axes, curve: Curve, index: int) -> None:
    """Draw a curve with its band into axes.

    Args:
        axes: where to.
        curve: the curve.
        index: which colour and line style it has.

    Raises:
        UserError: shapes that do not fit.
    """
    mean, low, high = curve_band(curve.values)
    steps = np.asarray(curve.steps, dtype=np.float64)
    if steps.shape != mean.shape:
        raise UserError(f"the curve '{curve.label}' has {steps.size} steps and {mean.size} evaluations")
    num_seeds = np.shape(curve.values)[1]
    colour, style = appearance(index)
    marker = "o" if steps.size == 1 else None
    label = f"{curve.label} ({_seeds(num_seeds)})"
    axes.plot(steps, mean, color=colour, linestyle=style, linewidth=1.8, marker=marker, label=label)
    if num_seeds > 1:
        axes.fill_between(steps, low, high, color=colour, alpha=0.18, linewidth=0)


def appearance(index: int) -> tuple[str, LineStyle]:
    """Return the colour and the line style of the curve with this index."""
    return PALETTE[index % len(PALETTE)], _LINE_STYLES[index % len(_LINE_STYLES)]


def dots(
    groups: Sequence[Group],
    path: str | os.PathLike[str],
    title: str,
    xlabel: str,
    anchors: Mapping[str, float] | None = None,
) -> tuple[Path, Path]:
    """Draw the mean of each group as a dot with its interval, and every seed as a small one.

    The axis shows the groups and no zero: returns have none, and a bar that begins there would say otherwise.

    Args:
        groups: at least one, drawn from top to bottom.
        path: where to; ``.png`` and ``.svg`` are appended, or take the place of either.
        title: heading.
        xlabel: what is plotted, with its convention.
        anchors: lines where they are in view: name -> value; the legend names the others.

    Returns:
        The PNG and the SVG file.

    Raises:
        UserError: no group, a value that is not finite, or a file that cannot be written.
    """
    if not groups:
        raise UserError("there is no group to draw")
    with _figure(path, title, 2.1 + 0.5 * len(groups)) as (figure, axes, files):
        for index, group in enumerate(groups):
            colour = PALETTE[index % len(PALETTE)]
            mean, _ = mean_and_sem(group.values)
            values = np.asarray(group.values, dtype=np.float64)
            # a fixed spread instead of a random one keeps the seeds apart and the file the same
            spread = np.linspace(-0.18, 0.18, values.size) if values.size > 1 else np.zeros(1)
            axes.plot(values, index + spread, "o", color=colour, markersize=3.5, markeredgewidth=0, alpha=0.45)
            interval = bootstrap_interval(values)
            if interval is not None:
                axes.plot(interval, [index, index], color=colour, linewidth=1.8, marker="|", markersize=10)
            axes.plot([mean], [index], "o", color=colour, markersize=8)
        axes.set_yticks(range(len(groups)), [f"{group.label}\n({_seeds(np.size(group.values))})" for group in groups])
        axes.set_ylim(len(groups) - 0.4, -0.6)
        axes.grid(visible=False, axis="y")
        low, high = axes.get_xlim()
        for index, (name, value) in enumerate((anchors or {}).items()):
            if low <= value <= high:
                style = _LINE_STYLES[(index + 1) % len(_LINE_STYLES)]
                axes.axvline(value, linestyle=style, color="#777777", linewidth=1.2, label=f"{name} {value:g}")
            else:
                axes.plot([], [], " ", label=f"{name} {value:g} (out of view)")
        axes.set_xlim(low, high)
        axes.xaxis.set_major_locator(MaxNLocator(nbins=8))
        caption = _caption([np.size(group.values) for group in groups])
        axes.set_xlabel(f"{xlabel}\n{caption}" if caption else xlabel)
        if anchors:
            figure.legend(loc="outside lower center", ncols=2)
    return files


@contextmanager
def _figure(
    path: str | os.PathLike[str], title: str, height: float = 4.6
) -> Iterator[tuple[Figure, Axes, tuple[Path, Path]]]:
    """Set up a figure with one pair of axes, written at the end."""
    with written_figure(path, (7.2, height)) as (figure, files):
        axes = figure.add_subplot()
        axes.set_title(title, loc="left", fontweight="bold")
        yield figure, axes, files


@contextmanager
def written_figure(
    path: str | os.PathLike[str], size: tuple[float, float]
) -> Iterator[tuple[Figure, tuple[Path, Path]]]:
    """Set up a figure and write it at the end; no pyplot, so that no window and no state of the caller is touched.

    Args:
        path: where to; ``.png`` and ``.svg`` are appended, or take the place of either.
        size: width and height, inches.

    Raises:
        UserError: the files cannot be written.
    """
    path = Path(path)
    stem = path.stem if path.suffix in {".png", ".svg"} else path.name
    png, svg = path.with_name(f"{stem}.png"), path.with_name(f"{stem}.svg")
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=size, layout="constrained")
        yield figure, (png, svg)
        # dates and versions would make every file differ from the last
        for file, metadata in ((png, {"Software": None}), (svg, {"Date": None, "Creator": None})):
            content = BytesIO()
            figure.savefig(content, format=file.suffix[1:], metadata=metadata)
            with attempting("write the figure", file, UserError):
                write_file(file, content.getvalue())


def _label_lines(axes: Axes, lines: Mapping[str, float]) -> None:
    """Write the names of the horizontal lines in view at the right, pushed apart where values are close."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high)
    shown = {name: value for name, value in lines.items() if low <= value <= high}
    heights = _spread([(value - low) / (high - low) for value in shown.values()])
    for (name, value), height in zip(shown.items(), heights, strict=True):
        axes.text(1.01, height, f"{name} {value:g}", transform=axes.transAxes, va="center", fontsize=8)


def _spread(heights: Sequence[float]) -> list[float]:
    """Return heights in the same order, at least a line of text apart, around where they were."""
    order = np.argsort(heights, kind="stable")
    placed = np.array(heights, dtype=np.float64)
    for _ in range(50):
        moved = False
        for below, above in pairwise(order):
            missing = _LABEL_GAP - (placed[above] - placed[below])
            if missing > 1e-9:
                placed[below] -= missing / 2
                placed[above] += missing / 2
                moved = True
        if not moved:
            break
    return placed.tolist()


def _seeds(count: int) -> str:
    return f"{count} seed" if count == 1 else f"{count} seeds"


def _caption(seed_counts: Sequence[int]) -> str | None:
    return CAPTION if max(seed_counts) > 1 else None
