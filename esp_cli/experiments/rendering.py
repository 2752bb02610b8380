"""Pictures of a policy at work, off-screen: no display and no graphics library needed."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import torch
from numpy.typing import NDArray

from esp_cli.training.checkpoint import write_bytes_atomic
from esp_cli.training.evaluation import PolicyController
from esp_cli.training.loading import TrainedPolicy
from esp_cli.training.streams import generators
from esp_cli.training.trainer import build_environment
from esp_envs.drawing import draw

Frame = NDArray[np.uint8]


@torch.no_grad()
def film(trained: TrainedPolicy, seed: int, episodes: int, size: int, greedy: bool = True) -> list[Frame]:
    """Play episodes of one seed's policy and draw every step.

    Args:
        trained: the policies of a run.
        seed: which of the run's seeds acts.
        episodes: played one after the other.
        size: of the longer side of a frame, pixels.
        greedy: act greedily, or draw actions.

    Returns:
        Frames [H, W, 3], `horizon` + 1 of them per episode unless it ends before.

    Raises:
        ValueError: the run has no such seed.
    """
    seeds = trained.config.seeds
    if seed not in seeds:
        raise ValueError(f"{trained.source} has no seed {seed}; it has {', '.join(map(str, seeds))}")
    world = (seeds.index(seed), 0)
    env = build_environment(trained.config, 1, "film")
    noise = None if greedy else generators(seeds, "film", "noise")
    controller = PolicyController(trained.policy, noise)
    frames: list[Frame] = []
    for _ in range(episodes):
        observation = env.reset()
        controller.begin(env, observation)
        scenes = [env.scene(world)]
        for _ in range(env.spec.horizon):
            step = env.step(controller.act(env, observation))
            observation = step.next
            ended = bool((step.terminated | step.truncated)[world])
            if ended and step.final is not None:
                env.set_state(step.final.state)  # the world has begun anew by itself; show how it ended
            scenes.append(env.scene(world))
            if ended:
                break
        frames += [draw(scene, size, trail=scenes[:k]) for k, scene in enumerate(scenes)]
    return frames


def write_gif(path: Path, frames: list[Frame], frames_per_second: float) -> None:
    """Write frames as an endlessly repeated GIF, whole or not at all."""
    content = imageio.imwrite("<bytes>", frames, extension=".gif", duration=1000 / frames_per_second, loop=0)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes_atomic(path, content)
