"""The losses of the learners, each an equation on what networks output, with its slope; see `prior.losses.Loss`.

What is minimised is the negative of the paper's objective, a mean over the rows that count: [S]. The consistency terms
S_pi and S_V (S_Q) of Eq. 8 and 9 are in `prior.losses`; `Copies.penalty` weighs them (Eq. 10).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import huber_loss

from esp_cli.networks.kernels.choices import Clipped
from esp_cli.networks.kernels.perceptron import Regression
from esp_cli.networks.policies import CompiledCategoricalPolicies, Policies
from esp_cli.prior import Copies, Loss, Term, mean_per_seed, shares
from esp_cli.prior.losses import Stated, Values


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
    return _recursion(delta, gamma * gae_lambda * (~ended).to(delta.dtype))


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
    return _recursion(torch.cat([step[:, :, :-1], target[:, :, -1:]], 2), decay)


def _recursion(x: Tensor, decay: Tensor) -> Tensor:
    """Return y [S, B, T, C] with y_t = x_t + decay_t y_{t+1} and, at the end, y_T = x_T."""
    steps, decays = x.unbind(2), decay.expand_as(x).unbind(2)
    y = [steps[-1]]
    for t in reversed(range(len(steps) - 1)):
        y.append(steps[t] + decays[t] * y[-1])
    return torch.stack(y[::-1], 2)


def normalise_per_seed(x: Tensor, epsilon: float = 1e-5, valid: Tensor | None = None) -> Tensor:
    """Return x [S, ...] at mean 0 and deviation 1 within each seed over what is `valid`; the rest becomes 0."""
    if valid is not None:
        centred = _centred(x, valid)
        deviation = mean_per_seed(centred.square(), valid).sqrt()
        return centred / (beside(deviation, x) + epsilon)
    deviation, mean = torch.std_mean(x, tuple(range(1, x.dim())), correction=0, keepdim=True)
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
    return 1 - residual / whole.clamp_min(torch.finfo(whole.dtype).tiny)


def _variance(x: Tensor, valid: Tensor | None) -> Tensor:
    return x.flatten(1).var(1, correction=0) if valid is None else mean_per_seed(_centred(x, valid).square(), valid)


def ppo_loss(head: Any, outputs: Any, copies: Copies[Any], clip_epsilon: float, entropy_coef: float) -> Loss:
    """Return the negative of the clipped objective (Eq. 3; of copies Eq. 7) and of the weighted entropy.

    The policy's outputs [S, B (1 + copies), T, N, ...] are for all rows; the ratio that is clipped to 1 +-
    `clip_epsilon` is rho = pi(K_g a given L_g s) / exp(log_prob).
    """
    batch, learned = copies.originals, copies.learned
    old_log_prob = copies.in_frame("log_prob")

    advantage = batch.advantage.flatten(1).unsqueeze(1)

    def equation(policies: Policies, weight: float, slope: Any) -> Stated:
        def log_ratio() -> Tensor:
            return policies.log_prob(batch.action, learned).sub_(old_log_prob)

        def stated() -> Tensor:
            objective = clipped_surrogate(log_ratio(), advantage, clip_epsilon)
            return objective.neg_().sub_(policies.entropy(learned), alpha=entropy_coef)

        share = shares(batch.mask, (len(advantage), learned, advantage.shape[2]))
        by_objective = -weight * share
        if isinstance(policies, CompiledCategoricalPolicies):
            weights = (by_objective, entropy_coef * by_objective)
            clipped = Clipped(batch.action, learned, old_log_prob, advantage, clip_epsilon, *weights)
            return Stated(stated, share, policies.add_clipped_slope(slope, clipped))
        by_log_ratio = surrogate_slope(log_ratio(), advantage, clip_epsilon).mul_(by_objective)
        return Stated(stated, share, policies.add_slope(slope, batch.action, by_log_ratio, entropy_coef * by_objective))

    return Loss(Term(copies.policies(head, outputs), 1.0, equation))


def clipped_surrogate(log_ratio: Tensor, advantage: Tensor, clip_epsilon: float) -> Tensor:
    """Return PPO's objective min(rho A, clip(rho, 1 - eps, 1 + eps) A)."""
    return torch.minimum(*_gain_and_bound(log_ratio, advantage, clip_epsilon))


def surrogate_slope(log_ratio: Tensor, advantage: Tensor, clip_epsilon: float) -> Tensor:
    """Return the slope of `clipped_surrogate` by log rho: rho A, or 0 where it is clipped."""
    gain, bound = _gain_and_bound(log_ratio, advantage, clip_epsilon)
    return gain.masked_fill_(gain > bound, 0.0)


def _gain_and_bound(log_ratio: Tensor, advantage: Tensor, clip_epsilon: float) -> tuple[Tensor, Tensor]:
    ratio = log_ratio.exp()
    gain = ratio * advantage
    return gain, ratio.clamp(1 - clip_epsilon, 1 + clip_epsilon).mul_(advantage)


def value_loss(
    values: Any, target: Tensor, copies: Copies[Any], huber_delta: float, clip_epsilon: float | None = None
) -> Loss:
    """Return the Huber loss, linear from `huber_delta` on, of values (Eq. 4), or of action values: L_TD.

    values [S, B (1 + copies), T, C] are of all rows, target [S, B, T, C] of the originals, which a copy shares (Prop.
    1). With `clip_epsilon` it is the larger of this and that of V_old + clip(V - V_old, -eps, eps) (MAPPO paper).
    """
    outputs, learned = copies.values(values), copies.learned
    mask = copies.originals.valued(outputs.count)
    old = None if clip_epsilon is None else copies.in_frame("value")
    target = target.flatten(1).unsqueeze(1)

    def equation(on: Values, weight: float, slope: Tensor | None) -> Stated:
        def stated() -> Tensor:
            return value_error(on.rows[:, :learned], target, huber_delta, old, clip_epsilon or 0.0)

        share = shares(mask, (on.sizes[0], learned, on.sizes[2]))
        if on.defers and slope is None and old is None and isinstance(share, float):
            asked = Regression(target, learned, huber_delta, weight * share)
            return Stated(stated, share, asked)
        by_value = value_slope(on.rows[:, :learned], target, huber_delta, old, clip_epsilon or 0.0)
        by_value.mul_(weight * share)
        if slope is None and learned == on.sizes[1]:
            return Stated(stated, share, by_value)
        slope = torch.zeros_like(on.rows) if slope is None else slope
        slope[:, :learned].add_(by_value)
        return Stated(stated, share, slope)

    return Loss(Term(outputs, 1.0, equation))


def value_error(
    value: Tensor, target: Tensor, huber_delta: float, old_value: Tensor | None = None, clip_epsilon: float = 0.0
) -> Tensor:
    """Return `value_loss` by element: e^2 / 2 within delta, delta (|e| - delta / 2) beyond."""
    error = _huber(value, target, huber_delta)
    if old_value is None:
        return error
    return torch.maximum(error, _huber(_kept_near(old_value, value, clip_epsilon), target, huber_delta))


def value_slope(
    value: Tensor, target: Tensor, huber_delta: float, old_value: Tensor | None = None, clip_epsilon: float = 0.0
) -> Tensor:
    """Return the slope of `value_error` by each value: e within delta, delta with its sign beyond; 0 where clipped."""
    slope = (value - target).clamp_(-huber_delta, huber_delta)
    if old_value is None:
        return slope
    kept = _kept_near(old_value, value, clip_epsilon)
    within = (kept - target).clamp_(-huber_delta, huber_delta) * ((value - old_value).abs() <= clip_epsilon)
    return torch.where(_huber(value, target, huber_delta) >= _huber(kept, target, huber_delta), slope, within)


def _huber(value: Tensor, target: Tensor, delta: float) -> Tensor:
    return huber_loss(value, target.expand_as(value), reduction="none", delta=delta)


def _kept_near(old_value: Tensor, value: Tensor, clip_epsilon: float) -> Tensor:
    """Return V_old + clip(V - V_old, -eps, eps)."""
    return old_value + (value - old_value).clamp_(-clip_epsilon, clip_epsilon)
