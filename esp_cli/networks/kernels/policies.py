"""Policies over discrete actions, as the kernels read them."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from esp_cli.networks.kernels.library import fields


class Policies(ctypes.Structure):
    """Policies of policies.h."""

    _fields_ = (
        *fields(ctypes.c_int64, "seeds", "agents", "parts", "actions", "rows", "threads"),
        *fields(ctypes.c_void_p, "logits", "orders"),
    )

    @classmethod
    def of(cls, logits: Tensor, orders: Tensor) -> Policies:
        """Return logits [S, A, N, P, R] of P parts, and which action of a part is the original's, [P, S, A]."""
        num_seeds, num_actions, num_agents, num_parts, num_rows = logits.shape
        size = (num_seeds, num_agents, num_parts, num_actions, num_rows, torch.get_num_threads())
        return cls(*size, logits.data_ptr(), orders.data_ptr())


def orders_of(logits: Tensor, back: Sequence[Tensor]) -> Tensor:
    """Return which action of each part of logits [S, A, ..., P, R] is the original's, [P, S, A].

    Args:
        logits: see above.
        back: of each copy, [S or 1, A].
    """
    num_seeds, num_actions = logits.shape[:2]
    stays = torch.arange(num_actions)
    return torch.stack([order.expand(num_seeds, -1) for order in (stays, *back)])
