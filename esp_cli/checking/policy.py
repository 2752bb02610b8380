"""How symmetric a policy is: how often it chooses the transformed action in the transformed state."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from esp_cli.checking.candidates import candidates
from esp_cli.symmetry import build_transform
from esp_cli.training.loading import TrainedPolicy
from esp_envs.conformance.subject import MakeWorlds

_WORLDS = 64
_CLOSE = 0.1
"""Continuous actions nearer than this, in every number, count as the same."""


@dataclass(frozen=True)
class PolicyVerdict:
    """Under an element, the share of agents and states in which the greedy action transforms as it should."""

    element: str
    agreement: float


def check_policy(trained: TrainedPolicy, make: MakeWorlds, transforms: str | None = None) -> list[PolicyVerdict]:
    """Measure how symmetric a policy's greedy actions are in the first steps of its own episodes.

    Args:
        trained: one or several seeds of a policy for this task.
        make: makes E worlds for some seeds.
        transforms: which elements; see `check_symmetry`.

    Raises:
        ValueError: the policy is of another task.
    """
    env = make(_WORLDS, trained.config.seeds)
    if (env.spec.observation, env.spec.action) != (trained.spec.observation, trained.spec.action):
        raise ValueError(f"{trained.source} is a policy of {trained.config.task}, which sees or does other things")
    policy = trained.policy.cpu()
    seen: list[Tensor] = []
    masks: list[Tensor] = []
    observation = env.reset()
    memory = policy.initial_memory(_WORLDS, observation.obs)
    with torch.no_grad():
        for _ in range(min(env.spec.horizon, 10)):
            seen.append(observation.obs)
            masks += [] if observation.action_mask is None else [observation.action_mask]
            action, memory = policy.act(observation.obs, memory, action_mask=observation.action_mask)
            observation = env.step(action).next
        verdicts = []
        rows, mask = torch.cat(seen, 1), torch.cat(masks, 1) if masks else None
        blank = policy.initial_memory(rows.shape[1], rows)
        here = policy.act(rows, blank, action_mask=mask)[0]
        for element in candidates(env.spec, transforms):
            transform = build_transform([element], env.spec)
            turned = None if mask is None else transform.push_outputs(mask)
            there = policy.act(transform.obs(rows), blank, action_mask=turned)[0]
            expected = transform.action(here)
            same = there == expected if not there.is_floating_point() else ((there - expected).abs() < _CLOSE).all(-1)
            verdicts.append(PolicyVerdict(element.name, float(same.float().mean())))
    return verdicts
