"""The gradient of MAPPO's losses by the logits, compiled; see `closed_form.policy_gradient` of the algorithms."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from esp_cli.kernels.library import fields, library


class _Policy(ctypes.Structure):
    _fields_ = (
        *fields(ctypes.c_int64, "seeds", "rows", "parts", "actions", "threads"),
        *fields(ctypes.c_int64, "augments", "moves_originals", "moves_copies"),
        *fields(ctypes.c_float, "clip_epsilon", "entropy_coef", "gap"),
        *fields(ctypes.c_void_p, "logits", "orders", "action", "old_log_prob", "advantage", "gradient"),
    )


def policy_gradient(
    logits: Tensor,
    orders: Tensor,
    action: Tensor,
    old_log_prob: Tensor,
    advantage: Tensor,
    *,
    clip_epsilon: float,
    entropy_coef: float,
    gap: float,
    augments: bool,
    stop_gradient: str,
) -> Tensor:
    """Return the gradient by the logits, of their shape.

    Args:
        logits: [S, A, P, R] of P parts: the originals and their copies.
        orders: [P, S, A] int64, which action of a part is the original's.
        action: [S, R] int64 of the originals.
        old_log_prob: [S, R].
        advantage: [S, R].
        clip_epsilon: of the clipped objective.
        entropy_coef: weight of the entropy.
        gap: weight of the divergence between copies and originals.
        augments: whether copies enter the objective.
        stop_gradient: "transformed", "original" or "none": which side of the divergence is held fixed.
    """
    num_seeds, num_actions, num_parts, num_rows = logits.shape
    data = [x.contiguous() for x in (logits, orders, action, old_log_prob, advantage)]
    gradient = torch.empty_like(data[0])
    arguments = _Policy(
        num_seeds,
        num_rows,
        num_parts,
        num_actions,
        torch.get_num_threads(),
        augments,
        stop_gradient != "original",
        stop_gradient != "transformed",
        clip_epsilon,
        entropy_coef,
        gap,
        *(x.data_ptr() for x in (*data, gradient)),
    )
    library("policy_gradient").policy_gradient(ctypes.byref(arguments))
    return gradient
