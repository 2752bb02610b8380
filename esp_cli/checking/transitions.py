"""Measure symmetry from transitions alone: no state can be set, and the noise is unknown.

If the starts, the policy, the dynamics and the reward are symmetric, a transition and its transformed copy have one
distribution. So every expectation of (input, residual) agrees, where the residual is what a regression of change and
reward on the input leaves. The regression only takes the large common part away; the test holds without it.

Starts that are not symmetric themselves say nothing about the dynamics: there the element is "not covered".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from esp_cli.checking.candidates import is_declared
from esp_cli.checking.recorded import Transitions, outputs_of, turned
from esp_cli.checking.regression import MATERIAL, check_by_regression
from esp_cli.checking.verdicts import SIGNIFICANT, ElementVerdict, FieldVerdict, judged
from esp_cli.prior.regression import moments, orders_of_others, own_inputs, ridge
from esp_cli.symmetry import Element, build_transform
from esp_envs.errors import UserError
from esp_envs.spec import Discrete, Spaces

FEWEST = 64
"""Episodes (or single transitions) below which nothing can be told."""
_ASYMMETRIC = 0.05
"""Shift of the starts, in standard deviations, from which an element is not covered."""


def check_transitions(spaces: Spaces, data: Transitions, elements: Sequence[Element]) -> list[ElementVerdict]:
    """Judge elements from transitions.

    Args:
        spaces: what the numbers are, and the declared symmetry.
        data: anybody's transitions, of a policy that prefers no direction.
        elements: to try.

    Raises:
        UserError: fewer than 64 episodes, numbers that are not finite, or actions outside the task's.
    """
    data = _in_float32(data)
    _refuse_what_says_nothing(spaces, data)
    half = len(data.obs) // 2
    inputs, outputs = own_inputs(spaces, data.obs, data.action), outputs_of(data)
    gram, cross = moments(inputs[:half].double(), outputs[:half].double())
    rows = half * data.obs.shape[1]
    model = ridge(gram / rows, cross / rows, strength=1e-3, floor=1e-6)
    held = data.episodes(slice(half, None))
    verdicts = [_judge(element, spaces, held, model) for element in elements]
    exchanging = [element for element in elements if element.permutation is not None]
    sharper = {verdict.element: verdict for verdict in check_by_regression(spaces, data, exchanging)}
    return [_sharpened(verdict, sharper.get(verdict.element)) for verdict in verdicts]


def _sharpened(verdict: ElementVerdict, by_regression: ElementVerdict | None) -> ElementVerdict:
    """Return a verdict with the fields that a regression on what all agents see and do shows to be broken.

    It sees a wrong order of agents in what an agent sees, of which the products of its own numbers show little.
    """
    if by_regression is None or not verdict.fields:
        return verdict
    broken = {f.field: f for f in by_regression.fields if f.gap > max(MATERIAL, SIGNIFICANT * f.error)}
    return replace(verdict, fields=tuple(broken.get(f.field, f) for f in verdict.fields))


def _in_float32(data: Transitions) -> Transitions:
    parts = [part for part in vars(data).values() if part is not None]
    return Transitions(*(part.float() if part.is_floating_point() else part for part in parts))


def _refuse_what_says_nothing(spaces: Spaces, data: Transitions) -> None:
    lead = (*data.obs.shape[:2], spaces.num_agents)
    width = () if isinstance(spaces.action, Discrete) else (spaces.action.width,)
    seen = (*lead, spaces.observation.width)
    for name, shape in (("obs", seen), ("action", (*lead, *width)), ("reward", lead), ("next_obs", seen)):
        if (found := tuple(getattr(data, name).shape)) != shape or len(lead) != 3:
            axes = "[episodes, steps, agents]" + (" and the width" if len(shape) > 3 else "")
            raise UserError(f"'{name}' of the transitions has shape {list(found)}; give {axes}: {list(shape)}")
    if len(data.obs) < FEWEST:
        raise UserError(f"there are {len(data.obs)} episodes of transitions; record at least {FEWEST}")
    for name in ("obs", "action", "reward", "next_obs"):
        if not bool(getattr(data, name).isfinite().all()):
            raise UserError(f"'{name}' of the transitions holds numbers that are not finite; leave those episodes out")
    if isinstance(spaces.action, Discrete):
        count, action = spaces.action.count, data.action
        if action.is_floating_point() or not bool(((action >= 0) & (action < count)).all()):
            raise UserError(f"'action' of the transitions holds other than the indices 0 to {count - 1}; give indices")


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


def _statistics(spaces: Spaces, data: Transitions, model: Tensor) -> Tensor:
    """Return the products of residuals and linear inputs of each agent, mean over an episode: [M, N, inputs, D + 1].

    Inputs are what the agent sees and does, and what the others do: a wrong order of agents in what it sees shows
    beside their actions alone.
    """
    inputs, outputs = own_inputs(spaces, data.obs, data.action), outputs_of(data)
    residual = outputs - torch.einsum("mtnf,nfo->mtno", inputs, model)
    action = spaces.action
    acted = action.count - 1 if isinstance(action, Discrete) else action.width
    linear = inputs[..., : 1 + data.obs.shape[-1] + acted]  # a wrong order of actions shows beside actions alone
    own = linear[..., 1 + data.obs.shape[-1] :]
    linear = torch.cat([linear, *(own[:, :, order] for order in orders_of_others(spaces.num_agents))], -1)
    return torch.einsum("mtni,mtno->mnio", linear, residual) / inputs.shape[1]


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
