"""Drawing a trained policy at work into a file: a film, or a picture of one episode."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import imageio.v3 as iio
import matplotlib as mpl

from esp_cli.defaults import SLOWEST
from esp_cli.drawing.figures import INCHES, PAPER, PAPER_DPI, STEADY, saved, summary
from esp_cli.drawing.films import GIF_FRAMES_PER_SECOND, Frame, frame, write_gif, write_mp4
from esp_cli.drawing.recording import HOLD_SECONDS, Episode, framed, record
from esp_cli.files.writing import refuse_unwritable, write_file
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.training.build import build_environment
from esp_envs.base import Environment
from esp_envs.drawing import TopPainter
from esp_envs.errors import UserError
from esp_envs.scene import Painter

View = Literal["auto", "top", "3d"]

FILMS, PICTURES = (".gif", ".mp4"), (".png", ".pdf", ".svg")
_MM_PER_INCH = 25.4
_PIXELS = 480  # unless another size is asked for
FRAMES_PER_SECOND = 25  # most frames per second of a film, unless more are asked for
_SAMPLED_FRAMES = 8  # frames that the palette of a GIF is made for


@dataclass(frozen=True)
class Request:
    """How a policy is drawn, and into what."""

    out: Path  # a .gif or .mp4 for a film, a .png, .pdf or .svg for a picture of one episode
    seed: int | None = None  # whose policy acts; by default the first
    episodes: int | None = None  # of a film; by default as many as last about 8 s
    view: View = "auto"  # see `open_painter`
    size: int = _PIXELS  # of the longer side of a scene, pixels; caption, axes and legend come on top
    speed: float = 1.0  # times real time, 0.01 or more
    fps: float | None = None  # most frames per second; by default 25
    width: float | None = None  # of a picture for print, mm; by default as large as `size` says
    greedy: bool = True  # whether the policy takes its most probable actions, or draws them

    def __post_init__(self) -> None:
        if self.kind not in (*FILMS, *PICTURES):
            raise UserError(f"cannot write {self.out}: name a .gif or .mp4 film, or a .png, .pdf or .svg picture")
        if self.episodes is not None and self.episodes < 1:
            raise UserError(f"episodes is {self.episodes}; a film has at least one")
        if self.is_picture and self.episodes is not None and self.episodes > 1:
            raise UserError(f"{self.out} holds one episode; leave out --episodes {self.episodes} or name a .gif file")
        if self.width is not None and not self.is_picture:
            raise UserError(f"{self.out} is a film, whose width --size sets in pixels; leave out --width")
        if self.is_picture and (self.fps is not None or self.speed != 1):
            option = "--speed" if self.fps is None else "--fps"
            raise UserError(f"{self.out} is a picture without frames; leave out {option} or name a .gif or .mp4 file")
        if self.for_print and self.size != _PIXELS:
            raise UserError(f"{self.out} is for print, whose width --width sets in mm; leave out --size")
        if self.width is not None and not 20 <= self.width <= 1000:
            raise UserError(f"width is {self.width:g}; give 20 to 1000 mm, as 89 for a column")
        if not SLOWEST <= self.speed < math.inf:  # false for what is no number
            raise UserError(f"speed is {self.speed}; give times real time, {SLOWEST:g} or more")
        if self.view not in get_args(View):
            raise UserError(f"there is no view '{self.view}'; choose {', '.join(get_args(View))}")
        refuse_unwritable(self.out)

    @property
    def kind(self) -> str:
        return self.out.suffix.lower()

    @property
    def is_picture(self) -> bool:
        return self.kind in PICTURES

    @property
    def for_print(self) -> bool:
        return self.is_picture and (self.kind != ".png" or self.width is not None)


@dataclass(frozen=True)
class Drawing:
    """What was drawn."""

    path: Path  # the file
    frames: int  # of a film; of a picture, 1
    steps: int  # of all episodes
    returns: tuple[float, ...]  # of each policy, mean over its episodes
    note: str | None  # a sentence for the user about how it was drawn, or None


def draw(
    request: Request,
    policies: Sequence[TrainedPolicy],
    names: Sequence[str] = (),
    watch: Callable[[int, int], None] | None = None,
) -> Drawing:
    """Play episodes of one seed's policy and draw them off-screen, alone or beside those of another policy."""
    acting, spec = _acting(request, policies), policies[0].spec
    titles = names if len(policies) > 1 else [None]
    env = build_environment(acting[0].config, 1, "film")
    view = "top" if request.for_print and request.view == "auto" else request.view
    with open_painter(env, view, request.size) as painter:
        recorded = record(acting, 1 if request.is_picture else request.episodes, request.greedy)
        flat = isinstance(painter, TopPainter) and recorded[0][0].scenes[0].picture is None
        recorded = framed(recorded) if flat else recorded
        # steps from one frame to the next: the fewest that keep to the frame rate
        rate = min(request.fps or FRAMES_PER_SECOND, GIF_FRAMES_PER_SECOND if request.kind == ".gif" else math.inf)
        every = max(1, math.ceil(request.speed / (spec.control_period_s * rate) - 1e-9))
        taken = shots(recorded, every, spec.control_period_s, spec.name, titles)
        if not request.is_picture:
            report = watch or (lambda *_: None)
            step_s = spec.control_period_s / request.speed
            write_film(request.out, painter, taken, step_s, lambda done: report(done, len(taken)))
        elif flat:
            shown = [(own[0], title or spec.name) for own, title in zip(recorded, titles, strict=True)]
            style, dpi, inches = {}, request.size / INCHES, INCHES
            if request.width is not None:
                style, dpi, inches = PAPER, PAPER_DPI, request.width / _MM_PER_INCH
            with mpl.rc_context({**style, **STEADY}):
                content = saved(summary(shown, spec.control_period_s, inches), request.kind[1:], dpi)
            write_file(request.out, content)
        elif request.for_print:
            raise UserError(f"what draws {spec.name} gives pixels, not lines; name a .png file without --width")
        else:
            write_file(request.out, iio.imwrite("<bytes>", taken[-1].draw(painter), extension=".png"))
    steps = sum(episode.steps for episode in recorded[0])
    returns = tuple(sum(episode.returns[-1] for episode in own) / len(own) for own in recorded)
    return Drawing(request.out, 1 if request.is_picture else len(taken), steps, returns, painter.note)


def _acting(request: Request, policies: Sequence[TrainedPolicy]) -> list[TrainedPolicy]:
    first, *others = policies
    for other in others:
        if other.config.task != first.config.task:
            raise UserError(
                f"{first.source} is a policy of {first.config.task}, {other.source} of {other.config.task}; "
                "compare two policies of one task"
            )
    seeds = [request.seed, *(None if len(other.config.seeds) == 1 else request.seed for other in others)]
    return [policy.single_seed(seed) for policy, seed in zip(policies, seeds, strict=True)]


@contextmanager
def open_painter(env: Environment, view: View, size: int) -> Iterator[Painter]:
    """Open what draws this task, with scenes of `size` pixels along the longer side.

    "top" is the view from above, "3d" the task's own view in space, "auto" the latter where there is one and this
    machine can draw it; else the painter's note says why not.
    """
    own = None if view == "top" else env.painter(size)
    if own is None and view == "3d":
        raise UserError(f"{env.spec.name} is a flat task without a view in space; leave out --view 3d")
    with ExitStack() as stack:
        try:
            painter: Painter = TopPainter(size) if own is None else stack.enter_context(own)
        except UserError as error:
            if view == "3d":
                raise
            painter = TopPainter(size, note=f"{error}; so the view is from above")
        yield painter


@dataclass(frozen=True)
class Shot:
    """One frame to draw."""

    episodes: tuple[Episode, ...]  # what is side by side, until then
    caption: str  # what stands before the time
    time_s: float  # since the episode began, s
    steps: int  # how many it stays in view

    def draw(self, painter: Painter) -> Frame:
        return frame(painter, self.episodes, self.caption, self.time_s)


def shots(
    recorded: Sequence[Sequence[Episode]],
    every: int,
    period_s: float,
    title: str,
    names: Sequence[str | None] = (None,),
) -> list[Shot]:
    """Choose every so-many-th scene of each episode, its first and its last among them."""
    chosen = []
    for k, together in enumerate(zip(*recorded, strict=True), start=1):
        caption = f"{title}, episode {k} of {len(recorded[0])}"
        end = max(episode.steps for episode in together)
        shown = sorted({*range(0, end + 1, every), end})
        for step, following in zip(shown, [*shown[1:], end + 1], strict=True):
            until = tuple(episode.until(step, name) for episode, name in zip(together, names, strict=True))
            chosen.append(Shot(until, caption, step * period_s, following - step))
    return chosen


def write_film(
    path: Path, painter: Painter, taken: Sequence[Shot], step_s: float, watch: Callable[[int], None]
) -> None:
    """Draw shots in their order and write them as an MP4 where the file is named so, else as a GIF."""
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
