"""Transitions of anybody, or collected from a task: what they say of each agent, and their images."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from esp_cli.checking.verdicts import Watch
from esp_cli.symmetry import Transform
from esp_envs.base import Environment

EPISODES = 2048
STEPS = 8  # steps of each episode that are looked at


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
        terminated: [M, T, N] bool, whether the step ended the episode for good; None where none does.
    """

    obs: Tensor
    action: Tensor
    reward: Tensor
    next_obs: Tensor
    action_mask: Tensor | None = None
    terminated: Tensor | None = None

    def map(self, function: Callable[[Tensor], Tensor]) -> Transitions:
        """Return transitions with every tensor put through a function."""
        return Transitions(**{name: function(part) for name, part in vars(self).items() if part is not None})

    def episodes(self, where: slice) -> Transitions:
        """Return some of the episodes."""
        return self.map(lambda x: x[where])


def collect(
    env: Environment,
    episodes: int = EPISODES,
    steps: int = STEPS,
    until: float = math.inf,
    watch: Watch = lambda *_: None,
) -> Transitions:
    """Return the first steps of random episodes, of which one that ends earlier repeats its last transition.

    After `until` no step is begun: episodes under way are left out, of the first ones only the missing steps.
    """
    worlds = env.num_envs * env.num_seeds
    rounds, count = -(-episodes // worlds), min(steps, env.spec.horizon)
    found: list[list[dict[str, Tensor]]] = []
    for k in range(rounds):
        observation = env.reset()
        over = torch.zeros(env.num_seeds, env.num_envs, dtype=torch.bool, device=env.device)
        rows: list[dict[str, Tensor]] = []
        for t in range(count):
            if (found or rows) and time.monotonic() > until:
                break
            action = env.random_action()
            step = env.step(action)
            row = {"obs": observation.obs, "action": action, "reward": step.reward, "next_obs": step.reached.obs}
            if observation.action_mask is not None:
                row["action_mask"] = observation.action_mask
            if env.spec.terminates:
                row["terminated"] = step.terminated.unsqueeze(-1).expand_as(step.reward)
            rows.append({name: picked(over, rows[-1][name], new) for name, new in row.items()} if rows else row)
            over = over | step.ended
            observation = step.next
            watch((k * count + t + 1) * worlds, rounds * count * worlds, "steps")
        if found and len(rows) < len(found[0]):
            break
        found.append(rows)
    parts = {
        name: torch.cat([torch.stack([row[name] for row in rows], 2).flatten(0, 1) for rows in found]).cpu()
        for name in found[0][0]
    }
    return Transitions(**parts)


def picked(flags: Tensor, there: Tensor, elsewhere: Tensor) -> Tensor:
    """Return of two tensors [S, E, ...] the first in worlds whose flags [S, E] are on, the second elsewhere."""
    return torch.where(flags.view(*flags.shape, *(1,) * (there.dim() - 2)), there, elsewhere)


def outputs_of(data: Transitions) -> Tensor:
    """Return what a regression predicts of each agent, [M, T, N, D + 1]: change, reward, and any mask and end."""
    outputs = [data.next_obs - data.obs, data.reward.unsqueeze(-1)]
    outputs += [] if data.action_mask is None else [data.action_mask.float()]
    outputs += [] if data.terminated is None else [data.terminated.float().unsqueeze(-1)]
    return torch.cat(outputs, -1)


def turned(data: Transitions, transform: Transform) -> Transitions:
    """Return transformed transitions."""
    moves = {"obs": transform.obs, "next_obs": transform.obs, "action": transform.action}
    moves |= {"action_mask": transform.push_outputs}
    parts = {name: part.unsqueeze(0) for name, part in vars(data).items() if part is not None}
    return Transitions(**{name: moves.get(name, transform.per_agent)(part)[0] for name, part in parts.items()})
