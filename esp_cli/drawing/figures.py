"""Still pictures of one episode: paths, what is covered when, or the last steps side by side."""

from __future__ import annotations

import math
from io import BytesIO
from itertools import groupby, pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle
from PIL import Image

from esp_cli.drawing.films import Frame, Mark, marks
from esp_cli.drawing.recording import Episode
from esp_envs.drawing import GRID, trails
from esp_envs.scene import Body, Scene

_INCHES = 4.8
_OPACITY = (0.15, 1.0)  # opacity of a path at its beginning and at its end
_PANELS, _COLUMNS = 6, 3  # steps that a strip shows, and how many of them in a row
_NUMBER = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
_MARKERS = {"disc": "o", "ring": "o", "square": "s", "cross": "x"}


def summary(episode: Episode, title: str, size: int, period_s: float) -> Frame:
    """Draw an episode, whose steps take `period_s` seconds, as one picture that is `size` pixels wide."""
    last = episode.scenes[-1]
    title = f"{title}, return {episode.returns[-1]:.1f}"
    if any(body.reach is not None for body in last.bodies):
        figure = coverage(episode, title, size, period_s)
    elif any(body.trail for body in last.bodies):
        figure = paths(episode, title, size)
    else:
        figure = strip(episode, title, size, period_s)
    content = BytesIO()
    figure.savefig(content, format="png")
    return np.asarray(Image.open(content).convert("RGB"))


def paths(episode: Episode, title: str, size: int) -> Figure:
    """Draw the paths of an episode as in figure 6c of the paper: a colour for each body, more opaque with time."""
    figure = Figure(figsize=(_INCHES, _INCHES), dpi=size / _INCHES, layout="constrained")
    axes = _axes(figure.add_subplot(), episode.scenes[-1])
    _title(axes, title)
    _add_paths(axes, episode)
    _add_legend(figure, episode.scenes[-1], started=True)
    return figure


def coverage(episode: Episode, title: str, size: int, period_s: float) -> Figure:
    """Draw the paths of an episode, and below them when each agent covers each body with a reach."""
    last = episode.scenes[-1]
    wanted = [k for k, body in enumerate(last.bodies) if body.reach is not None]
    rows = 0.28 * len(wanted) + 0.75
    figure = Figure(figsize=(_INCHES, _INCHES + rows), dpi=size / _INCHES, layout="constrained")
    above, below = figure.subplots(2, height_ratios=(_INCHES, rows))
    _title(_axes(above, last), title)
    _add_paths(above, episode)
    labels = []
    for row, k in enumerate(wanted):
        x, y = last.bodies[k].position
        reach = last.bodies[k].reach or 0.0
        above.add_patch(Circle((x, y), reach, fill=False, edgecolor="#404040", linestyle=":", zorder=6))
        above.annotate(f"{row + 1}", (x, y), (7, 7), textcoords="offset points", bbox=_NUMBER, zorder=7)
        colors = [_covered_by(scene, k) for scene in episode.scenes[1:]]
        share = sum(color is not None for color in colors) / max(1, episode.steps)
        labels.append(f"{last.bodies[k].label or 'body'} {row + 1}: {share:.0%}")
        start = 0
        for color, run in groupby(colors):
            length = len(list(run))
            if color is not None:
                below.barh(row, length * period_s, left=start * period_s, color=color, height=0.7)
            start += length
    below.set(xlim=(0, episode.steps * period_s), xlabel="time (s): when it is covered, and by whom")
    below.set_yticks(range(len(wanted)), labels)
    below.invert_yaxis()
    below.grid(axis="x", color=GRID)
    below.set_axisbelow(True)
    below.spines[["top", "right"]].set_visible(False)
    _add_legend(figure, last, started=True)
    return figure


def _covered_by(scene: Scene, index: int) -> str | None:
    """Return the colour of the nearest body with a path, or None where none is within reach."""
    body = scene.bodies[index]
    apart = [(math.dist(other.position, body.position), other.color) for other in scene.bodies if other.trail]
    distance, color = min(apart, default=(math.inf, ""))
    return color if distance < (body.reach or 0.0) else None


def strip(episode: Episode, title: str, size: int, period_s: float) -> Figure:
    """Draw the last steps of an episode side by side, with arrows from where bodies were a step before."""
    first = max(0, episode.steps - _PANELS + 1)
    rows = math.ceil((episode.steps - first + 1) / _COLUMNS)
    height = 0.75 + rows * (_INCHES / _COLUMNS + 0.15)
    figure = Figure(figsize=(_INCHES, height), dpi=size / _INCHES, layout="constrained")
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
            _add_body(axes, body)
        for before, body in zip(episode.scenes[max(0, k - 1)].bodies, scene.bodies, strict=True):
            if 0 < math.dist(before.position, body.position) <= 2 * scene.grid[0]:  # not round the torus
                arrow = {"arrowstyle": "->", "color": body.color, "linewidth": 1.2}
                axes.annotate("", body.position, before.position, arrowprops=arrow, zorder=2)
    _add_legend(figure, episode.scenes[-1], started=False)
    return figure


def _title(axes: Axes, title: str) -> None:
    axes.set_title(title, loc="left", fontsize="medium", fontweight="bold", parse_math=False)


def _axes(axes: Axes, scene: Scene) -> Axes:
    x_min, x_max, y_min, y_max = scene.window
    unit = f" ({scene.unit})" if scene.unit else ""
    axes.set(xlim=(x_min, x_max), ylim=(y_min, y_max), xlabel=f"x{unit}", ylabel=f"y{unit}", aspect="equal")
    if scene.grid[1]:  # lines between cells
        spacing, offset = scene.grid
        for low, high, lines in ((x_min, x_max, axes.set_xticks), (y_min, y_max, axes.set_yticks)):
            lines(np.arange(math.ceil((low - offset) / spacing), (high - offset) / spacing + 1e-9) * spacing + offset)
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
        ways = LineCollection(list(pairwise(path)), colors=body.color, alpha=strength, linewidths=2.5, zorder=2)
        ways.set_capstyle("butt")  # others overlap where pieces meet, which shows as dots
        axes.add_collection(ways)
        axes.plot(*path[0], "o", color=body.color, markeredgecolor="white", markersize=7, zorder=4)


def _add_legend(figure: Figure, scene: Scene, *, started: bool) -> None:
    entries = [_entry(mark) for mark in marks(scene)]
    if started:
        entries.append(Line2D([], [], ls="", label="start", marker="o", color="#606060", mec="white", ms=7))
    figure.legend(handles=entries, loc="outside lower center", ncols=max(1, len(entries)), frameon=False)


def _entry(mark: Mark) -> Line2D:
    first, second = mark.colors[0], mark.colors[-1]
    entry = Line2D([], [], ls="", marker=_MARKERS.get(mark.shape, "o"), color=first, ms=8, label=mark.label)
    if mark.shape == "disc" and second != first:
        entry.set(mew=0, fillstyle="left", markerfacecoloralt=second)
    elif mark.shape != "disc":
        entry.set(mew=2, mfc="none" if mark.shape == "ring" else first)
    return entry


def _add_body(axes: Axes, body: Body) -> None:
    """Add a body in the shapes of `esp_envs.drawing`; crosses lie above the others, so that none hides them."""
    (x, y), r = body.position, body.radius
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
