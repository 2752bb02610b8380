"""MAPPO's losses for discrete actions with gradients worked out by hand: some fifty operations instead of some 250.

`Mappo.reference_loss` under autograd says the same in the terms of the paper; tests hold both together. A loss is
computed together with its gradient, since each is a sum over rows of what both need.

Shape letters: S seeds, K copies of every row, R rows (of all agents, or of worlds) without copies, A actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor
from torch.autograd import Function

from esp_cli.symmetry import Transform
from esp_cli.symmetry.maps import Gather

if TYPE_CHECKING:
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


class Settings(Protocol):
    """What a learner's hyperparameters say of its losses."""

    @property
    def clip_epsilon(self) -> float:
        """See `Weights`."""

    @property
    def huber_delta(self) -> float:
        """See `Weights`."""

    @property
    def value_coef(self) -> float:
        """See `Weights`."""


def weights_of(config: Settings, entropy_coef: float, prior: PriorConfig, augments: bool) -> Weights:
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
    """Return whether `policy_loss` can pull back the logits of copies: where agents stay, and actions are discrete."""
    return all(g.agents is None and isinstance(g.output_map, Gather) for g in transforms)


def policy_loss(
    logits: Tensor,
    transforms: Sequence[Transform],
    action: Tensor,
    old_log_prob: Tensor,
    advantage: Tensor,
    weights: Weights,
) -> Tensor:
    """Return the negative of J_pi + entropy - c S_pi (Eq. 3, 7, 8) per seed: [S].

    Args:
        logits: [S, (1 + K) B, N, T, A] of the originals and, behind them, of their copies, not pulled back.
        transforms: K, with which the copies were made.
        action: [S, B, T, N] int64 of the originals.
        old_log_prob: [S, B, T, N].
        advantage: [S, B, T, N].
        weights: of the terms.
    """
    rows = (x.transpose(2, 3).flatten(1) for x in (action, old_log_prob, advantage))
    maps = [g.output_map for g in transforms if isinstance(g.output_map, Gather)]
    return _PolicyLoss.apply(  # type: ignore[no-untyped-call]
        logits.flatten(1, 3), maps, *rows, weights
    )


def critic_loss(values: Tensor, target: Tensor, weights: Weights) -> Tensor:
    """Return the weighted Huber loss + c S_V (Eq. 4, 9) per seed: [S].

    Args:
        values: [S, (1 + K) B, T, C] of the originals and, behind them, of their copies.
        target: [S, B, T, C].
        weights: of the terms.
    """
    by_part = values.reshape(values.shape[0], values.shape[1] // target.shape[1], -1)
    return _CriticLoss.apply(by_part, target.flatten(1), weights)  # type: ignore[no-untyped-call]


def _by_part(x: Tensor, num_parts: int) -> list[Tensor]:
    """Cut [S, A, (1 + K) R] into 1 + K parts [S, A, R]; views."""
    return list(x.unflatten(2, (num_parts, -1)).unbind(2))


def _reordered(parts: list[Tensor], orders: Sequence[Tensor]) -> list[Tensor]:
    """Give the actions of every copy another order [S or 1, A]; the originals' stays."""
    here, *copies = parts
    return [here, *(x.gather(1, order.unsqueeze(2).expand(x.shape)) for x, order in zip(copies, orders, strict=True))]


class _PolicyLoss(Function):
    @staticmethod
    def forward(ctx, logits, maps, action, old_log_prob, advantage, weights):  # type: ignore[no-untyped-def]
        parts = _by_part(logits.transpose(1, 2), 1 + len(maps))
        log_prob = torch.log_softmax(torch.stack(_reordered(parts, [m.back for m in maps]), 1), 2)  # [S, 1 + K, A, R]
        prob = log_prob.exp()
        num_learned = len(parts) if weights.augments else 1
        share = 1.0 / (num_learned * action.shape[1])
        learned, taken = log_prob[:, :num_learned], action[:, None, None].expand(-1, num_learned, 1, -1)
        advantage = advantage.unsqueeze(1)

        ratio = (learned.gather(2, taken).squeeze(2) - old_log_prob.unsqueeze(1)).exp_()
        gain = ratio * advantage
        bound = ratio.clamp_(1 - weights.clip_epsilon, 1 + weights.clip_epsilon).mul_(advantage)
        objective = torch.minimum(gain, bound).sum((1, 2))
        slope = gain.masked_fill_(gain > bound, 0.0)  # of the objective by log pi: rho A, or 0 where it is clipped

        # By the logits: log_softmax's backward takes away what is the same for all actions, as the 1 in (log p + 1) p.
        surprise = learned * prob[:, :num_learned]
        loss = (surprise.sum((1, 2, 3)) * weights.entropy_coef - objective) * share
        grad = torch.zeros_like(log_prob)
        torch.mul(surprise, weights.entropy_coef * share, out=grad[:, :num_learned])
        grad[:, :num_learned].scatter_add_(2, taken, slope.mul_(-share).unsqueeze(2))
        if weights.policy_gap and maps:
            loss += _add_divergence(grad, log_prob, prob, weights)
        ctx.save_for_backward(grad, log_prob)
        ctx.maps = maps
        return loss

    @staticmethod
    def backward(ctx, upstream):  # type: ignore[no-untyped-def]
        grad, log_prob = ctx.saved_tensors
        by_logits = torch._log_softmax_backward_data(grad, log_prob, 2, grad.dtype)
        parts = by_logits.mul_(upstream.view(-1, 1, 1, 1)).unbind(1)
        back = torch.stack(_reordered(list(parts), [m.source for m in ctx.maps]), 2)
        return back.flatten(2).transpose(1, 2), None, None, None, None, None


def _add_divergence(grad: Tensor, log_prob: Tensor, prob: Tensor, weights: Weights) -> Tensor:
    """Add the gradient of c KL[copy || original] to `grad`, and return c KL, averaged over copies and rows: [S]."""
    weight = weights.policy_gap / ((log_prob.shape[1] - 1) * log_prob.shape[3])
    moved = prob[:, 1:]
    divergence = (log_prob[:, 1:] - log_prob[:, :1]).mul_(moved)
    if weights.stop_gradient != "transformed":
        grad[:, 1:].add_(divergence, alpha=weight)
    if weights.stop_gradient != "original":
        grad[:, :1].sub_(moved.sum(1, keepdim=True), alpha=weight)
    return divergence.sum((1, 2, 3)) * weight


class _CriticLoss(Function):
    @staticmethod
    def forward(ctx, values, target, weights):  # type: ignore[no-untyped-def]
        num_learned = values.shape[1] if weights.augments else 1
        share = weights.value_coef / (num_learned * values.shape[2])
        error = values[:, :num_learned] - target.unsqueeze(1)
        inner = error.clamp(-weights.huber_delta, weights.huber_delta)
        loss = error.sub_(inner, alpha=0.5).mul_(inner).sum((1, 2)) * share
        grad = torch.zeros_like(values)
        torch.mul(inner, share, out=grad[:, :num_learned])
        if weights.value_gap and values.shape[1] > 1:
            weight = weights.value_gap / ((values.shape[1] - 1) * values.shape[2])
            gap = values[:, 1:] - values[:, :1]
            loss += gap.square().sum((1, 2)) * weight
            if weights.stop_gradient != "transformed":
                grad[:, 1:].add_(gap, alpha=2 * weight)
            if weights.stop_gradient != "original":
                grad[:, :1].sub_(gap.sum(1, keepdim=True), alpha=2 * weight)
        ctx.save_for_backward(grad)
        return loss

    @staticmethod
    def backward(ctx, upstream):  # type: ignore[no-untyped-def]
        (grad,) = ctx.saved_tensors
        return grad * upstream.view(-1, 1, 1), None, None
