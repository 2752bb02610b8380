"""The gradient of MADDPG's actor by the logits, for discrete actions: a third of autograd's operations.

`Maddpg.reference_gradient` says in the terms of the paper what this is the gradient of; tests hold both together.

Shape letters: S seeds, A actions, N agents, P parts (the originals and K copies of them), of which the first L are
learned from, R rows of a part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from esp_cli.algorithms.closed_form import gathers, reordered
from esp_cli.networks.kernels import actor
from esp_cli.networks.kernels.library import computes
from esp_cli.symmetry import Transform


@dataclass(frozen=True)
class ActorWeights:
    """What the actor's loss is made of beside the critic's values.

    Attributes:
        output_penalty: weight of the mean square of the centred logits.
        gap: c of Eq. 10 where S_pi is on, else 0.
        stop_gradient: which side of S_pi is held fixed; see `PriorConfig`.
    """

    output_penalty: float
    gap: float
    stop_gradient: str


@dataclass(frozen=True)
class Draw:
    """Actions drawn from a policy, through which gradients flow (straight-through Gumbel-softmax).

    Attributes:
        soft: [S, A, N, L, R] softmax(logits + Gumbel), whose gradient is taken.
        hard: [S, L R, N, A] the one-hot of its largest number: what the critic is asked about. Equal ones share it.
    """

    soft: Tensor
    hard: Tensor


@torch.no_grad()
def draw(logits: Tensor, num_learned: int, noise: Tensor, compiled: bool = False) -> Draw:
    """Draw actions from the first parts of logits, which are learned from.

    Args:
        logits: [S, A, N, P, B T].
        num_learned: L.
        noise: [S, B, T, N, A] uniform in [0, 1), the same for all parts.
        compiled: whether the kernel draws them, on the CPU.
    """
    if computes(compiled, logits):
        return Draw(*actor.draw(logits, num_learned, noise))
    logits = logits[:, :, :, :num_learned]
    gumbel = noise.clamp(1e-7, 1 - 1e-7).log_().neg_().log_().neg_().permute(0, 4, 3, 1, 2).flatten(3).contiguous()
    soft = torch.softmax(logits + gumbel.unsqueeze(3), 1)
    largest = (soft - soft.amax(1, keepdim=True)).sign_().add_(1)
    largest.div_(largest.sum(1, keepdim=True))
    hard = largest.transpose(1, 2).contiguous()  # [S, N, A, L, R]
    return Draw(soft, hard.flatten(3).permute(0, 3, 1, 2))


@torch.no_grad()
def actor_gradient(
    logits: Tensor,
    drawn: Draw,
    by_action: Tensor,
    share: Tensor,
    transforms: Sequence[Transform],
    weights: ActorWeights,
    compiled: bool = False,
) -> tuple[Tensor, Tensor]:
    """Return the gradient, by the logits, of -Q + penalty + c S_pi: as `logits`; and mean entropies [S, R].

    Args:
        logits: [S, A, N, P, R] of all parts, not pulled back.
        drawn: from the parts that are learned from: all, or the originals.
        by_action: [S, L R, N, A] gradient of the loss by what was drawn.
        share: [S, R] of each row in the mean over the originals; 0 where it does not count.
        transforms: K, with which the copies were made.
        weights: of the other terms.
        compiled: whether the kernel computes it, on the CPU.
    """
    if computes(compiled, logits):
        return actor.actor_gradient(
            logits,
            drawn.soft,
            by_action,
            share,
            [m.back for m in gathers(transforms)],
            output_penalty=weights.output_penalty,
            gap=weights.gap if transforms else 0.0,
            stop_gradient=weights.stop_gradient,
        )
    num_actions, num_agents, parts = logits.shape[1], logits.shape[2], drawn.soft.shape[3]
    learned, row = logits[:, :, :, :parts], share[:, None, None, None] / num_agents
    by_action = by_action.permute(0, 3, 2, 1).unflatten(3, (parts, -1)).contiguous()
    gradient = torch._softmax_backward_data(by_action, drawn.soft, 1, logits.dtype)
    centred = learned - learned.mean(1, keepdim=True)
    gradient.addcmul_(centred, row, value=2 * weights.output_penalty / (num_actions * parts))
    if parts < logits.shape[3]:
        gradient = torch.cat([gradient, torch.zeros_like(logits[:, :, :, parts:])], 3)
    if weights.gap and transforms:
        gradient.add_(_divergence_gradient(logits, row * (weights.gap / len(transforms)), transforms, weights))
    return gradient, _entropy(learned).mean((1, 2))


def _divergence_gradient(
    logits: Tensor, weight: Tensor, transforms: Sequence[Transform], weights: ActorWeights
) -> Tensor:
    """Return the gradient of KL[copy || original], weighted by rows [S, 1, 1, 1, R] and summed: as `logits`."""
    maps = gathers(transforms)
    log_prob = torch.log_softmax(reordered(logits, [m.back for m in maps]), 1)
    prob = log_prob.exp()
    here, moved, copy = log_prob[:, :, :, :1], log_prob[:, :, :, 1:], prob[:, :, :, 1:]
    gradient = torch.zeros_like(log_prob)
    if weights.stop_gradient != "transformed":
        gap = moved - here
        inner = copy * gap
        gradient[:, :, :, 1:] = inner.sub_(copy * inner.sum(1, keepdim=True)).mul_(weight)
    if weights.stop_gradient != "original":
        gradient[:, :, :, :1] = (prob[:, :, :, :1] - copy).mul_(weight).sum(3, keepdim=True)
    return reordered(gradient, [m.source for m in maps])


def _entropy(logits: Tensor) -> Tensor:
    """Return that of the policies with logits [S, A, N, P, R]: [S, N, P, R]."""
    log_prob = torch.log_softmax(logits, 1)
    return (log_prob.exp() * log_prob).sum(1).neg_()
