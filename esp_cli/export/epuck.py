"""Whether what stands beside an exported policy that drives e-pucks, `esp_epuck.py`, sees what the task shows.

Untested on hardware. What builds an observation from poses is compared with the task in thousands of states.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from esp_cli.export.esp_epuck import Pilot
from esp_cli.export.layers import Floats
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.training.build import build_environment
from esp_envs.base import Environment
from esp_envs.registry import TASKS

STATES = 10_000  # states on which the observations built from poses are compared with the task's
TOLERANCE = 1e-5  # largest difference of an observation's number; float32 in metres gives 1e-6
_WORLDS = 100
_JITTER_M = 0.001  # noise on the task's positions: in a perfect square two robots are equally near
_EXACT = {"sensor_noise_m": 0.0, "heading_noise_rad": 0.0}  # of a robot's sensors in training, which poses do not show


Scenes = tuple[Floats, ...]
"""States of the task and what robots see in them: poses [W, N, 3] (x, y, heading), goals [W, N, 2], pillars [W, M, 2]
and the task's observations without its noise [W, N, D]."""


@torch.no_grad()
def take_scenes(trained: TrainedPolicy, count: int = STATES) -> Scenes:
    """Put the task into states: one half that the policy meets, one half drawn anywhere in the arena."""
    worlds = min(-(-count // 2), _WORLDS)
    exact = trained.config.model_copy(update={"task_settings": dict(trained.config.task_settings) | _EXACT})
    played, probe = build_environment(trained.config, worlds, "export"), build_environment(exact, worlds, "shape")
    observation, rng, parts = played.reset(), np.random.default_rng(0), []
    memory = trained.policy.initial_memory(worlds, observation.obs)
    for _ in range(-(-count // (2 * worlds))):
        parts += [_probe(probe, observation.state[0].numpy(), rng, near) for near in (True, False)]
        for _ in range(5):
            action, memory = trained.policy.act(observation.obs, memory)
            observation = played.step(action).next
    return tuple(np.concatenate(arrays)[:count] for arrays in zip(*parts, strict=True))


def _probe(env: Environment, state: Floats, rng: np.random.Generator, near: bool) -> Scenes:
    """Return scenes of states near the given ones, or drawn anywhere."""
    where, rows = env.spec.state.slices(), state.copy()
    reach = float(str(env.spec.settings["arena_m"])) / 2
    for name in ("position", "goals", "obstacles"):
        if name in where:
            own = rows[:, where[name]]
            moved = own + rng.normal(0, _JITTER_M, own.shape) if near else rng.uniform(-reach, reach, own.shape)
            rows[:, where[name]] = moved
    if not near:
        turn = rng.uniform(-np.pi, np.pi, (len(rows), env.spec.num_agents))
        rows[:, where["heading"]] = np.stack([np.cos(turn), np.sin(turn)], -1).reshape(len(rows), -1)
    obs = env.set_state(torch.from_numpy(rows)[None]).obs[0].numpy()

    def items(name: str) -> Floats:
        return rows[:, where[name]].reshape(len(rows), -1, 2) if name in where else np.zeros((len(rows), 0, 2), "f4")

    x, y = np.moveaxis(items("heading"), -1, 0)
    poses = np.concatenate([items("position"), np.arctan2(y, x)[..., None]], -1)
    return poses, items("goals"), items("obstacles"), obs


def seen_from_poses(trained: TrainedPolicy, description: dict[str, Any]) -> tuple[float | None, str | None]:
    """Return the largest difference between what a pilot builds from poses and the task's; else why it cannot build it.

    A task of the caller that derives from a robot's may see something else.
    """
    try:
        return compare_scenes(take_scenes(trained), description), None
    except (ValueError, KeyError) as error:
        if TASKS.ships(trained.config.task):
            raise RuntimeError(f"{error}; this is a bug") from error
        return None, f"{error}; esp_epuck.py is left out"


def compare_scenes(scenes: Scenes, description: dict[str, Any]) -> float:
    """Return the largest difference between the task's observations and those that a pilot builds from poses."""
    pilot, (*states, shown) = Pilot(description, lambda obs: obs), scenes
    built = np.stack([pilot.observations(*state) for state in zip(*states, strict=True)])
    gap = float(np.abs(built - shown).max()) if built.shape == shown.shape else np.inf
    if not gap <= TOLERANCE:
        raise ValueError(f"an observation built from poses differs from the task's by {gap:g}")
    return gap
