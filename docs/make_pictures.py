"""Draw the pictures of the explanations: scenes under a group, boxes with arrows, and how far elements are trusted.

python docs/make_pictures.py
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from esp_cli.checking.measured import prepared
from esp_cli.symmetry import Element, parse_elements
from esp_cli.symmetry.plane import PlaneElement
from esp_cli.training.config import resolve_config
from esp_envs.scene import COLORS

PICTURES = Path(__file__).parent / "pictures"
AGENTS = np.array([[-0.65, -0.35], [0.1, -0.75], [0.35, 0.5]])
LANDMARKS = np.array([[-0.3, 0.45], [0.75, -0.45], [0.75, 0.8]])
MOVES = np.array([[0.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
NAMES = {"action_turn_rad": "actions turned (rad)", "reward_offset": "reward moved (length)", "mud": "mud (share)"}

STRENGTHS = {
    "action_turn_rad": (0.0, 0.25, 0.5, 1.0, 1.57),
    "reward_offset": (0.0, 0.1, 0.2, 0.3, 0.5),
    "mud": (0.0, 0.25, 0.5, 0.75, 1.0),
    "wind": (0.0, 0.15, 0.3, 0.6, 1.0),
}
"""Settings of navigation that break its symmetry."""
ELEMENTS = {"rot90": "o-", "rot180": "s--", "flip-x": "^-.", "flip-y": "v:", "flip-diagonal": "d-"}
"""What stands for the elements of d4, and how it is drawn."""

Box = tuple[float, float, str]
Arrow = tuple[str, str]

UPDATE: tuple[dict[str, Box], tuple[Arrow, ...]] = (
    {
        "worlds": (0, 1, "environment\nsteps"),
        "batch": (1.2, 1, "batch\n(s, a)"),
        "copies": (2.4, 0, "copies\n$(L_g s, K_g a)$"),
        "networks": (3.6, 1, "policy\nand value"),
        "own": (4.8, 1.7, "the algorithm's\nown loss"),
        "penalty": (4.8, 0.3, "consistency loss\n$c\\,(S_\\pi + S_V)$"),
        "step": (6.0, 1, "gradient\nstep"),
    },
    (
        ("worlds", "batch"),
        ("batch", "copies"),
        ("batch", "networks"),
        ("copies", "networks"),
        ("networks", "own"),
        ("networks", "penalty"),
        ("own", "step"),
        ("penalty", "step"),
    ),
)

ROOMS: tuple[dict[str, Box], tuple[Arrow, ...]] = (
    {
        "commands": (2, 7, "commands"),
        "reporting": (0.4, 6, "reporting"),
        "run": (2, 6, "run"),
        "console": (3.7, 6.5, "console"),
        "loop": (5.0, 5.2, "loop"),
        "bodies": (5.4, 6.2, "bodies"),
        "studies": (0.4, 5, "studies"),
        "drawing": (1.5, 5, "drawing"),
        "export": (2.9, 5, "export"),
        "checking": (4.2, 4.6, "checking"),
        "policies": (2, 4, "policies"),
        "training": (2, 3, "training"),
        "algorithms": (2, 2, "algorithms"),
        "prior": (3.1, 1, "prior"),
        "networks": (2, 1, "networks"),
        "symmetry": (2.6, 0, "symmetry"),
        "files": (0.7, 2, "files"),
        "tasks": (0.7, 1, "esp_envs: tasks"),
        "spec": (1.4, -1, "esp_envs.spec"),
    },
    (
        ("commands", "reporting"),
        ("commands", "run"),
        ("commands", "loop"),
        ("commands", "bodies"),
        ("bodies", "symmetry"),
        ("commands", "console"),
        ("reporting", "studies"),
        ("run", "export"),
        ("run", "drawing"),
        ("studies", "policies"),
        ("export", "policies"),
        ("drawing", "policies"),
        ("checking", "policies"),
        ("policies", "training"),
        ("training", "algorithms"),
        ("training", "files"),
        ("training", "tasks"),
        ("algorithms", "prior"),
        ("algorithms", "networks"),
        ("loop", "prior"),
        ("loop", "checking"),
        ("prior", "symmetry"),
        ("networks", "symmetry"),
        ("symmetry", "spec"),
        ("tasks", "spec"),
    ),
)


def scene(ax: Axes, element: Element, title: str) -> None:
    """Draw agents, landmarks and moves, turned by an element."""
    agents, landmarks, moves = (points @ PlaneElement.of(element).matrix.T for points in (AGENTS, LANDMARKS, MOVES))
    ax.plot(*landmarks.T, "x", color="#444444", markersize=9, markeredgewidth=2)
    for place, move, colour in zip(agents, moves, COLORS, strict=False):
        ax.add_patch(Circle(tuple(place), 0.15, color=colour))
        ax.annotate("", place + 0.55 * move, place, arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 2})
    ax.set(xlim=(-1.25, 1.25), ylim=(-1.25, 1.25), xticks=[], yticks=[], aspect="equal")
    ax.set_title(title, fontsize=10)


def scenes(elements: Sequence[Element], titles: Sequence[str], rows: int) -> Figure:
    """Return a figure of the scene under each element."""
    columns = len(elements) // rows
    figure = Figure(figsize=(2.1 * columns, 2.3 * rows), layout="constrained")
    for ax, element, title in zip(figure.subplots(rows, columns).flat, elements, titles, strict=True):
        scene(ax, element, title)
    return figure


def boxes(nodes: dict[str, Box], arrows: Sequence[Arrow], size: tuple[float, float]) -> Figure:
    """Return a figure of boxes with arrows between them."""
    figure = Figure(figsize=size, layout="constrained")
    ax = figure.subplots()
    style = {"boxstyle": "round,pad=0.5", "facecolor": "#e8eef8", "edgecolor": "#3f51b5"}
    drawn = {name: ax.text(x, y, text, ha="center", va="center", bbox=style) for name, (x, y, text) in nodes.items()}
    for start, end in arrows:
        (x0, y0, _), (x1, y1, _) = nodes[start], nodes[end]
        line = {"arrowstyle": "-|>", "color": "#444444", "shrinkA": 4, "shrinkB": 4}
        line |= {"patchA": drawn[start].get_bbox_patch(), "patchB": drawn[end].get_bbox_patch()}
        ax.annotate("", (x1, y1), (x0, y0), arrowprops=line, zorder=0)
    columns, heights = zip(*((x, y) for x, y, _ in nodes.values()), strict=True)
    ax.set(xlim=(min(columns) - 0.7, max(columns) + 0.7), ylim=(min(heights) - 0.5, max(heights) + 0.5))
    ax.axis("off")
    return figure


def trust() -> Figure:
    """Draw the measured weight of each element over the size of what breaks navigation."""
    figure = Figure(figsize=(8.0, 2.6), layout="constrained")
    axes = figure.subplots(1, len(STRENGTHS), sharey=True)
    for ax, (setting, strengths) in zip(axes, STRENGTHS.items(), strict=True):
        weights = [
            prepared(resolve_config("navigation", overrides={"prior.trust": "measured", f"task.{setting}": size}))
            for size in strengths
        ]
        for k, (name, style) in enumerate(ELEMENTS.items()):
            shown = np.array([run.prior.weights[name] for run in weights]) + 0.012 * (
                2 - k
            )  # apart where they are equal
            ax.plot(strengths, shown, style, label=name, markersize=4, color=COLORS[k])
        ax.set(xlabel=NAMES.get(setting, setting), ylim=(-0.05, 1.05))
        ax.grid(alpha=0.4)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("weight of its copies")
    axes[-1].legend(fontsize=7)
    return figure


def main() -> None:
    """Draw every picture."""
    mpl.rcParams.update({"font.size": 9})
    elements = list(parse_elements("d4", num_agents=1))
    named = {element.name: element for element in elements}
    still, turn = Element(), named["rot90"]
    figures = {
        "turned-scene": scenes([still, turn], ["state $s$, joint action $a$", "rot90: $L_g s$, $K_g a$"], 1),
        "eight-images": scenes([still, *named.values()], ["identity", *named], 2),
        "esp-update": boxes(*UPDATE, size=(8.0, 2.6)),
        "rooms": boxes(*ROOMS, size=(8.0, 6.5)),
        "trust": trust(),
    }
    for name, figure in figures.items():
        figure.savefig(PICTURES / f"{name}.png", dpi=150, metadata={"Software": None})


if __name__ == "__main__":
    main()
