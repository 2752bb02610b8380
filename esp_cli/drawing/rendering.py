"""Films and pictures of recorded episodes, off-screen."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from esp_cli.drawing.films import Frame, write_gif, write_mp4
from esp_cli.drawing.frames import Moment, frame
from esp_cli.drawing.recording import HOLD_SECONDS, Episode
from esp_envs.base import Environment
from esp_envs.drawing import TopPainter
from esp_envs.errors import UserError
from esp_envs.scene import Painter

View = Literal["auto", "top", "3d"]

FRAMES_PER_SECOND = 25
"""Of a film, at most, unless more are asked for."""
_SAMPLED_FRAMES = 8
"""Frames that the palette of a GIF is made for."""


@contextmanager
def open_painter(env: Environment, view: View, size: int) -> Iterator[Painter]:
    """Open what draws this task.

    Args:
        env: the task.
        view: "top" is the view from above, "3d" the task's own view in space, "auto" the latter where there is one and
            the machine can draw it (else the painter's note says why not).
        size: of the longer side, pixels.

    Raises:
        UserError: "3d", and the task has no view in space or the machine cannot draw it.
    """
    if view not in get_args(View):
        raise UserError(f"there is no view '{view}'; choose {', '.join(get_args(View))}")
    own = None if view == "top" else env.painter(size)
    if own is None and view == "3d":
        raise UserError(f"{env.spec.name} is a flat task without a view in space; leave out --view 3d")
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
    """One frame to draw.

    Attributes:
        moments: what is side by side.
        caption: what stands before the time.
        time_s: since the episode began, s.
        steps: how many it stays in view.
    """

    moments: tuple[Moment, ...]
    caption: str
    time_s: float
    steps: int

    def draw(self, painter: Painter) -> Frame:
        """Draw the moments with caption, axes and legend."""
        return frame(painter, self.moments, self.caption, self.time_s)


def stride(control_period_s: float, speed: float, frames_per_second: float) -> int:
    """Return the number of steps from one frame to the next: the smallest that keeps to the frame rate."""
    return max(1, math.ceil(speed / (control_period_s * frames_per_second) - 1e-9))


def shots(
    recorded: Sequence[Sequence[Episode]],
    every: int,
    period_s: float,
    title: str,
    names: Sequence[str | None] = (None,),
) -> list[Shot]:
    """Choose every so-many-th scene of each episode, its first and its last among them.

    Args:
        recorded: episodes of each policy that is shown; the one that ends first waits for the other.
        every: steps from one frame to the next.
        period_s: of a step, s.
        title: the task.
        names: of the policies.
    """
    chosen = []
    count = len(recorded[0])
    for k, together in enumerate(zip(*recorded, strict=True), start=1):
        caption = f"{title}, episode {k} of {count}"
        end = max(episode.steps for episode in together)
        shown = sorted({*range(0, end + 1, every), end})
        for step, following in zip(shown, [*shown[1:], end + 1], strict=True):
            moments = []
            for episode, name in zip(together, names, strict=True):
                own = min(step, episode.steps)
                moments.append(Moment(episode.scenes[: own + 1], episode.returns[own], name))
            chosen.append(Shot(tuple(moments), caption, step * period_s, following - step))
    return chosen


def write_film(
    path: Path, painter: Painter, taken: Sequence[Shot], step_s: float, watch: Callable[[int], None]
) -> None:
    """Draw a film and write it as an MP4 where the file is named so, else as a GIF.

    Args:
        path: where to.
        painter: draws the shots.
        taken: the shots, in their order.
        step_s: how long one step is in view, s; the last of an episode is in view for longer.
        watch: told how many frames are drawn, after each.
    """
    ends = [*(after.time_s == 0 for after in taken[1:]), True]
    seconds = [shot.steps * step_s + HOLD_SECONDS * end for shot, end in zip(taken, ends, strict=True)]
    usual = taken[0].steps * step_s

    def draw(repeated: bool) -> Iterator[Frame]:
        for done, (shot, shown) in enumerate(zip(taken, seconds, strict=True), 1):
            drawn = shot.draw(painter)
            yield from [drawn] * (max(1, round(shown / usual)) if repeated else 1)
            watch(done)

    if path.suffix.lower() == ".mp4":
        write_mp4(path, draw(repeated=True), 1 / usual)
    else:
        sample = [shot.draw(painter) for shot in taken[:: math.ceil(len(taken) / _SAMPLED_FRAMES)]]
        write_gif(path, draw(repeated=False), seconds, sample)
