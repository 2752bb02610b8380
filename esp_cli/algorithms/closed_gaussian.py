"""The gradient of MAPPO's policy terms by what the actor says, for the Gaussian of continuous actions.

`Mappo.reference_loss` says in the terms of the paper what this is the gradient of; tests hold both together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from esp_cli.algorithms.closed_form import Weights, surrogate_slope
from esp_cli.symmetry import Transform

_HALF_LOG_TAU = 0.5 * math.log(2 * math.pi)


def gaussian_gradient(
    mean: Tensor,
    log_std: Tensor,
    transforms: Sequence[Transform],
    action: Tensor,
    old_log_prob: Tensor,
    advantage: Tensor,
    weights: Weights,
) -> tuple[Tensor, Tensor]:
    """Return the gradients of the negative of J_pi + entropy - c S_pi (Eq. 3, 7, 8): as `mean`, and [S, width].

    Args:
        mean: [S, (1 + K) B, T, N, width] of the originals and, behind them, of their copies, not pulled back.
        log_std: [S, 1, 1, 1, width] logarithm of the deviation of each number.
        transforms: K, with which the copies were made; agents stay in their places.
        action: [S, B or (1 + K) B, T, N, width] latent actions of what the objective takes.
        old_log_prob: [S, B or (1 + K) B, T, N].
        advantage: likewise.
        weights: of the terms.
    """
    learned, precision = mean[:, : action.shape[1]], (-log_std).exp()
    z = (action - learned).mul_(precision)
    square = z.square()
    log_prob = (-0.5 * square - log_std - _HALF_LOG_TAU).sum(-1)
    slope = surrogate_slope(log_prob - old_log_prob, advantage, weights.clip_epsilon)
    slope = slope.mul_(-1.0 / slope[0].numel()).unsqueeze(-1)
    by_mean = z.mul_(precision).mul_(slope)
    by_log_std = square.sub_(1).mul_(slope).flatten(1, 3).sum(1).sub_(weights.entropy_coef)
    if learned.shape[1] < mean.shape[1]:
        by_mean = torch.cat([by_mean, torch.zeros_like(mean[:, learned.shape[1] :])], 1)
    if weights.policy_gap and transforms:
        by_log_std -= _add_divergence(by_mean, mean, precision, transforms, weights)
    return by_mean, by_log_std


def _add_divergence(
    by_mean: Tensor, mean: Tensor, precision: Tensor, transforms: Sequence[Transform], weights: Weights
) -> Tensor:
    """Add the gradient of c KL[copy || original], averaged over copies and rows; return minus that by log_std."""
    here, *copies = mean.split(mean.shape[1] // (1 + len(transforms)), 1)
    by_here, *by_copies = by_mean.split(here.shape[1], 1)
    weight = weights.policy_gap / (len(transforms) * here[0, ..., 0].numel())
    total = torch.zeros_like(mean[:, 0, 0, 0])
    for g, copy, by_copy in zip(transforms, copies, by_copies, strict=True):
        gap = g.pull_back(copy) - here
        slope = gap * precision.square().mul_(weight)
        if weights.stop_gradient != "transformed":
            by_copy.add_(g.push_outputs(slope))  # K_g is orthogonal
        if weights.stop_gradient != "original":
            by_here.sub_(slope)
        total += (slope * gap).flatten(1, 3).sum(1)
    return total
