"""Drawing a trained policy at work into a file: a film, or the trajectories of one episode."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from esp_cli.drawing import films, rendering
from esp_cli.training.build import build_environment
from esp_cli.training.loading import TrainedPolicy

FILMS, PICTURE = (".gif", ".mp4"), ".png"


@dataclass(frozen=True)
class Drawing:
    """What was drawn.

    Attributes:
        path: the file.
        frames: of a film; of a picture, 1.
        steps: of all episodes.
        note: a sentence for the user about how it was drawn, or None.
    """

    path: Path
    frames: int
    steps: int
    note: str | None


def check_target(out: Path, episodes: int | None) -> str:
    """Return the ending of a file that can be drawn into.

    Raises:
        ValueError: another ending, or more episodes than a picture holds.
        OSError: the file is a folder.
    """
    kind = out.suffix.lower()
    if kind not in (*FILMS, PICTURE):
        raise ValueError(f"cannot write {out}: name a .gif, .mp4 or .png file")
    if kind == PICTURE and episodes is not None and episodes > 1:
        raise ValueError(f"{out} holds one episode; leave out --episodes {episodes} or name a .gif file")
    if out.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(out))
    return kind


def draw(
    trained: TrainedPolicy,
    out: Path,
    *,
    seed: int | None = None,
    episodes: int | None = None,
    view: rendering.View = "auto",
    size: int = 480,
    speed: float = 1.0,
    fps: float | None = None,
    greedy: bool = True,
    watch: Callable[[int, int], None] | None = None,
) -> Drawing:
    """Play episodes of one seed's policy and draw them off-screen.

    Args:
        trained: the policies of a run.
        out: a .gif or .mp4 for a film, a .png for the trajectories of one episode.
        seed: whose policy acts; by default the first.
        episodes: of a film; by default 3, of long tasks 1.
        view: see `open_painter`.
        size: of the longer side, pixels.
        speed: times real time.
        fps: most frames per second; by default 25.
        greedy: whether the policy takes its most probable actions, or draws them.
        watch: told how many frames of how many are drawn.

    Raises:
        ValueError: another ending, no such seed, or a view that cannot be drawn.
    """
    kind = check_target(out, episodes)
    seed = trained.config.seeds[0] if seed is None else seed
    env = build_environment(trained.config, 1, "film")
    count = 1 if kind == PICTURE else episodes or rendering.default_episodes(trained.spec)
    with rendering.open_painter(env, view, size) as painter:
        recorded = rendering.record(trained, env, seed, count, greedy)
        steps = sum(len(scenes) - 1 for scenes in recorded)
        if kind == PICTURE:
            rendering.write_picture(out, painter, recorded[0], f"{trained.config.task}, seed {seed}", size)
            return Drawing(out, 1, steps, painter.note)
        rate = fps or rendering.FRAMES_PER_SECOND
        if kind == ".gif":
            rate = min(rate, films.GIF_FRAMES_PER_SECOND)
        period = trained.spec.control_period_s
        taken = rendering.shots(recorded, rendering.stride(period, speed, rate))

        def drawn(done: int) -> None:
            if watch is not None:
                watch(done, len(taken))

        rendering.write_film(out, painter, taken, period / speed, drawn)
        return Drawing(out, len(taken), steps, painter.note)
