"""Measure symmetry from transitions alone: no state can be set, and the noise is unknown.

If the starts, the policy, the dynamics and the reward are symmetric, a transition and its transformed copy have one
distribution. So every expectation of (input, residual) agrees, where the residual is what a regression of change and
reward on the input leaves. The regression only takes the large common part away; the test holds without it.

Starts that are not symmetric themselves say nothing about the dynamics: there the element is "not covered".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from esp_cli.checking.candidates import is_declared
from esp_cli.checking.verdicts import SIGNIFICANT, ElementVerdict, FieldVerdict, judged
from esp_cli.prior.regression import moments, own_inputs, ridge
from esp_cli.symmetry import Element, Transform, build_transform
from esp_envs.base import Environment
from esp_envs.spec import Discrete, Spaces

EPISODES = 2048
STEPS = 8
"""Steps of each episode that are looked at."""
FEWEST = 64
"""Episodes (or single transitions) below which nothing can be told."""
_ASYMMETRIC = 0.05
"""Shift of the starts, in standard deviations, from which an element is not covered."""


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


def collect(env: Environment, episodes: int = EPISODES, steps: int = STEPS) -> Transitions:
    """Return the first steps of episodes of the random policy.

    An episode that ends earlier repeats its last transition.
    """
    found: list[list[tuple[Tensor, ...]]] = []
    for _ in range(-(-episodes // (env.num_envs * env.num_seeds))):
        observation = env.reset()
        over = torch.zeros(env.num_seeds, env.num_envs, dtype=torch.bool, device=env.device)
        rows: list[tuple[Tensor, ...]] = []
        for _ in range(min(steps, env.spec.horizon)):
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
        found.append(rows)
    parts = [
        torch.cat([torch.stack(column, 2).flatten(0, 1) for column in columns]).cpu()
        for columns in zip(*(zip(*rows, strict=True) for rows in found), strict=True)
    ]
    return Transitions(*parts)


def check_transitions(spaces: Spaces, data: Transitions, elements: Sequence[Element]) -> list[ElementVerdict]:
    """Judge elements from transitions.

    Args:
        spaces: what the numbers are, and the declared symmetry.
        data: anybody's transitions, of a policy that prefers no direction.
        elements: to try.

    Raises:
        ValueError: fewer than 64 episodes, numbers that are not finite, or actions outside the task's.
    """
    _refuse_what_says_nothing(spaces, data)
    half = len(data.obs) // 2
    inputs, outputs = own_inputs(spaces, data.obs, data.action), outputs_of(data)
    gram, cross = moments(inputs[:half].double(), outputs[:half].double())
    rows = half * data.obs.shape[1]
    model = ridge(gram / rows, cross / rows, strength=1e-3, floor=1e-6)
    held = data.episodes(slice(half, None))
    return [_judge(element, spaces, held, model) for element in elements]


def _refuse_what_says_nothing(spaces: Spaces, data: Transitions) -> None:
    if len(data.obs) < FEWEST:
        raise ValueError(f"there are {len(data.obs)} episodes of transitions; record at least {FEWEST}")
    for name in ("obs", "action", "reward", "next_obs"):
        if not bool(getattr(data, name).isfinite().all()):
            raise ValueError(f"'{name}' of the transitions holds numbers that are not finite; leave those episodes out")
    if isinstance(spaces.action, Discrete):
        count, action = spaces.action.count, data.action
        if action.is_floating_point() or not bool(((action >= 0) & (action < count)).all()):
            raise ValueError(f"'action' of the transitions holds other than the indices 0 to {count - 1}; give indices")


def _judge(element: Element, spaces: Spaces, data: Transitions, model: Tensor) -> ElementVerdict:
    transform = build_transform([element], spaces)
    declared = is_declared(element, spaces)
    image = turned(data, transform)
    if shift := _asymmetry(data.obs[:, 0], image.obs[:, 0]):
        return ElementVerdict(element.name, declared, (), f"the starts differ from their image by {shift:.2f} s.d.")
    here, there = (_statistics(spaces, part, model) for part in (data, image))
    layout = spaces.observation
    verdicts: list[FieldVerdict] = []
    for name, where in layout.slices().items():
        moved = bool((data.obs[..., where].abs() > 1e-6).any())
        verdicts.append(_field_verdict(f"obs.{name}", here, there, where, moved))
    reward = slice(layout.width, layout.width + 1)
    verdicts.append(_field_verdict("reward", here, there, reward, True))
    if data.action_mask is not None:
        verdicts.append(_field_verdict("action mask", here, there, slice(layout.width + 1, None), True))
    return ElementVerdict(element.name, declared, tuple(verdicts))


def _field_verdict(name: str, here: Tensor, there: Tensor, where: slice, moved: bool) -> FieldVerdict:
    """Judge the statistics [M, N, features, outputs] of one field."""
    gap = (here[..., where] - there[..., where]).flatten(1)
    live = gap.std(0) > 1e-9
    if not bool(live.any()):
        return judged(name, gap[:, :1], 1.0, moved)
    return judged(name, gap[:, live] / here[..., where].flatten(1).std(0)[live].clamp_min(1e-6), 1.0, moved)


def outputs_of(data: Transitions) -> Tensor:
    """Return what a regression predicts of each agent, [M, T, N, D + 1]: change, reward and any mask."""
    outputs = [data.next_obs - data.obs, data.reward.unsqueeze(-1)]
    outputs += [] if data.action_mask is None else [data.action_mask.float()]
    return torch.cat(outputs, -1)


def _statistics(spaces: Spaces, data: Transitions, model: Tensor) -> Tensor:
    """Return the products of residuals and linear inputs of each agent, mean over an episode: [M, N, inputs, D + 1]."""
    inputs, outputs = own_inputs(spaces, data.obs, data.action), outputs_of(data)
    residual = outputs - torch.einsum("mtnf,nfo->mtno", inputs, model)
    action = spaces.action
    acted = action.count - 1 if isinstance(action, Discrete) else action.width
    linear = inputs[..., : 1 + data.obs.shape[-1] + acted]  # a wrong order of actions shows beside actions alone
    return torch.einsum("mtni,mtno->mnio", linear, residual) / inputs.shape[1]


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


def _asymmetry(start: Tensor, turned: Tensor) -> float:
    """Return the largest shift of mean or spread of the starts [M, N, D] in s.d. that is no chance, else 0."""
    start, turned = start.flatten(1).double(), turned.flatten(1).double()
    spread = torch.cat([start, turned]).std(0).clamp_min(1e-3)
    worst = 0.0
    for power in (1, 2):
        gap = (start / spread) ** power - (turned / spread) ** power
        size, error = gap.mean(0).abs(), gap.std(0) / len(gap) ** 0.5
        real = (size > SIGNIFICANT * error) & (size > _ASYMMETRIC)
        worst = max(worst, float(torch.where(real, size, 0.0).max()))
    return worst
