"""The losses of the learners, each an equation on what networks output, with its slope; see `prior.losses.Loss`.

What is minimised is the negative of the paper's objective, a mean over the rows that count: [S]. The consistency terms
S_pi and S_V (S_Q) of Eq. 8 and 9 are in `prior.losses`; `Copies.penalty` weighs them (Eq. 10).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import huber_loss

from esp_cli.networks.policies import Policies
from esp_cli.prior import Copies, Loss, Term, shares
from esp_cli.prior.losses import Stated, Values


def ppo_loss(head: Any, outputs: Any, copies: Copies[Any], clip_epsilon: float, entropy_coef: float) -> Loss:
    """Return the negative of the clipped objective (Eq. 3; of copies Eq. 7) and of the weighted entropy.

    Args:
        head: of a stochastic policy.
        outputs: [S, B (1 + copies), T, N, ...] of the policy for all rows.
        copies: of what was done; the ratio is rho = pi(K_g a given L_g s) / exp(log_prob).
        clip_epsilon: of the ratio's clip.
        entropy_coef: weight of the entropy.
    """
    batch, learned = copies.originals, copies.learned
    old_log_prob = copies.in_frame("log_prob")

    def equation(policies: Policies, weight: float, slope: Any) -> Stated:
        log_ratio = policies.log_prob(batch.action, learned).sub_(old_log_prob)
        objective, by_log_ratio = clipped_surrogate(log_ratio, batch.advantage.flatten(1).unsqueeze(1), clip_epsilon)
        loss = objective.neg_().sub_(policies.entropy(learned), alpha=entropy_coef)
        share = shares(batch.mask, loss.shape)
        by_objective = -weight * share
        slope = policies.add_slope(slope, batch.action, by_log_ratio.mul_(by_objective), entropy_coef * by_objective)
        return Stated(loss, share, slope)

    return Loss(Term(copies.policies(head, outputs), 1.0, equation))


def clipped_surrogate(log_ratio: Tensor, advantage: Tensor, clip_epsilon: float) -> tuple[Tensor, Tensor]:
    """Return PPO's objective min(rho A, clip(rho, 1 - eps, 1 + eps) A), and its slope by log rho: rho A, or 0."""
    ratio = log_ratio.exp()
    gain, bound = ratio * advantage, ratio.clamp(1 - clip_epsilon, 1 + clip_epsilon) * advantage
    return torch.minimum(gain, bound), gain.masked_fill(gain > bound, 0.0)


def value_loss(
    values: Any, target: Tensor, copies: Copies[Any], huber_delta: float, clip_epsilon: float | None = None
) -> Loss:
    """Return the Huber loss of values (Eq. 4), or of action values: L_TD.

    Args:
        values: [S, B (1 + copies), T, C] for all rows.
        target: [S, B, T, C] of the originals, which a copy shares (Prop. 1).
        copies: of the batch.
        huber_delta: where the loss becomes linear.
        clip_epsilon: where given, the larger of this loss and that of V_old + clip(V - V_old, -eps, eps), as in the
            MAPPO paper.
    """
    outputs, learned = copies.values(values), copies.learned
    mask = copies.originals.valued(outputs.count)
    old = None if clip_epsilon is None else copies.in_frame("value")
    target = target.flatten(1).unsqueeze(1)

    def equation(on: Values, weight: float, slope: Tensor | None) -> Stated:
        error, by_value = value_error(on.rows[:, :learned], target, huber_delta, old, clip_epsilon or 0.0)
        share = shares(mask, error.shape)
        by_value.mul_(weight * share)
        if slope is None and learned == on.rows.shape[1]:
            return Stated(error, share, by_value)
        slope = torch.zeros_like(on.rows) if slope is None else slope
        slope[:, :learned].add_(by_value)
        return Stated(error, share, slope)

    return Loss(Term(outputs, 1.0, equation))


def value_error(
    value: Tensor, target: Tensor, huber_delta: float, old_value: Tensor | None = None, clip_epsilon: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Return the value loss and its slope, element by element; see `value_loss`.

    The Huber loss is e^2 / 2 within delta, delta (|e| - delta / 2) beyond.
    """
    target = target.expand_as(value)
    loss = huber_loss(value, target, reduction="none", delta=huber_delta)
    slope = (value - target).clamp(-huber_delta, huber_delta)
    if old_value is None:
        return loss, slope
    moved = value - old_value
    clipped = old_value + moved.clamp(-clip_epsilon, clip_epsilon)
    other = huber_loss(clipped, target, reduction="none", delta=huber_delta)
    within = (clipped - target).clamp(-huber_delta, huber_delta) * (moved.abs() <= clip_epsilon)
    return torch.maximum(loss, other), torch.where(loss >= other, slope, within)
