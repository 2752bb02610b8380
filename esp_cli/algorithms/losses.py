"""The equations of the learners as pure functions; each is tested by numbers worked out by hand."""

from __future__ import annotations

import torch
from torch import Tensor

from esp_cli.prior import mean_per_seed


def gae(
    reward: Tensor,
    value: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    ended: Tensor,
    gamma: float,
    gae_lambda: float,
) -> Tensor:
    """Return generalised advantage estimates [S, E, T, C] (Schulman et al., 2016).

    delta_t = r_t + gamma (1 - terminated_t) V(s_{t+1}) - V(s_t)
    A_t = delta_t + gamma lambda (1 - ended_t) A_{t+1}

    Args:
        reward: [S, E, T, C], C = 1 for a shared reward, else N.
        value: [S, E, T, C] V(s_t).
        next_value: [S, E, T, C] V of the state that really followed, the final one where an episode ended.
        terminated: [S, E, T, 1], or [S, E, T, N] where agents end; no value lies beyond.
        ended: likewise, terminated or truncated; the next row belongs to another episode.
        gamma: discount factor.
        gae_lambda: 0 is one-step temporal difference, 1 Monte Carlo.
    """
    delta = torch.where(terminated, reward, reward + gamma * next_value) - value
    decay = gamma * gae_lambda * (~ended).to(delta.dtype)
    advantage, carry = torch.empty_like(delta), torch.zeros_like(delta[:, :, 0])
    for t in reversed(range(delta.shape[2])):
        carry = delta[:, :, t] + decay[:, :, t] * carry
        advantage[:, :, t] = carry
    return advantage


def td_targets(
    reward: Tensor, next_value: Tensor, ended: Tensor, gamma: float, td_lambda: float, cut: Tensor | None = None
) -> Tensor:
    """Return targets [S, B, T, C] for action values: one-step, or TD(lambda) along the stored episode.

    y_t = r_t + gamma (1 - ended_t) ((1 - lambda) Q(s_{t+1}) + lambda y_{t+1}), and y_{t+1} = Q(s_{t+1}) at the
    last step of an episode.

    Args:
        reward: [S, B, T, C].
        next_value: [S, B, T, C] target network's value of the state that really followed.
        ended: [S, B, T, 1] bool, or [S, B, T, N] where agents end; no value lies beyond.
        gamma: discount factor.
        td_lambda: 0 is the one-step target, 1 the discounted return of what was done.
        cut: [S, B, T, 1] bool, the last steps of episodes that were truncated before the end of the rows.
    """
    ahead = torch.where(ended, 0.0, gamma * next_value)
    if td_lambda == 0:
        return reward + ahead
    step, decay = reward + (1 - td_lambda) * ahead, td_lambda * gamma * (~ended).to(reward.dtype)
    target = reward + ahead
    if cut is not None:
        step, decay = torch.where(cut, target, step), decay.masked_fill(cut, 0)
    for t in reversed(range(reward.shape[2] - 1)):
        target[:, :, t] = step[:, :, t] + decay[:, :, t] * target[:, :, t + 1]
    return target


def normalise_per_seed(x: Tensor, epsilon: float = 1e-5, valid: Tensor | None = None) -> Tensor:
    """Return x [S, ...] shifted and scaled to mean 0 and standard deviation 1 within each seed.

    `valid`, of the shape of x, says which numbers count; the others become 0.
    """
    if valid is not None:
        centred = _centred(x, valid)
        deviation = mean_per_seed(centred.square(), valid).sqrt()
        return centred / (beside(deviation, x) + epsilon)
    axes = tuple(range(1, x.dim()))
    deviation, mean = torch.std_mean(x, axes, correction=0, keepdim=True)
    return (x - mean) / (deviation + epsilon)


def _centred(x: Tensor, valid: Tensor) -> Tensor:
    """Return x less the mean of each seed over what counts; 0 where nothing counts."""
    return torch.where(valid, x - beside(mean_per_seed(x, valid), x), 0.0)


def beside(per_seed: Tensor, x: Tensor) -> Tensor:
    """Return numbers per seed [S] shaped to stand beside x [S, ...]."""
    return per_seed.view(-1, *[1] * (x.dim() - 1))


def explained_variance(value: Tensor, target: Tensor, valid: Tensor | None = None) -> Tensor:
    """Return 1 - Var[target - value] / Var[target] per seed, [S, ...] -> [S], over the numbers that are valid."""
    residual, whole = _variance(target - value, valid), _variance(target, valid)
    return 1 - residual / whole.clamp_min(1e-8)


def _variance(x: Tensor, valid: Tensor | None) -> Tensor:
    """Return the variance [S] of each seed over what counts."""
    if valid is None:
        return x.flatten(1).var(1, correction=0)
    return mean_per_seed(_centred(x, valid).square(), valid)
