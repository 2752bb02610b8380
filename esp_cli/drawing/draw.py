"""Drawing a trained policy at work into a file: a film, or a picture of one episode."""

from __future__ import annotations

import errno
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from esp_cli.defaults import SLOWEST
from esp_cli.drawing import films, rendering
from esp_cli.drawing.figures import summary
from esp_cli.drawing.recording import Episode, framed, record, record_both
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.training.build import build_environment
from esp_envs.base import Environment
from esp_envs.drawing import TopPainter
from esp_envs.errors import UserError
from esp_envs.scene import Painter

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


def check_target(out: Path, episodes: int | None, fps: float | None = None) -> str:
    """Return the ending of a file that can be drawn into.

    Raises:
        UserError: another ending, or what a picture does not have: more episodes, or frames per second.
        OSError: the file is a folder.
    """
    kind = out.suffix.lower()
    if kind not in (*FILMS, PICTURE):
        raise UserError(f"cannot write {out}: name a .gif, .mp4 or .png file")
    if kind == PICTURE and episodes is not None and episodes > 1:
        raise UserError(f"{out} holds one episode; leave out --episodes {episodes} or name a .gif file")
    if kind == PICTURE and fps is not None:
        raise UserError(f"{out} is a picture without frames; leave out --fps or name a .gif or .mp4 file")
    if out.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(out))
    return kind


def draw(
    trained: TrainedPolicy,
    out: Path,
    *,
    other: TrainedPolicy | None = None,
    names: tuple[str, str] = ("first", "second"),
    seed: int | None = None,
    episodes: int | None = None,
    view: rendering.View = "auto",
    size: int = 480,
    speed: float = 1.0,
    fps: float | None = None,
    greedy: bool = True,
    watch: Callable[[int, int], None] | None = None,
) -> Drawing:
    """Play episodes of one seed's policy and draw them off-screen, alone or beside those of another policy.

    Args:
        trained: the policies of a run.
        out: a .gif or .mp4 for a film, a .png for a picture of one episode.
        other: a policy of the same task that plays the same episodes.
        names: of the two policies, where there are two.
        seed: whose policy acts; by default the first.
        episodes: of a film; by default as many as last about 8 s.
        view: see `open_painter`.
        size: of the longer side of a scene, pixels; caption, axes and legend come on top.
        speed: times real time, 0.01 or more.
        fps: most frames per second; by default 25.
        greedy: whether the policy takes its most probable actions, or draws them.
        watch: told how many frames of how many are drawn.

    Raises:
        UserError: another ending, no such seed, a view that cannot be drawn, no episodes, no speed, or policies that
            cannot be compared.
    """
    kind = check_target(out, episodes)
    if episodes is not None and episodes < 1:
        raise UserError(f"episodes is {episodes}; a film has at least one")
    if not SLOWEST <= speed < math.inf:  # false for what is no number
        raise UserError(f"speed is {speed}; give times real time, {SLOWEST:g} or more")
    count = 1 if kind == PICTURE else episodes
    env = build_environment(trained.config, 1, "film")
    recorded = _recorded(trained, other, env, seed, count, greedy)
    called = [None] if other is None else list(names)
    period = trained.spec.control_period_s
    with rendering.open_painter(env, view, size) as painter:
        if isinstance(painter, TopPainter):
            episodes_of = len(recorded[0])
            together = framed([episode for own in recorded for episode in own])
            recorded = [together[k : k + episodes_of] for k in range(0, len(together), episodes_of)]
        steps = sum(episode.steps for episode in recorded[0])
        rate = fps or rendering.FRAMES_PER_SECOND
        if kind == ".gif":
            rate = min(rate, films.GIF_FRAMES_PER_SECOND)
        taken = rendering.shots(recorded, rendering.stride(period, speed, rate), period, trained.spec.name, called)
        if kind == PICTURE:
            films.write_png(out, _picture(trained, recorded, called, painter, taken[-1], size))
            return Drawing(out, 1, steps, painter.note)

        def drawn(done: int) -> None:
            if watch is not None:
                watch(done, len(taken))

        rendering.write_film(out, painter, taken, period / speed, drawn)
        return Drawing(out, len(taken), steps, painter.note)


def _recorded(
    trained: TrainedPolicy,
    other: TrainedPolicy | None,
    env: Environment,
    seed: int | None,
    count: int | None,
    greedy: bool,
) -> list[list[Episode]]:
    """Play one policy, or both."""
    own = trained.config.seeds[0] if seed is None else seed
    if other is None:
        return [record(trained, env, own, count, greedy)]
    if other.config.task != trained.config.task:
        raise UserError(
            f"{trained.source} is a policy of {trained.config.task}, {other.source} of {other.config.task}; "
            "compare two policies of one task"
        )
    theirs = other.config.seeds[0] if seed is None or len(other.config.seeds) == 1 else seed
    return list(record_both(trained, other, (own, theirs), count, greedy))


def _picture(
    trained: TrainedPolicy,
    recorded: Sequence[Sequence[Episode]],
    names: Sequence[str | None],
    painter: Painter,
    last: rendering.Shot,
    size: int,
) -> films.Frame:
    """Draw an episode: from above a figure, in space its end with the trails."""
    if not isinstance(painter, TopPainter):
        return last.draw(painter)
    figures = [
        summary(own[0], name or trained.spec.name, size, trained.spec.control_period_s)
        for own, name in zip(recorded, names, strict=True)
    ]
    height = max(map(len, figures))  # a strip is as high as its episode is long
    padded = [np.pad(f, ((0, height - len(f)), (0, 0), (0, 0)), constant_values=255) for f in figures]
    return np.concatenate(padded, axis=1)
