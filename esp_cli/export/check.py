"""Whether an export does what the policy does: both act on the same observations, thousands of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from esp_cli.export.layers import Floats
from esp_cli.export.program import Program
from esp_cli.networks.heads import masked
from esp_cli.policies.loading import TrainedPolicy

OBSERVATIONS = 10_000  # observations on which every export is compared with its policy
TOLERANCE = 1e-4
"""Largest difference of an output, as a share of the largest output (or of 1); float32 in another order gives 1e-6."""
_STEPS = 50

Numbers = NDArray[Any]


@dataclass(frozen=True)
class Sample:
    """What the policy itself does, row by row."""

    obs: Floats  # [B, D]
    memory: Floats  # [B, H]
    mask: Numbers | None  # [B, A] bool, the allowed actions; None allows all
    sets: dict[str, Floats]  # [B, K, W] by name, beside own numbers; see `Program`
    outputs: Floats  # [B, O]
    action: Numbers  # [B] or [B, width]
    after: Floats  # [B, H], the next memory


Runner = Callable[[Sample], tuple[Numbers, Numbers, Numbers]]
"""What observation, memory, mask and sets of a sample come to: action, outputs and next memory."""


@dataclass(frozen=True)
class Agreement:
    """How far an export is from the policy."""

    observations: int  # compared
    max_difference: float  # of an output, an action's number or the memory after it
    other_actions: int | None  # that differ, each of them a tie within rounding; None where the head does not choose


@torch.no_grad()
def take_sample(trained: TrainedPolicy, program: Program, count: int = OBSERVATIONS) -> Sample:
    """Let one seed's policy act: one half on observations that it meets in its task, one half on random ones."""
    half, rng = math.ceil(count / 2 / program.team) * program.team, np.random.default_rng(0)  # whole worlds of a team
    obs, memory, mask = _play(trained, half)
    obs = torch.cat([obs, torch.from_numpy(rng.standard_normal((half, obs.shape[1]), np.float32))])
    drawn = rng.uniform(-1, 1, (half, program.memory_width)).astype(np.float32)
    if program.previous and program.head == "choose":
        drawn[:, program.hidden :] = np.eye(program.previous)[rng.integers(program.previous, size=half)]
    memory = torch.cat([memory, torch.from_numpy(drawn)])
    if mask is not None:
        mask = torch.cat([mask, torch.from_numpy(rng.random((half, program.num_outputs)) < 0.6)])
    allowed = None if mask is None else mask[None, None]
    action, after = trained.policy.act(obs[None, None], memory[None], action_mask=allowed)
    hidden, previous = memory.split([program.hidden, program.previous], 1)
    # its outputs before the head normalises them
    outputs = trained.policy.actor.step(torch.cat([obs, previous], 1)[None], hidden[None])[0][0]
    own, sets = program.split(obs.numpy())
    masks = None if mask is None else mask.numpy()
    return Sample(own, memory.numpy(), masks, sets, outputs.numpy(), action[0, 0].numpy(), after[0].numpy())


def _play(trained: TrainedPolicy, count: int) -> tuple[Tensor, Tensor, Tensor | None]:
    """Play a little and return the first observations, memories and action masks that the policy meets."""
    steps = min(_STEPS, trained.spec.horizon)
    env = trained.worlds(math.ceil(count / (steps * trained.spec.num_agents)), "export")
    observation = env.reset()
    memory = trained.policy.initial_memory(env.num_envs, observation.obs)
    rows: list[tuple[Tensor, ...]] = []
    for _ in range(steps):
        mask = observation.action_mask
        rows.append((observation.obs.flatten(0, 2), memory[0], *([] if mask is None else [mask.flatten(0, 2)])))
        action, memory = trained.policy.act(observation.obs, memory, action_mask=mask)
        observation = env.step(action).next
    obs, memory, *masks = (torch.cat(parts)[:count] for parts in zip(*rows, strict=True))
    return obs, memory, masks[0] if masks else None


def compare(sample: Sample, runner: Runner) -> Agreement:
    """Compare an export with the policy."""
    action, outputs, after = runner(sample)
    largest = max(1.0, float(np.abs(sample.outputs).max()))
    gap = float(np.abs(outputs - sample.outputs).max())
    chooses, ties = sample.action.dtype.kind == "i", True
    differing = np.zeros(len(sample.obs), bool)
    if chooses:
        differing = action != sample.action
        mask = None if sample.mask is None else torch.from_numpy(sample.mask)
        choosable = masked(torch.from_numpy(sample.outputs), mask).numpy()  # forbidden actions are out of reach
        if differing.any():
            first, second = np.sort(choosable[differing], 1)[:, ::-1][:, :2].T
            ties = bool((first - second <= 2 * TOLERANCE * largest).all())
    else:
        gap = max(gap, float(np.abs(action - sample.action).max()))
    if sample.after.size:  # after another choice the memory holds another previous action
        gap = max(gap, float(np.abs(after[~differing] - sample.after[~differing]).max()))
    if not gap <= TOLERANCE * largest or not ties:
        raise RuntimeError(
            f"the export differs from the policy by {gap:g} of {largest:g}; this is a bug, unless the policy's outputs "
            "jump with the rounding of its observations, as where network.near chooses among things equally near"
        )
    return Agreement(len(sample.obs), gap, int(differing.sum()) if chooses else None)
