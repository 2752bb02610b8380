"""The gradient of MAPPO's losses by the logits, compiled; see `closed_form.policy_gradient` of the algorithms."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from esp_cli.networks.kernels.library import call, fields
from esp_cli.networks.kernels.policies import Policies, orders_of


class _Objective(ctypes.Structure):
    _fields_ = (
        *fields(ctypes.c_int64, "augments", "moves_originals", "moves_copies"),
        *fields(ctypes.c_float, "clip_epsilon", "entropy_coef", "gap"),
        *fields(ctypes.c_void_p, "action", "old_log_prob", "advantage", "gradient"),
    )


def policy_gradient(
    logits: Tensor,
    back: Sequence[Tensor],
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
        back: of each copy, [S or 1, A]: which action of it is the original's.
        action: [S, R] int64 of the originals.
        old_log_prob: [S, R].
        advantage: [S, R].
        clip_epsilon: of the clipped objective.
        entropy_coef: weight of the entropy.
        gap: weight of the divergence between copies and originals.
        augments: whether copies enter the objective.
        stop_gradient: "transformed", "original" or "none": which side of the divergence is held fixed.
    """
    orders = orders_of(logits, back)
    data = [x.contiguous() for x in (logits, action, old_log_prob, advantage)]
    gradient = torch.empty_like(data[0])
    objective = _Objective(
        augments,
        stop_gradient != "original",
        stop_gradient != "transformed",
        clip_epsilon,
        entropy_coef,
        gap,
        *(x.data_ptr() for x in (*data[1:], gradient)),
    )
    call("policy_gradient", "policy_gradient", Policies.of(data[0].unsqueeze(2), orders), objective)
    return gradient
