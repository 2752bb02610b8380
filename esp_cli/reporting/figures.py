"""Figures: how one is written, and those of returns, as means with every seed or over a setting.

Each is written as PNG and as SVG, for print as PDF too, the same bytes for the same numbers. Colours are those of
films, which the colour-blind tell apart; curves differ in their line style too.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from esp_cli.drawing.figures import PAPER, PAPER_DPI, STEADY, saved
from esp_cli.files.formatting import attempting, format_span
from esp_cli.files.writing import write_file
from esp_cli.policies.statistics import bootstrap_interval, mean_and_sem
from esp_envs.scene import COLORS

LineStyle = str | tuple[int, tuple[int, ...]]

_LINE_STYLES: tuple[LineStyle, ...] = ("-", "--", "-.", (0, (5, 1, 1, 1, 1, 1)))
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
    **STEADY,
}
Style = Literal["screen", "paper"]
COLUMN, PAGE = 3.5, 7.2  # width of a figure for print, of one column or two, inches
_ONE_COLUMN, _LEAST_SHARE = 7.5, 0.6
"""Width up to which a figure takes one column in print, inches, and the least share of its height that it keeps."""
_JITTER = 0.08  # horizontal distance of the lines of `over_setting`, so that intervals do not lie upon each other
_WIDEST = 0.4  # all lines together, at one value


def dots(
    groups: Mapping[str, ArrayLike],
    path: str | os.PathLike[str],
    title: str,
    xlabel: str,
    anchors: Mapping[str, float] | None = None,
    style: Style = "screen",
) -> Path:
    """Draw the mean of each group [S] as a dot with its interval, and every seed as a small one, from top to bottom.

    The axis shows the groups and no zero: returns have none, and a bar that begins there would say otherwise. Anchors
    are lines where they are in view; the legend names the others. For path and style see `written_figure`.
    """
    with written_figure(path, (7.2, 2.1 + 0.5 * len(groups)), style) as (figure, png):
        axes = _titled(figure, title)
        for index, group in enumerate(groups.values()):
            colour, values = COLORS[index % len(COLORS)], np.asarray(group, dtype=np.float64)
            mean, _ = mean_and_sem(values)
            # a fixed spread instead of a random one keeps the seeds apart and the file the same
            spread = np.linspace(-0.18, 0.18, values.size) if values.size > 1 else np.zeros(1)
            axes.plot(values, index + spread, "o", color=colour, markersize=3.5, markeredgewidth=0, alpha=0.45)
            interval = bootstrap_interval(values)
            if interval is not None:
                axes.plot(interval, [index, index], color=colour, linewidth=1.8, marker="|", markersize=10)
            axes.plot([mean], [index], "o", color=colour, markersize=8)
        counts = [np.size(group) for group in groups.values()]
        names = [f"{label}\n({count} seed{'s'[: count - 1]})" for label, count in zip(groups, counts, strict=True)]
        axes.set_yticks(range(len(groups)), names)
        axes.set_ylim(len(groups) - 0.4, -0.6)
        axes.grid(visible=False, axis="y")
        low, high = axes.get_xlim()
        for index, (name, value) in enumerate((anchors or {}).items()):
            label = f"{name} {round(value, 2):g}"
            if low <= value <= high:
                dashes = _LINE_STYLES[(index + 1) % len(_LINE_STYLES)]
                axes.axvline(value, linestyle=dashes, color="#777777", linewidth=1.2, label=label)
            else:
                axes.plot([], [], " ", label=f"{label} (out of view)")
        axes.set_xlim(low, high)
        axes.xaxis.set_major_locator(MaxNLocator(nbins=8))
        axes.set_xlabel("\n".join(filter(None, (xlabel, caption(counts)))))
        if anchors:
            figure.legend(loc="outside lower center", ncols=2)
    return png


def over_setting(
    lines: Mapping[str, Mapping[str, ArrayLike]],
    path: str | os.PathLike[str],
    title: str,
    labels: tuple[str, str],
    order: Iterable[str] = (),
    paper: Mapping[str, Mapping[str, float]] | None = None,
    style: Style = "screen",
) -> Path:
    """Draw returns over a setting as lines with intervals, and the paper's means as crosses.

    A line has by value of the setting one number per seed [S], the paper one mean. Values stand in `order` at equal
    distances, as in figure 5c; labels are of the setting and the plot. For the path see `written_figure`.
    """
    known = dict.fromkeys(value for line in lines.values() for value in line)
    places = {value: k for k, value in enumerate(v for v in dict.fromkeys([*order, *known]) if v in known)}
    apart = min(_JITTER, _WIDEST / len(lines))
    with written_figure(path, (6.4, 4.4), style) as (figure, png):
        axes = _titled(figure, title)
        for index, (name, line) in enumerate(lines.items()):
            colour, dashes = appearance(index)
            at = [places[value] + apart * (index - (len(lines) - 1) / 2) for value in line]
            means = [mean_and_sem(values)[0] for values in line.values()]
            axes.plot(at, means, color=colour, linestyle=dashes, marker="o", label=name)
            for x, values in zip(at, line.values(), strict=True):
                if (interval := bootstrap_interval(values)) is not None:
                    axes.plot([x, x], interval, color=colour, linewidth=1.6)
            theirs = {places[value]: mean for value, mean in (paper or {}).get(name, {}).items() if value in places}
            if theirs:
                axes.plot([*theirs], [*theirs.values()], "x", color=colour, markersize=8, label=f"paper, {name}")
        axes.set_xticks(range(len(places)), list(places))
        counts = [np.size(values) for line in lines.values() for values in line.values()]
        axes.set_xlabel("\n".join(filter(None, (labels[0], caption(counts)))))
        axes.set_ylabel(labels[1])
        figure.legend(loc="outside lower center", ncols=2)
    return png


def appearance(index: int) -> tuple[str, LineStyle]:
    """Return the colour and the line style of the curve with this index; 32 of them differ."""
    around = index // len(COLORS)
    return COLORS[index % len(COLORS)], _LINE_STYLES[(index + around) % len(_LINE_STYLES)]


@contextmanager
def written_figure(
    path: str | os.PathLike[str], size: tuple[float, float], style: Style = "screen"
) -> Iterator[tuple[Figure, Path]]:
    """Set up a figure of a size in inches and write it at the end, as PNG, whose path comes with it, and as SVG.

    ``.png`` and ``.svg`` are appended to the path, or take the place of either. For print it is a column or a page wide
    instead, with small letters, and a PDF too.
    """
    path = Path(path)
    stem = path.stem if path.suffix in {".png", ".svg", ".pdf"} else path.name
    png = path.with_name(f"{stem}.png")
    for_print = style == "paper"
    if for_print:
        share = (PAGE if size[0] > _ONE_COLUMN else COLUMN) / size[0]
        size = (size[0] * share, size[1] * max(share, _LEAST_SHARE))
    with mpl.rc_context({**_STYLE, **(PAPER | {"savefig.dpi": PAPER_DPI} if for_print else {})}):
        figure = Figure(figsize=size, layout="constrained")
        yield figure, png
        for kind in ("png", "svg", *(["pdf"] if for_print else [])):
            content, file = saved(figure, kind), png.with_suffix(f".{kind}")
            with attempting("write the figure", file):
                write_file(file, content)


def _titled(figure: Figure, title: str) -> Axes:
    axes = figure.add_subplot()
    axes.set_title(title, loc="left", fontweight="bold")
    return axes


def caption(counts: Sequence[int]) -> str | None:
    """Say what the bands and lines are; None where every run has one seed, and so none of them."""
    return f"mean and 95 % bootstrap interval over {format_span(counts)} seeds" if max(counts) > 1 else None
