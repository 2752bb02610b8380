"""Draw the dot figures of the measurement pages, from their tables and from results: python docs/make_figures.py."""

from __future__ import annotations

import json
import re
import runpy
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from esp_cli.policies.statistics import median_steps
from esp_cli.reporting.figures import appearance, dots
from esp_cli.reporting.results import floats, read_results
from esp_cli.reporting.study_figures import draw_over_setting

DOCS = Path(__file__).parent
join = runpy.run_path(str(DOCS / "fill_tables.py"))["join"]
MEASURED = DOCS / "measured"
COLOUR = "#0072B2"
RESULTS = {
    "ablate-modules": "ablate-modules",
    "ablate-transforms": "ablate-transforms",
    "ablate-transforms-mappo": "ablate-transforms",
    "ablate-transforms-qmix": "ablate-transforms",
}
"""Results in docs/measured -> their figures, of which each learner has one."""
BREAKING = {
    "breaking-navigation-1m": ("", "-wind", "-others"),
    "breaking-predator-prey": ("", "-others"),
    "breaking-formation-1m": ("", "-others"),
}
"""Figures in docs/measured, one for each setting -> how the names of the results go on that are drawn together."""
TUNED = {
    "tuned-navigation": ("tuned-navigation-mappo", "tuned-wide-navigation-maddpg", "tuned-wide-navigation-qmix"),
    "tuned-predator-prey": ("tuned-mappo", "tuned-maddpg", "tuned-qmix"),
}
"""Figures in docs/measured -> the results that are drawn together, those of the figure's task."""
TASKS = ("navigation", "predator-prey", "formation")
"""From top to bottom in the figure of the steps."""
Row = dict[str, str]


@dataclass(frozen=True)
class Panel:
    """One column of one table, drawn as a dot and its standard error (or every seed) for each row.

    Attributes:
        page: Page in docs/measurements.
        first: Header of the table's first column.
        names: Columns whose texts together name a row.
        value: Column that is drawn.
        title: What stands above the panel.
    """

    page: str
    first: str
    names: Sequence[str]
    value: str
    title: str


FIGURES: dict[str, tuple[Panel, ...]] = {
    "wildlife-learners": (
        Panel("wildlife", "policy", ["policy"], "drawn actions", "return with drawn actions"),
        Panel("wildlife", "policy", ["policy"], "greedy return", "greedy return"),
    ),
    "replay": (
        Panel("replay", "learner and copies", ["learner and copies"], "greedy return", "copies, 500k steps"),
        Panel("replay", "", [""], "navigation, 150k", "the horizon, 150k steps"),
    ),
    "speed": (Panel("speed", "layout", ["layout", "seeds"], "seed-steps/s", "seed-steps per second"),),
}
"""Figure in docs/measured -> its panels."""


def table(panel: Panel) -> list[Row]:
    """Return the rows of the table that has a panel's columns.

    Raises:
        ValueError: no table of the page has them.
    """
    text = (DOCS / "measurements" / f"{panel.page}.md").read_text(encoding="utf-8")
    for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        cells = [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in block.splitlines()]
        if cells[0][0] == panel.first and panel.value in cells[0]:
            return [dict(zip(cells[0], row, strict=True)) for row in cells[2:]]
    raise ValueError(f"docs/measurements/{panel.page}.md has no table with the column '{panel.value}'")


def numbers(cell: str) -> tuple[float, float, list[float]]:
    """Return mean, standard error and, where a cell lists them, the seeds of a cell such as '-1.5 ± 0.2' or '3, 4'."""
    text = re.sub(r"\(.*|\*", "", cell).replace("−", "-")
    found = [float(number.replace(",", "")) for number in re.findall(r"-?\d[\d,]*\.?\d*", text.replace(", ", " "))]
    if "±" in text:
        return found[0], found[1], []
    return sum(found) / len(found), 0.0, found if len(found) > 1 else []


def draw(ax: Axes, panel: Panel) -> None:
    """Draw a panel: the first row of the table on top."""
    rows = [row for row in table(panel) if row[panel.value]]
    for place, row in enumerate(reversed(rows)):
        mean, error, seeds = numbers(row[panel.value])
        ax.errorbar(mean, place, xerr=error or None, fmt="o", color=COLOUR, capsize=3)
        ax.plot(seeds, [place] * len(seeds), "|", color=COLOUR)
    labels = [re.sub(r"[*`]", "", ", ".join(row[name] for name in panel.names if row[name])) for row in rows]
    ax.set_yticks(range(len(rows)), labels[::-1])
    ax.set_ylim(-0.6, len(rows) - 0.4)
    ax.set_title(panel.title, loc="left", fontsize=10)
    ax.grid(axis="x", alpha=0.4)
    ax.spines[["top", "right"]].set_visible(False)


def draw_results() -> None:
    """Draw the returns of the ablations, over the coefficient and over the strength of breaking, from their results."""
    for name, picture in RESULTS.items():
        results = read_results(MEASURED / f"{name}.json")
        for panel in dict.fromkeys(cell.panel for cell in results.cells):
            cells = [cell for cell in results.cells if cell.panel == panel]
            groups = {cell.variant: floats(cell.returns[results.mode]) for cell in cells}
            learner = cells[0].name.split("-")[1]
            drawn = dots(groups, MEASURED / f"{picture}-{learner}", panel, f"{results.mode} return", cells[0].anchors)
            drawn.with_suffix(".svg").unlink()  # the pages show PNGs
    for picture, names in TUNED.items():
        searches, task = [read_results(MEASURED / f"{name}.json") for name in names], picture.removeprefix("tuned-")
        groups = {
            f"{name.rpartition('-')[2].upper()}, {cell.panel.rpartition(', ')[2]}: {cell.variant}": floats(
                cell.returns[search.mode]
            )
            for name, search in zip(names, searches, strict=True)
            for cell in search.cells
            if cell.panel.startswith(task)
        }
        title = f"{task.capitalize()}, tuned settings"
        dots(groups, MEASURED / picture, title, f"{searches[0].mode} return").with_suffix(".svg").unlink()
    for picture, parts in {"ablate-coefficient": ("",), **BREAKING}.items():
        whole = join([read_results(MEASURED / f"{picture}{part}.json") for part in parts])
        for drawn in draw_over_setting(whole, MEASURED / picture):
            drawn.with_suffix(".svg").unlink()


def draw_steps() -> None:
    """Draw the steps to what the plain learner ends with, as a share of its run: median seeds and their intervals."""
    cells = join([read_results(MEASURED / f"{name}.json") for name in ("table1", "table1-3m")]).cells
    pairs = [(cell, other) for cell in cells for other in cells if other.name == cell.reference and cell.steps_to]
    pairs.sort(key=lambda pair: (-TASKS.index(str(pair[0].config["task"])), -pair[0].steps, pair[0].variant))
    figure = Figure(figsize=(8.0, 1.2 + 0.24 * len(pairs)), layout="constrained")
    ax = figure.subplots()
    for place, pair in enumerate(pairs):
        looks = ((COLOUR, "with the prior", 0.15), ("#777777", "plain", -0.15))
        for cell, (colour, label, shift) in zip(pair, looks, strict=True):
            median, interval = median_steps(cell.steps_to[0].per_seed)
            ends = [min(steps / cell.step, 2.0) for steps in interval or (median, median)]  # 2 is out of view
            ax.plot(ends, [place + shift] * 2, color=colour, linewidth=1.8, marker="|", markersize=7)
            named = None if place else label
            ax.plot([min(median / cell.step, 1.2)], [place + shift], "o", color=colour, markersize=6, label=named)
    ax.set_xscale("log")
    ax.set_xlim(0.014, 1.4)
    ax.set_xticks([1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1], ["1/64", "1/32", "1/16", "1/8", "1/4", "1/2", "1"])
    ax.minorticks_off()
    ax.set_yticks(range(len(pairs)), [f"{cell.panel}: {other.variant}" for cell, other in pairs])
    ax.set_ylim(-0.6, len(pairs) - 0.4)
    ax.grid(axis="x", alpha=0.4)
    ax.spines[["top", "right"]].set_visible(False)
    ax.set_xlabel("steps to the return that the plain learner ends with, as a share of its run; right of 1: never")
    figure.legend(loc="outside upper right", ncols=2)
    figure.savefig(MEASURED / "steps-saved.png", dpi=150, metadata={"Software": None})


def draw_peers() -> None:
    """Draw the returns of training over steps and over seconds, a line a seed, each point the mean over 6000 steps."""
    figure = Figure(figsize=(8.0, 3.8), layout="constrained")
    both = figure.subplots(1, 2, sharey=True)
    runs = json.loads((MEASURED / "peers-spread.json").read_text(encoding="utf-8"))
    labels = list(dict.fromkeys(name.rsplit(", seed ", 1)[0] for name in runs))
    for name, rows in runs.items():
        label, seed = name.rsplit(", seed ", 1)
        named = label if seed == "0" else None
        points = np.array([np.mean([*block], 0) for _, block in groupby(rows, lambda row: (row[0] - 1) // 6000)])
        colour, dashes = appearance(labels.index(label))
        for ax, x in zip(both, points.T, strict=False):
            ax.plot(x, points[:, 2], color=colour, linestyle=dashes, linewidth=1.0, label=named)
    for ax, label in zip(both, ("environment steps", "seconds"), strict=True):
        ax.set_xlabel(label)
        ax.grid(alpha=0.4)
        ax.spines[["top", "right"]].set_visible(False)
    both[0].set_ylabel("return in training")
    both[0].xaxis.set_major_formatter(EngFormatter(sep=""))
    both[1].set_xscale("log")
    figure.legend(*both[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.savefig(MEASURED / "peers-spread.png", dpi=150, metadata={"Software": None})


def main() -> None:
    """Draw every figure."""
    draw_results()
    mpl.rcParams.update({"font.size": 9, "svg.hashsalt": "esp"})
    draw_steps()
    draw_peers()
    for name, panels in FIGURES.items():
        heights = [len(table(panel)) + 2 for panel in panels]
        figure = Figure(figsize=(8.0, 0.25 * sum(heights)), layout="constrained")
        axes = figure.subplots(len(panels), 1, squeeze=False, height_ratios=heights)[:, 0]
        for ax, panel in zip(axes, panels, strict=True):
            draw(ax, panel)
        if name != "speed":
            axes[-1].set_xlabel("mean and standard error over seeds")
        figure.savefig(MEASURED / f"{name}.png", dpi=150, metadata={"Software": None})


if __name__ == "__main__":
    main()
