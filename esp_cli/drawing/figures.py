"""Still pictures of one episode: paths, what is covered when, or the last steps side by side."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from io import BytesIO
from itertools import groupby, pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle

from esp_cli.drawing.films import Mark, marks
from esp_cli.drawing.recording import Episode
from esp_cli.files.formatting import escaped
from esp_envs.drawing import GRID, grid_lines, ink, trails
from esp_envs.scene import DARK, Body, Scene, holders

PAPER: dict[Any, Any] = {"font.size": 8, "legend.fontsize": 7, "pdf.fonttype": 42}
"""How figures for print differ: letters of 8 points, embedded as outlines that search and editors know."""
PAPER_DPI = 300
STEADY: dict[Any, Any] = {"svg.hashsalt": "esp", "text.parse_math": False}
"""Identifiers in SVG files are drawn at random unless salted; a dollar sign in a name stays one."""
UNDATED: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}
"""Dates and versions would make every file differ from the last."""
INCHES = 4.8  # width of a picture, unless another is asked for
_ENTRIES_PER_INCH = 0.9  # of a legend, in one row
_OPACITY = (0.15, 1.0)  # strength of a path's colour at its beginning and at its end
_LEAST_LETTER = 0.16  # diameter of a disc that a letter is written on, inches
_BARS, _BAR = 0.75, 0.28  # height of what is below the paths: of axis and legend, and of each bar, inches
_PANELS, _COLUMNS = 6, 3  # steps that a strip shows, and how many of them in a row
_NUMBER = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
_MARKERS = {"disc": "o", "ring": "o", "square": "s", "cross": "x"}


def saved(figure: Figure, kind: str, dpi: float | None = None) -> bytes:
    """Return a figure as PNG, SVG or PDF; an SVG with control characters, as of a task's name, opens nowhere."""
    content = BytesIO()
    figure.savefig(content, format=kind, dpi=dpi, metadata=UNDATED[kind])
    return escaped(content.getvalue().decode()).encode() if kind == "svg" else content.getvalue()


def summary(shown: Sequence[tuple[Episode, str]], period_s: float, width: float = INCHES) -> Figure:
    """Draw episodes with their titles side by side, each `width` inches wide; their steps take `period_s` seconds.

    An episode is drawn as what covers what when, as paths, or as its last steps, whichever its bodies are made for.
    """
    ways, heights = zip(*(_way(episode, width) for episode, _ in shown), strict=True)
    figure = Figure(figsize=(len(shown) * width, max(heights)), layout="constrained")
    parts = figure.subfigures(1, len(shown), squeeze=False)[0]
    for part, way, (episode, title) in zip(parts, ways, shown, strict=True):
        way(part, episode, f"{title}, return {episode.returns[-1]:.1f}", period_s)
    return figure


def _way(episode: Episode, width: float) -> tuple[Callable[[SubFigure, Episode, str, float], None], float]:
    """Return how an episode is drawn, and how high that is at a width, inches."""
    bodies = episode.scenes[-1].bodies
    if wanted := sum(body.reach is not None for body in bodies):
        return coverage, width + _BARS + _BAR * wanted
    if any(body.trail for body in bodies):
        return paths, width
    return strip, 0.75 + math.ceil(min(episode.steps + 1, _PANELS) / _COLUMNS) * (width / _COLUMNS + 0.15)


def paths(figure: SubFigure, episode: Episode, title: str, _: float) -> None:
    """Draw the paths of an episode as in figure 6c of the paper: a colour for each body, stronger with time."""
    _add_paths(_axes(figure.add_subplot(), episode.scenes[-1], title), episode)
    _add_legend(figure, episode.scenes[-1], started=True)


def coverage(figure: SubFigure, episode: Episode, title: str, period_s: float) -> None:
    """Draw the paths of an episode, and below them when each agent covers each body with a reach."""
    last = episode.scenes[-1]
    wanted = [k for k, body in enumerate(last.bodies) if body.reach is not None]
    above, below = figure.subplots(2, height_ratios=(_width(figure), _BARS + _BAR * len(wanted)))
    _add_paths(_axes(above, last, title), episode)
    labels, held = [], [holders(scene) for scene in episode.scenes[1:]]
    for row, k in enumerate(wanted):
        x, y = last.bodies[k].position
        reach = last.bodies[k].reach or 0.0
        above.add_patch(Circle((x, y), reach, fill=False, edgecolor="#404040", linestyle=":", zorder=6))
        number = f" {row + 1}" if len(wanted) > 1 else ""
        above.annotate(number.strip(), (x, y), (7, 7), textcoords="offset points", bbox=_NUMBER, zorder=7)
        by = [now.get(k) for now in held]
        share = sum(holder is not None for holder in by) / max(1, episode.steps)
        labels.append(f"{last.bodies[k].label or 'body'}{number}: {share:.0%}")
        _add_spans(below, row, [None if holder is None else last.bodies[holder] for holder in by], period_s)
    what = last.bodies[wanted[0]].held
    below.set(xlim=(0, episode.steps * period_s), xlabel=f"time (s): when it is {what}, and by whom")
    below.set_yticks(range(len(wanted)), labels)
    below.invert_yaxis()
    below.grid(axis="x", color=GRID)
    below.set_axisbelow(True)
    below.spines[["top", "right"]].set_visible(False)
    _add_legend(figure, last, started=True)


def _add_spans(axes: Axes, row: int, holders: Sequence[Body | None], period_s: float) -> None:
    """Add a bar for each time in which one body holds another, in its colour and with its letter."""
    start = 0
    for who, run in groupby(holders):
        length = len(list(run))
        if who is not None:
            axes.barh(row, length * period_s, left=start * period_s, color=who.color, height=0.7)
            middle = ((start + length / 2) * period_s, row)
            axes.annotate(who.name, middle, color=ink(who.color), ha="center", va="center", fontsize="small")
        start += length


def strip(figure: SubFigure, episode: Episode, title: str, period_s: float) -> None:
    """Draw the last steps of an episode side by side, with arrows from where bodies were a step before."""
    first = max(0, episode.steps - _PANELS + 1)
    rows = math.ceil((episode.steps - first + 1) / _COLUMNS)
    figure.suptitle(title, x=0.02, ha="left", fontsize="medium", fontweight="bold", parse_math=False)
    panels = figure.subplots(rows, _COLUMNS, squeeze=False).flat
    for k, axes in zip(range(first, first + rows * _COLUMNS), panels, strict=True):
        if k > episode.steps:
            axes.axis("off")
            continue
        scene = episode.scenes[k]
        _axes(axes, scene).set(xlabel="", ylabel="", xticklabels=[], yticklabels=[])
        axes.set_title(f"{k * period_s:g} s{', end' if k == episode.steps else ''}", fontsize="small")
        for body in scene.bodies:
            _add_body(axes, body, small=True)
        earlier = episode.scenes[max(0, k - 1)].bodies
        for before, body in zip(earlier, scene.bodies, strict=True) if len(earlier) == len(scene.bodies) else ():
            if 0 < math.dist(before.position, body.position) <= 2 * scene.grid[0]:  # not round the torus
                arrow = {"arrowstyle": "->", "color": body.color, "linewidth": 1.2}
                axes.annotate("", body.position, before.position, arrowprops=arrow, zorder=2)
    _add_legend(figure, episode.scenes[-1], started=False)


def _axes(axes: Axes, scene: Scene, title: str = "") -> Axes:
    axes.set_title(title, loc="left", fontsize="medium", fontweight="bold", parse_math=False)
    x_min, x_max, y_min, y_max = scene.window
    unit = f" ({scene.unit})" if scene.unit else ""
    axes.set(xlim=(x_min, x_max), ylim=(y_min, y_max), xlabel=f"x{unit}", ylabel=f"y{unit}", aspect="equal")
    if scene.grid[1]:  # lines between cells
        for low, high, lines in ((x_min, x_max, axes.set_xticks), (y_min, y_max, axes.set_yticks)):
            lines(grid_lines(low, high, *scene.grid))
        axes.tick_params(length=0)
    axes.grid(color=GRID)
    axes.set_axisbelow(True)
    return axes


def _add_paths(axes: Axes, episode: Episode) -> None:
    last = episode.scenes[-1]
    for body in last.bodies:
        _add_body(axes, body)
    for body, path in trails(last, episode.scenes[:-1]):
        strength = np.linspace(*_OPACITY, len(path) - 1)
        shades = 1 - strength[:, None] * (1 - np.array(to_rgb(body.color)))  # opaque: nothing shows where pieces meet
        ways = LineCollection(list(pairwise(path)), colors=shades, linewidths=2.5, capstyle="round", zorder=2)
        axes.add_collection(ways)
        axes.plot(*path[0], "o", color=body.color, markeredgecolor="white", markersize=7, zorder=4)


def _width(figure: Any) -> float:  # what figures and their parts have in common has no types
    return float(figure.bbox.width / figure.dpi)


def _add_legend(figure: SubFigure, scene: Scene, *, started: bool) -> None:
    entries = [_entry(mark) for mark in marks(scene)]
    if started:
        entries.append(Line2D([], [], ls="", label="start", marker="o", color="#606060", mec="white", ms=7))
    columns = max(1, min(len(entries), round(_ENTRIES_PER_INCH * _width(figure))))
    figure.legend(handles=entries, loc="outside lower center", ncols=columns, frameon=False)


def _entry(mark: Mark) -> Line2D:
    first, second = mark.colors[0], mark.colors[-1]
    entry = Line2D([], [], ls="", marker=_MARKERS.get(mark.shape, "o"), color=first, ms=8, label=mark.label)
    if mark.shape == "disc" and second != first:
        entry.set(mew=0, fillstyle="left", markerfacecoloralt=second)
    elif mark.shape != "disc":
        entry.set(mew=2, mfc="none" if mark.shape == "ring" else first)
    return entry


def _add_body(axes: Axes, body: Body, small: bool = False) -> None:
    """Add a body in the shapes of `esp_envs.drawing`; crosses lie above the others, so that none hides them."""
    (x, y), r = body.position, body.radius
    if body.name and body.shape == "disc":
        on = 2 * r / np.ptp(axes.get_xlim()) * _width(axes.figure) / (_COLUMNS if small else 1) > _LEAST_LETTER
        shift = 0.45 * r if on else 0.0  # crosses lie in the middle
        place, beside = (x - shift, y - shift), (0, 0) if on else (6, 6)
        looks: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": "small", "zorder": 6}
        color = ink(body.color) if on else DARK
        axes.annotate(body.name, place, beside, textcoords="offset points", color=color, **looks)
    if body.shape == "cross":
        across, up = [x - r, x + r, np.nan, x - r, x + r], [y - r, y + r, np.nan, y + r, y - r]
        axes.plot(across, up, color="white", lw=4.5, zorder=5)
        axes.plot(across, up, color=body.color, lw=2.5, zorder=5)
    elif body.shape == "square":
        axes.add_patch(Rectangle((x - r, y - r), 2 * r, 2 * r, facecolor=body.color, zorder=3))
    else:
        filled = body.shape == "disc"
        axes.add_patch(
            Circle((x, y), r, fill=filled, facecolor=body.color, edgecolor=body.color, linewidth=2, zorder=3)
        )
