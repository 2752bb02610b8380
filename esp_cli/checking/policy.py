"""How symmetric a policy is: how often it chooses the transformed action in the transformed state."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass

import torch
from torch import Tensor

from esp_cli.checking.candidates import candidates
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.symmetry import build_transform
from esp_cli.training.build import with_compass
from esp_envs.base import Observation
from esp_envs.errors import UserError
from esp_envs.promises import MakeWorlds

_WORLDS, _STEPS = 64, 10
CLOSE = 0.1  # continuous actions nearer than this, in every number, count as the same


@dataclass(frozen=True)
class PolicyVerdict:
    """How a policy acts under an element."""

    element: str
    agreement: float  # share of agents and states whose greedy action transforms; continuous ones within 0.1
    distance: float | None = None  # of continuous actions: 1 as far apart as actions of unrelated states


def check_policy(trained: TrainedPolicy, make: MakeWorlds, transforms: str | None = None) -> list[PolicyVerdict]:
    """Measure how symmetric a policy's greedy actions are in its own episodes' first steps; see `check_symmetry`."""
    env = with_compass(make(_WORLDS, trained.config.seeds), trained.config.prior)
    if (env.spec.observation, env.spec.action) != (trained.spec.observation, trained.spec.action):
        raise UserError(f"{trained.source} is a policy of {trained.config.task}, which sees or does other things")
    policy = deepcopy(trained.policy).cpu()
    steps: list[tuple[Observation, Tensor]] = []
    observation = env.reset()
    blank = memory = policy.initial_memory(_WORLDS, observation.obs)
    with torch.no_grad():
        for _ in range(min(env.spec.horizon, _STEPS)):
            action, memory = policy.act(observation.obs, memory, action_mask=observation.action_mask)
            steps.append((observation, action))
            observation = env.step(action).next
        verdicts = []
        for element in candidates(env.spec, transforms):
            transform, memory, pairs = build_transform([element], env.spec), blank, []
            for there, action in steps:
                mask = None if there.action_mask is None else transform.push_outputs(there.action_mask)
                moved, memory = policy.act(transform.obs(there.obs), memory, action_mask=mask)
                pairs.append((moved, transform.action(action)))
            verdicts.append(PolicyVerdict(element.name, *_compared(pairs)))
    return verdicts


def _compared(pairs: Sequence[tuple[Tensor, Tensor]]) -> tuple[float, float | None]:
    """Return agreement and distance of actions and of those that were expected."""
    moved, image = (torch.stack(part) for part in zip(*pairs, strict=True))  # [T, S, E, N(, numbers)]
    if not moved.is_floating_point():
        return float((moved == image).float().mean()), None
    same = ((moved - image).abs() < CLOSE).all(-1)
    gap, unrelated = ((moved - x).square().mean() for x in (image, image.roll(1, 2)))  # of the next world
    return float(same.float().mean()), float((gap / unrelated.clamp_min(1e-30)).sqrt())
