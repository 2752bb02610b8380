"""`esp render`: draw a trained policy at work."""

from __future__ import annotations

import errno
import math
import os
from pathlib import Path
from typing import Annotated, Literal

import typer

from esp_cli import console
from esp_cli.commands.options import (
    BundledAlgoOption,
    BundledPriorOption,
    OutOption,
    PhysicsOption,
    PolicyArgument,
    TaskSetOption,
    parse_task_settings,
)

EPILOG = """Examples:\n
    esp render formation -o f.gif\n
    esp render runs/cn-mappo -o cn.gif\n
    esp render runs/cn-mappo -o cn.gif --episodes 5 --size 320 --speed 0.5\n
    esp render runs/fc-mappo -o formation.gif --speed 4x\n
    esp render runs/fc-mappo -o formation.png --view top"""

FILMS, PICTURE = (".gif", ".mp4"), ".png"


def parse_speed(value: str | float) -> float:
    """Read a speed: 4, 0.5 or 4x.

    Raises:
        typer.BadParameter: no number, or not between 0.01 and 100.
    """
    try:
        speed = float(str(value).strip().lower().removesuffix("x"))
    except ValueError:
        speed = math.nan
    if not 0.01 <= speed <= 100:  # false for what is no number
        raise typer.BadParameter(f"'{value}' is no speed; write a number from 0.01 to 100, as 0.5 or 4x")
    return speed


def render(
    policy: PolicyArgument,
    out: OutOption,
    view: Annotated[
        Literal["auto", "top", "3d"],
        typer.Option("--view", help="From above, or in space; auto takes the latter where the task has it."),
    ] = "auto",
    episodes: Annotated[
        int | None,
        typer.Option("--episodes", "-e", min=1, max=100, help="Episodes of a film; by default 3, of long tasks 1."),
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Which seed's policy acts; by default the first.")] = None,
    size: Annotated[int, typer.Option("--size", min=32, max=2048, help="Longer side in pixels.")] = 480,
    speed: Annotated[
        float, typer.Option("--speed", parser=parse_speed, metavar="TIMES", help="Times real time, as 0.5 or 4x.")
    ] = 1.0,
    fps: Annotated[
        float | None,
        typer.Option("--fps", min=1, max=60, help="Most frames per second: 25 unless given, in a GIF up to 50."),
    ] = None,
    stochastic: Annotated[bool, typer.Option("--stochastic", help="Draw actions instead of the greedy ones.")] = False,
    physics: PhysicsOption = None,
    settings: TaskSetOption = None,
    algo: BundledAlgoOption = None,
    prior: BundledPriorOption = None,
) -> None:
    """Play episodes and draw them off-screen: a film (.gif, .mp4), or the trajectories of one episode (.png)."""
    kind = _kind_of(out, episodes)
    from esp_cli.deploy.bundled import open_policy
    from esp_cli.drawing import films, rendering
    from esp_cli.training.build import build_environment
    from esp_cli.training.loading import transfer

    trained = transfer(open_policy(policy, algo, prior), parse_task_settings(settings or [], physics))
    for text in trained.notes:
        console.note(text)
    seed = trained.config.seeds[0] if seed is None else seed
    env = build_environment(trained.config, 1, "film")
    count = 1 if kind == PICTURE else episodes or rendering.default_episodes(trained.spec)
    with rendering.open_painter(env, view, size) as painter:
        recorded = rendering.record(trained, env, seed, count, not stochastic)
        if painter.note:
            console.note(painter.note)
        if kind == PICTURE:
            rendering.write_picture(out, painter, recorded[0], f"{trained.config.task}, seed {seed}", size)
            console.note(f"episode of {len(recorded[0]) - 1} steps -> {out}")
            return
        rate = fps or rendering.FRAMES_PER_SECOND
        if kind == ".gif":
            rate = min(rate, films.GIF_FRAMES_PER_SECOND)
        period = trained.spec.control_period_s
        taken = rendering.shots(recorded, rendering.stride(period, speed, rate))
        with console.TrainingProgress(len(taken), description="draw") as progress:
            rendering.write_film(out, painter, taken, period / speed, progress.update)
    console.note(f"{len(taken)} frames -> {out} ({out.stat().st_size / 1024:.0f} kB)")


def _kind_of(out: Path, episodes: int | None) -> str:
    """Return the ending of a file that can be drawn into."""
    kind = out.suffix.lower()
    if kind not in (*FILMS, PICTURE):
        raise ValueError(f"cannot write {out}: name a .gif, .mp4 or .png file")
    if kind == PICTURE and episodes is not None and episodes > 1:
        raise ValueError(f"{out} holds one episode; leave out --episodes {episodes} or name a .gif file")
    if out.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(out))
    return kind
