"""The gradient of MAPPO's losses by what the networks say, for discrete actions: a fifth of autograd's operations.

`Mappo.reference_loss` says in the terms of the paper what these are the gradients of; tests hold both together.

Shape letters: S seeds, K copies of every row, R rows (of all agents, or of worlds) without copies, A actions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from esp_cli.networks.kernels import policy_gradient as kernels
from esp_cli.networks.kernels.library import computes
from esp_cli.symmetry import Transform
from esp_cli.symmetry.maps import Gather

if TYPE_CHECKING:
    from esp_cli.algorithms.mappo_config import MappoConfig
    from esp_cli.prior import PriorConfig


@dataclass(frozen=True)
class Weights:
    """What the losses are made of.

    Attributes:
        clip_epsilon: of the clipped objective (Eq. 3).
        entropy_coef: weight of the entropy.
        huber_delta: of the value loss.
        value_coef: weight of the value loss.
        policy_gap: c of Eq. 10 where S_pi is on, else 0.
        value_gap: c of Eq. 10 where S_V is on, else 0.
        augments: whether the learner's own loss takes the copies too.
        stop_gradient: which side of the consistency losses is held fixed; see `PriorConfig`.
    """

    clip_epsilon: float
    entropy_coef: float
    huber_delta: float
    value_coef: float
    policy_gap: float
    value_gap: float
    augments: bool
    stop_gradient: str


def weights_of(config: MappoConfig, entropy_coef: float, prior: PriorConfig, augments: bool) -> Weights:
    """Return the weights of a learner with a prior, whose copies may enter the learner's own loss."""
    return Weights(
        clip_epsilon=config.clip_epsilon,
        entropy_coef=entropy_coef,
        huber_delta=config.huber_delta,
        value_coef=config.value_coef,
        policy_gap=prior.coefficient if prior.terms != "value" else 0.0,
        value_gap=prior.coefficient if prior.terms != "policy" else 0.0,
        augments=augments,
        stop_gradient=prior.stop_gradient,
    )


def carries(transforms: Sequence[Transform]) -> bool:
    """Return whether the closed forms know these transforms: all rows move, agents stay, discrete actions permute."""
    return all(
        g.is_uniform and g.agents is None and (g.action_index is None or isinstance(g.output_map, Gather))
        for g in transforms
    )


def gathers(transforms: Sequence[Transform]) -> list[Gather]:
    """Return how transforms that `carries` knows permute the logits."""
    return [g.output_map for g in transforms if isinstance(g.output_map, Gather)]


def policy_gradient(
    logits: Tensor,
    transforms: Sequence[Transform],
    action: Tensor,
    old_log_prob: Tensor,
    advantage: Tensor,
    weights: Weights,
    compiled: bool = False,
) -> Tensor:
    """Return the gradient, by the logits, of the negative of J_pi + entropy - c S_pi (Eq. 3, 7, 8): as `logits`.

    Args:
        logits: [S, (1 + K) B, N, T, A] of the originals and, behind them, of their copies, not pulled back.
        transforms: K, with which the copies were made.
        action: [S, B, T, N] int64 of the originals.
        old_log_prob: [S, B, T, N].
        advantage: [S, B, T, N].
        weights: of the terms.
        compiled: whether the kernel computes it, on the CPU.
    """
    maps = gathers(transforms)
    action, old_log_prob, advantage = (x.transpose(2, 3).flatten(1) for x in (action, old_log_prob, advantage))
    parts = logits.flatten(1, 3).transpose(1, 2).unflatten(2, (1 + len(maps), -1))
    found = _policy_gradient_compiled if computes(compiled, logits) else _policy_gradient
    gradient = found(parts, maps, action, old_log_prob, advantage, weights)
    return gradient.flatten(2).transpose(1, 2).view(logits.shape)


def _policy_gradient(
    logits: Tensor, maps: Sequence[Gather], action: Tensor, old_log_prob: Tensor, advantage: Tensor, weights: Weights
) -> Tensor:
    """Return the gradient by logits [S, A, 1 + K, R]; rows [S, R] of originals."""
    log_prob = torch.log_softmax(reordered(logits, [m.back for m in maps]), 1)
    prob = log_prob.exp()
    gradient = _objective_gradient(log_prob, prob, action, old_log_prob, advantage, weights)
    if weights.policy_gap and maps:
        _add_divergence(gradient, log_prob, prob, weights)
    by_logits = torch._log_softmax_backward_data(gradient, log_prob, 1, gradient.dtype)
    return reordered(by_logits, [m.source for m in maps])


def _policy_gradient_compiled(
    logits: Tensor, maps: Sequence[Gather], action: Tensor, old_log_prob: Tensor, advantage: Tensor, weights: Weights
) -> Tensor:
    """Return what `_policy_gradient` returns."""
    return kernels.policy_gradient(
        logits,
        [m.back for m in maps],
        action,
        old_log_prob,
        advantage,
        clip_epsilon=weights.clip_epsilon,
        entropy_coef=weights.entropy_coef,
        gap=weights.policy_gap,
        augments=weights.augments,
        stop_gradient=weights.stop_gradient,
    )


def _objective_gradient(
    log_prob: Tensor, prob: Tensor, action: Tensor, old_log_prob: Tensor, advantage: Tensor, weights: Weights
) -> Tensor:
    """Return the gradient of -(J_pi + entropy) by the log-probabilities [S, A, 1 + K, R]; rows [S, R] of originals.

    What is the same for all actions is left out, as the 1 in the entropy's (log p + 1) p: the gradient by the logits
    does not depend on it.
    """
    if not weights.augments and log_prob.shape[2] > 1:
        own = _objective_gradient(log_prob[:, :, :1], prob[:, :, :1], action, old_log_prob, advantage, weights)
        return torch.cat([own, torch.zeros_like(log_prob[:, :, 1:])], 2)
    share = 1.0 / (log_prob.shape[2] * log_prob.shape[3])
    taken, advantage = action[:, None, None].expand(-1, 1, log_prob.shape[2], -1), advantage[:, None, None]
    log_ratio = log_prob.gather(1, taken) - old_log_prob[:, None, None]
    slope = surrogate_slope(log_ratio, advantage, weights.clip_epsilon)
    gradient = (log_prob * prob).mul_(weights.entropy_coef * share)
    return gradient.scatter_add_(1, taken, slope.mul_(-share))


def surrogate_slope(log_ratio: Tensor, advantage: Tensor, clip_epsilon: float) -> Tensor:
    """Return the slope of PPO's objective by log pi: rho A, or 0 where it is clipped; works in place on `log_ratio`."""
    ratio = log_ratio.exp_()
    gain = ratio * advantage
    bound = ratio.clamp_(1 - clip_epsilon, 1 + clip_epsilon).mul_(advantage)
    return gain.masked_fill_(gain > bound, 0.0)


def _add_divergence(gradient: Tensor, log_prob: Tensor, prob: Tensor, weights: Weights) -> None:
    """Add the gradient of c KL[copy || original], averaged over copies and rows."""
    weight = weights.policy_gap / ((log_prob.shape[2] - 1) * log_prob.shape[3])
    moved = prob[:, :, 1:]
    if weights.stop_gradient != "transformed":
        gradient[:, :, 1:].addcmul_(log_prob[:, :, 1:] - log_prob[:, :, :1], moved, value=weight)
    if weights.stop_gradient != "original":
        gradient[:, :, :1].sub_(moved if moved.shape[2] == 1 else moved.sum(2, keepdim=True), alpha=weight)


def critic_gradient(values: Tensor, target: Tensor, weights: Weights) -> Tensor:
    """Return the gradient, by the values, of the weighted Huber loss + c S_V (Eq. 4, 9): as `values`.

    Args:
        values: [S, (1 + K) B, T, C] of the originals and, behind them, of their copies.
        target: [S, B, T, C].
        weights: of the terms.
    """
    parts = values.unflatten(1, (-1, target.shape[1]))
    learned = parts if weights.augments else parts[:, :1]
    gradient = (learned - target.unsqueeze(1)).clamp_(-weights.huber_delta, weights.huber_delta)
    gradient.mul_(weights.value_coef * values.shape[0] / learned.numel())
    if learned.shape[1] < parts.shape[1]:
        gradient = torch.cat([gradient, torch.zeros_like(parts[:, 1:])], 1)
    if weights.value_gap and parts.shape[1] > 1:
        gap = parts[:, 1:] - parts[:, :1]
        weight = 2 * weights.value_gap * values.shape[0] / gap.numel()
        if weights.stop_gradient != "transformed":
            gradient[:, 1:].add_(gap, alpha=weight)
        if weights.stop_gradient != "original":
            gradient[:, :1].sub_(gap if gap.shape[1] == 1 else gap.sum(1, keepdim=True), alpha=weight)
    return gradient.view(values.shape)


def reordered(x: Tensor, orders: Sequence[Tensor]) -> Tensor:
    """Give the actions of every copy another order.

    Args:
        x: [S, A, ..., 1 + K, R], whose first part, the originals, stays as it is.
        orders: K, [S or 1, A] each: which action comes to each place.
    """
    if not orders:
        return x
    num_seeds, num_actions, *middle, parts, rows = x.shape
    stays, below = _places(num_seeds, num_actions, math.prod(middle), parts, x.device)
    order = torch.stack([stays, *(order.expand(num_seeds, -1) for order in orders)], 2)  # [S, A, 1 + K]
    index = torch.add(below, order.unsqueeze(2), alpha=math.prod(middle) * parts)
    return x.reshape(-1, rows).index_select(0, index.view(-1)).view(x.shape)


@lru_cache
def _places(num_seeds: int, num_actions: int, middle: int, parts: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return each action's own number [S, A], and the rows [S, 1, middle, parts] of action 0 among all of them."""
    own = torch.arange(num_actions, device=device).expand(num_seeds, -1)
    rows = torch.arange(num_seeds * num_actions * middle * parts, device=device)
    return own, rows.view(num_seeds, num_actions, middle, parts)[:, :1]
