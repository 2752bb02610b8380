"""`esp render`: draw a trained policy at work."""

from __future__ import annotations

from typing import Annotated

import typer

from esp_cli import console
from esp_cli.commands.options import OutOption, PolicyArgument

EPILOG = """Examples:\n
    esp render runs/cn-mappo -o cn.gif\n
    esp render runs/cn-mappo -o cn.gif --episodes 3 --size 480 --speed 0.5"""


def render(
    policy: PolicyArgument,
    out: OutOption,
    episodes: Annotated[
        int, typer.Option("--episodes", "-e", min=1, max=100, help="Episodes, one after the other.")
    ] = 3,
    seed: Annotated[int | None, typer.Option("--seed", help="Which seed's policy acts; by default the first.")] = None,
    size: Annotated[int, typer.Option("--size", min=32, max=2048, help="Longer side in pixels.")] = 320,
    speed: Annotated[float, typer.Option("--speed", min=0.01, max=100, help="Times real time.")] = 1.0,
    stochastic: Annotated[bool, typer.Option("--stochastic", help="Draw actions instead of the greedy ones.")] = False,
) -> None:
    """Play episodes and write them as a GIF; off-screen, no display needed."""
    if out.suffix.lower() != ".gif":
        raise ValueError(f"cannot write {out}: name a .gif file")
    from esp_cli.experiments.rendering import film, write_gif
    from esp_cli.training.loading import load_policy

    trained = load_policy(policy)
    for text in trained.notes:
        console.note(text)
    frames = film(trained, trained.config.seeds[0] if seed is None else seed, episodes, size, not stochastic)
    write_gif(out, frames, speed / trained.spec.control_period_s)
    console.note(f"{len(frames)} frames -> {out} ({out.stat().st_size / 1024:.0f} kB)")
