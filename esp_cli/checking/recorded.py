"""Transitions of anybody: how they are collected from a task, what they say of each agent, and how they transform."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import torch
from torch import Tensor

from esp_cli.checking.verdicts import Watch
from esp_cli.symmetry import Transform
from esp_envs.base import Environment

EPISODES = 2048
STEPS = 8
"""Steps of each episode that are looked at."""


@dataclass(frozen=True)
class Transitions:
    """Steps of a policy that prefers no direction, such as the uniformly random one.

    A vector whose numbers are uniform in [-1, 1] prefers the diagonals. Only quarter turns, and mirrors in the axes or
    diagonals, keep that preference as it is.

    Shape:
        obs, next_obs: [M, T, N, D], M episodes from their starts, T steps of each.
        action: [M, T, N] int64, or [M, T, N, width] float32.
        reward: [M, T, N].
        action_mask: [M, T, N, A] bool, the actions that were allowed; None where all always are.
    """

    obs: Tensor
    action: Tensor
    reward: Tensor
    next_obs: Tensor
    action_mask: Tensor | None = None

    def episodes(self, where: slice) -> Transitions:
        """Return some of the episodes."""
        return Transitions(*(part[where] for part in vars(self).values() if part is not None))


def collect(
    env: Environment,
    episodes: int = EPISODES,
    steps: int = STEPS,
    until: float = math.inf,
    watch: Watch = lambda *_: None,
) -> Transitions:
    """Return the first steps of episodes of the random policy.

    An episode that ends earlier repeats its last transition. After `until`, by `time.monotonic`, no step is begun:
    episodes that are under way are left out, of the first ones the steps that are missing.
    """
    worlds = env.num_envs * env.num_seeds
    rounds, count = -(-episodes // worlds), min(steps, env.spec.horizon)
    found: list[list[tuple[Tensor, ...]]] = []
    for k in range(rounds):
        observation = env.reset()
        over = torch.zeros(env.num_seeds, env.num_envs, dtype=torch.bool, device=env.device)
        rows: list[tuple[Tensor, ...]] = []
        for t in range(count):
            if (found or rows) and time.monotonic() > until:
                break
            action = env.random_action()
            step = env.step(action)
            row: tuple[Tensor, ...] = (observation.obs, action, step.reward, step.reached.obs)
            row += () if observation.action_mask is None else (observation.action_mask,)
            if rows:
                row = tuple(
                    torch.where(over.view(*over.shape, *(1,) * (new.dim() - 2)), old, new)
                    for old, new in zip(rows[-1], row, strict=True)
                )
            rows.append(row)
            over = over | step.ended
            observation = step.next
            watch((k * count + t + 1) * worlds, rounds * count * worlds, "steps")
        if found and len(rows) < len(found[0]):
            break
        found.append(rows)
    parts = [
        torch.cat([torch.stack(column, 2).flatten(0, 1) for column in columns]).cpu()
        for columns in zip(*(zip(*rows, strict=True) for rows in found), strict=True)
    ]
    return Transitions(*parts)


def outputs_of(data: Transitions) -> Tensor:
    """Return what a regression predicts of each agent, [M, T, N, D + 1]: change, reward and any mask."""
    outputs = [data.next_obs - data.obs, data.reward.unsqueeze(-1)]
    outputs += [] if data.action_mask is None else [data.action_mask.float()]
    return torch.cat(outputs, -1)


def turned(data: Transitions, transform: Transform) -> Transitions:
    """Return transformed transitions."""

    def one(part: Tensor) -> Tensor:
        return part.unsqueeze(0)

    return Transitions(
        transform.obs(one(data.obs))[0],
        transform.action(one(data.action))[0],
        transform.per_agent(one(data.reward))[0],
        transform.obs(one(data.next_obs))[0],
        None if data.action_mask is None else transform.push_outputs(one(data.action_mask))[0],
    )
