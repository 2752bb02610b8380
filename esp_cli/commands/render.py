"""`esp render`: draw a trained policy at work."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import typer
from typer import Argument, Option

from esp_cli import console
from esp_cli.commands import options
from esp_cli.defaults import SLOWEST
from esp_cli.files.formatting import name_of

_EPISODES = 64  # of the reference policies, at most
EPILOG = """Examples:\n
    esp render formation -o f.gif\n
    esp render runs/cn-mappo -o cn.gif\n
    esp render runs/cn-mappo -o cn.gif --episodes 5 --size 320 --speed 0.5\n
    esp render runs/fc-mappo -o formation.gif --speed 4x\n
    esp render runs/fc-mappo -o formation.pdf --width 89\n
    esp render formation-mappo-plain formation-mappo-esp -o both.gif"""


def parse_speed(value: str | float) -> float:
    """Read a speed: 4, 0.5 or 4x."""
    try:
        speed = float(str(value).strip().lower().removesuffix("x"))
    except ValueError:
        speed = math.nan
    if not SLOWEST <= speed <= 100:  # false for what is no number
        raise typer.BadParameter(f"'{value}' is no speed; write a number from 0.01 to 100, as 0.5 or 4x")
    return speed


def render(
    policy: options.PolicyArgument,
    out: options.OutOption,
    beside: Annotated[
        Path | None,
        Argument(help="Another policy of the same task, which plays the same episodes.", metavar="[RUN|POLICY]"),
    ] = None,
    task: options.OwnTaskOption = None,
    view: Annotated[
        Literal["auto", "top", "3d"],
        Option("--view", help="From above, or in space; auto takes the latter where the task has it."),
    ] = "auto",
    episodes: Annotated[
        int | None,
        Option("--episodes", "-e", min=1, max=100, help="Episodes of a film; by default as many as last about 8 s."),
    ] = None,
    seed: Annotated[int | None, Option("--seed", help="Which seed's policy acts; by default the first.")] = None,
    size: Annotated[
        int,
        Option(
            "--size", min=32, max=2048, help="Longer side of a scene in pixels; caption, axes and legend come on top."
        ),
    ] = 480,
    speed: Annotated[
        float, Option("--speed", parser=parse_speed, metavar="TIMES", help="Multiple of real time, as 0.5 or 4x.")
    ] = 1.0,
    fps: Annotated[
        float | None, Option("--fps", min=1, max=60, help="Most frames per second: 25 unless given, in a GIF up to 50.")
    ] = None,
    width: Annotated[
        float | None,
        Option("--width", min=20, max=1000, help="Width of a picture for print in mm, as 89: letters of 8 points."),
    ] = None,
    stochastic: Annotated[bool, Option("--stochastic", help="Draw actions instead of the greedy ones.")] = False,
    physics: options.PhysicsOption = None,
    settings: options.TaskSetOption = None,
    algo: options.BundledAlgoOption = None,
    network: options.OwnNetworkOption = None,
    prior: options.BundledPriorOption = None,
) -> None:
    """Play episodes and draw them off-screen: a film (.gif, .mp4), or a picture (.png, .pdf, .svg) of one episode.

    A picture shows paths, and when each agent covers a landmark or catches the prey. Wildlife's shows the last steps.
    """
    from esp_cli.drawing.draw import Request, draw
    from esp_cli.policies.evaluation import rough_anchors
    from esp_cli.policies.loading import open_policy
    from esp_cli.policies.statistics import normalised

    request = Request(out, seed, episodes, view, size, speed, fps, width, not stochastic)
    options.register_named(task, [algo], network)
    changed = options.parse_task_settings(settings or [], physics)
    named = [policy] if beside is None else [policy, beside]
    names = [*map(name_of, named)]
    names = names if len({*names}) == len(names) else [*map(str, named)]
    opened = [open_policy(where, algo, prior).transfer(changed) for where in named]
    options.refuse_unused([one.config for one in opened], task, [algo], network)
    options.note_idle_settings(opened[0].config.task, changed, opened[0].config.task_settings)
    for text in dict.fromkeys(text for trained in opened for text in trained.notes):
        console.note(text)
    with console.watching("draw", "frames") as watch:
        drawing = draw(request, opened, names, watch)
    film = f"{drawing.frames} frames -> {out} ({out.stat().st_size / 1024:.0f} kB)"
    picture = f"episode of {drawing.steps} steps -> {out}"
    for text in filter(None, (drawing.note, picture if request.is_picture else film)):
        console.note(text)
    anchors = rough_anchors(opened[0].config, _EPISODES)
    for name, value in zip(names, drawing.returns, strict=True):
        scaled = normalised(value, anchors)
        score = "" if scaled is None else f", normalised {scaled:.2f} (0 random, 1 the best heuristic)"
        console.note(f"{name}: return {value:.1f}{score}")
