"""Draws and the gradient of MADDPG's actor, compiled; see `closed_actor` of the algorithms."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from esp_cli.networks.kernels.library import call, fields
from esp_cli.networks.kernels.policies import Policies, orders_of
from esp_envs.errors import UserError


class _Actor(ctypes.Structure):
    _fields_ = (
        *fields(ctypes.c_int64, "learned", "moves_originals", "moves_copies"),
        *fields(ctypes.c_float, "output_penalty", "gap"),
        *fields(ctypes.c_void_p, "soft", "share"),
    )


def draw(logits: Tensor, num_learned: int, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Draw actions, the same noise for all parts.

    Args:
        logits: [S, A, N, P, R].
        num_learned: L, the first parts, of which actions are drawn.
        noise: [S, ..., N, A] of R rows, uniform in [0, 1).

    Returns:
        softmax(logits + Gumbel) [S, A, N, L, R], and the one-hot of its largest number [S, L R, N, A].

    Raises:
        UserError: there are fewer parts.
    """
    num_seeds, num_actions, num_agents, num_parts, num_rows = logits.shape
    if num_learned > num_parts:
        raise UserError(f"{num_learned} parts of {num_parts} cannot be learned from")
    logits, noise = logits.contiguous(), noise.contiguous()
    soft = torch.empty_like(logits)
    hard = logits.new_empty(num_seeds, num_learned * num_rows, num_agents, num_actions)
    orders, actor = orders_of(logits, []), _Actor(learned=num_learned, soft=soft.data_ptr())
    call("actor", "draw", Policies.of(logits, orders), actor, noise, hard)
    return soft[:, :, :, :num_learned], hard


def actor_gradient(
    logits: Tensor,
    soft: Tensor,
    by_action: Tensor,
    share: Tensor,
    back: Sequence[Tensor],
    *,
    output_penalty: float,
    gap: float,
    stop_gradient: str,
) -> tuple[Tensor, Tensor]:
    """Return the gradient by the logits, of their shape, and the entropies' mean over agents and learned parts [S, R].

    Args:
        logits: [S, A, N, P, R].
        soft: of `draw`, of the first L parts.
        by_action: [S, L R, N, A] gradient by what was drawn.
        share: [S, R] of each row in the mean.
        back: of each copy, [S or 1, A]: which action of it is the original's.
        output_penalty: weight of the mean square of the centred logits.
        gap: weight of the divergence between copies and originals; 0 where there are no copies.
        stop_gradient: "transformed", "original" or "none": which side of the divergence is held fixed.
    """
    orders = orders_of(logits, back)
    logits, by_action, share = logits.contiguous(), by_action.contiguous(), share.contiguous()
    gradient, entropy = torch.empty_like(logits), torch.empty_like(share)
    actor = _Actor(
        soft.shape[3],
        stop_gradient != "original",
        stop_gradient != "transformed",
        output_penalty,
        gap,
        soft.data_ptr(),
        share.data_ptr(),
    )
    call("actor", "actor_gradient", Policies.of(logits, orders), actor, by_action, gradient, entropy)
    return gradient, entropy
