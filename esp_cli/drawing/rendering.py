"""Pictures of a policy at work, off-screen: what happens is recorded first, then drawn as a film or a still picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle

from esp_cli.drawing.films import Frame, write_gif, write_mp4, write_png
from esp_cli.files.writing import write_file
from esp_cli.training.loading import TrainedPolicy
from esp_cli.training.play import PolicyController
from esp_cli.training.streams import generators
from esp_envs.base import Environment
from esp_envs.drawing import GRID, TopPainter, trails
from esp_envs.scene import Body, Painter, Scene
from esp_envs.spec import TaskSpec

View = Literal["auto", "top", "3d"]

FRAMES_PER_SECOND = 25
"""Of a film, at most, unless more are asked for."""
_DEFAULT_EPISODES, _DEFAULT_SECONDS = 3, 30.0
"""A film shows three episodes, or as many as last half a minute, but at least one."""
_FIGURE_INCHES = 4.8
_OPACITY = (0.15, 1.0)
"""Of a way at its beginning and at its end."""
_MARKS = ((5, "start"), (9, "end"))
"""Marker size in points, and what it marks."""
_SAMPLED_FRAMES = 8
"""Frames that the palette of a GIF is made for."""


def default_episodes(spec: TaskSpec) -> int:
    """Return how many episodes a film of this task shows."""
    fitting = int(_DEFAULT_SECONDS / (spec.horizon * spec.control_period_s) + 1e-9)
    return max(1, min(_DEFAULT_EPISODES, fitting))


@torch.no_grad()
def record(
    trained: TrainedPolicy, env: Environment, seed: int, episodes: int, greedy: bool = True
) -> list[list[Scene]]:
    """Play episodes of one seed's policy and keep what there is to draw.

    Args:
        trained: the policies of a run.
        env: one world per seed of the run.
        seed: which of the run's seeds acts.
        episodes: played one after the other.
        greedy: act greedily, or draw actions.

    Returns:
        The scenes of each episode: its start and every step, up to the one that ends it.

    Raises:
        ValueError: the run has no such seed.
    """
    seeds = trained.config.seeds
    if seed not in seeds:
        raise ValueError(f"{trained.source} has no seed {seed}; it has {', '.join(map(str, seeds))}")
    world = (seeds.index(seed), 0)
    noise = None if greedy else generators(seeds, "film", "noise")
    controller = PolicyController(trained.policy, noise)
    recorded = []
    for _ in range(episodes):
        observation = env.reset()
        controller.begin(env, observation)
        scenes = [env.scene(world)]
        for _ in range(env.spec.horizon):
            step = env.step(controller.act(env, observation))
            observation = step.next
            ended = bool((step.terminated | step.truncated)[world])
            if ended and step.final is not None:
                env.set_state(step.final.state)  # the world has reset itself; show how the episode ended
            scenes.append(env.scene(world))
            if ended:
                break
        recorded.append(scenes)
    return recorded


@contextmanager
def open_painter(env: Environment, view: View, size: int) -> Iterator[Painter]:
    """Open what draws this task.

    Args:
        env: the task.
        view: "top" is the view from above, "3d" the task's own view in space, "auto" the latter where there is one and
            the machine can draw it (else the painter's note says why not).
        size: of the longer side, pixels.

    Raises:
        ValueError: "3d", and the task has no view in space or the machine cannot draw it.
    """
    own = None if view == "top" else env.painter(size)
    if own is None and view == "3d":
        raise ValueError(f"{env.spec.name} is a flat task without a view in space; leave out --view 3d")
    with ExitStack() as stack:
        painter: Painter = TopPainter(size)
        if own is not None:
            try:
                painter = stack.enter_context(own)
            except ValueError as error:
                if view == "3d":
                    raise
                painter = TopPainter(size, note=f"{error}; so the view is from above")
        yield painter


@dataclass(frozen=True)
class Shot:
    """One frame to draw: a scene after those that its trails come from, and how many steps it stays in view."""

    scenes: Sequence[Scene]
    steps: int

    def draw(self, painter: Painter) -> Frame:
        """Draw the last scene with the trails of all."""
        return painter.draw(self.scenes[-1], self.scenes[:-1])


def stride(control_period_s: float, speed: float, frames_per_second: float) -> int:
    """Return the number of steps from one frame to the next: the smallest that keeps to the frame rate."""
    return max(1, math.ceil(speed / (control_period_s * frames_per_second) - 1e-9))


def shots(episodes: Iterable[Sequence[Scene]], every: int) -> list[Shot]:
    """Choose every so-many-th scene of each episode, its first and its last among them."""
    chosen = []
    for scenes in episodes:
        shown = sorted({*range(0, len(scenes), every), len(scenes) - 1})
        following = [*shown[1:], len(scenes)]
        chosen += [Shot(scenes[: k + 1], after - k) for k, after in zip(shown, following, strict=True)]
    return chosen


def write_film(
    path: Path, painter: Painter, taken: Sequence[Shot], step_s: float, watch: Callable[[int], None]
) -> None:
    """Draw a film and write it as an MP4 where the file is named so, else as a GIF.

    Args:
        path: where to.
        painter: draws the shots.
        taken: the shots, in their order.
        step_s: how long one step is in view, s.
        watch: told how many frames are drawn, after each.
    """

    def draw() -> Iterator[Frame]:
        for done, shot in enumerate(taken, 1):
            yield shot.draw(painter)
            watch(done)

    if path.suffix.lower() == ".mp4":
        write_mp4(path, draw(), 1 / (taken[0].steps * step_s))
    else:
        sample = [shot.draw(painter) for shot in taken[:: math.ceil(len(taken) / _SAMPLED_FRAMES)]]
        write_gif(path, draw(), [shot.steps * step_s for shot in taken], sample)


def write_picture(path: Path, painter: Painter, scenes: Sequence[Scene], title: str, size: int) -> None:
    """Write one episode as a PNG: from above a figure of its trajectories, in space its end with the trails.

    Args:
        path: where to.
        painter: as `open_painter` chose it.
        scenes: of the episode.
        title: above a figure.
        size: of the longer side, pixels.
    """
    if isinstance(painter, TopPainter):
        content = BytesIO()
        trajectories(scenes, title, size).savefig(content, format="png", metadata={"Software": None})
        write_file(path, content.getvalue())
    else:
        write_png(path, painter.draw(scenes[-1], scenes[:-1]))


def trajectories(scenes: Sequence[Scene], title: str, size: int) -> Figure:
    """Draw the ways of a whole episode as in figure 6c of the paper: a colour for each body, more opaque with time.

    Args:
        scenes: of one episode.
        title: above the axes.
        size: width of the figure, pixels.
    """
    last = scenes[-1]
    figure = Figure(figsize=(_FIGURE_INCHES, _FIGURE_INCHES), dpi=size / _FIGURE_INCHES, layout="constrained")
    axes = figure.add_subplot(aspect="equal", xlim=last.window[:2], ylim=last.window[2:], xlabel="x", ylabel="y")
    axes.set_title(title, loc="left", fontsize="medium", fontweight="bold", parse_math=False)
    axes.grid(color=GRID)
    axes.set_axisbelow(True)
    for body in last.bodies:
        _add_body(axes, body)
    for body, path in trails(last, scenes[:-1]):
        strength = np.linspace(*_OPACITY, len(path) - 1)
        ways = LineCollection(list(pairwise(path)), colors=body.color, alpha=strength, linewidths=2.5, zorder=2)
        ways.set_capstyle("butt")  # others overlap where pieces meet, which shows as dots
        axes.add_collection(ways)
        axes.plot(*path[0], "o", color=body.color, markeredgecolor="white", markersize=7, zorder=4)
    entries = [Line2D([], [], ls="", marker="o", color="#606060", ms=ms, label=text) for ms, text in _MARKS]
    if any(body.model == "goal" for body in last.bodies):
        entries.append(Line2D([], [], ls="", marker="o", color="#606060", mfc="none", mew=2, ms=9, label="goal"))
    figure.legend(handles=entries, loc="outside lower center", ncols=len(entries), frameon=False)
    return figure


def _add_body(axes: Axes, body: Body) -> None:
    """Add a body as it is at the end of the episode, in the shapes of `esp_envs.drawing`."""
    (x, y), r = body.position, body.radius
    if body.shape == "cross":
        axes.plot([x - r, x + r, np.nan, x - r, x + r], [y - r, y + r, np.nan, y + r, y - r], color=body.color, lw=2.5)
    elif body.shape == "square":
        axes.add_patch(Rectangle((x - r, y - r), 2 * r, 2 * r, facecolor=body.color, zorder=3))
    else:
        filled = body.shape == "disc"
        axes.add_patch(
            Circle((x, y), r, fill=filled, facecolor=body.color, edgecolor=body.color, linewidth=2, zorder=3)
        )
