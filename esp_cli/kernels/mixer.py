"""QMIX's mixer, compiled; see `networks.mixer`."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from esp_cli.kernels.library import fields, library


class _Mixer(ctypes.Structure):
    _fields_ = (
        *fields(ctypes.c_int64, "seeds", "rows", "agents", "width", "threads"),
        *fields(ctypes.c_void_p, "own", "weights"),
    )

    @classmethod
    def of(cls, own: Tensor, weights: Tensor, width: int) -> _Mixer:
        return cls(*own.shape, width, torch.get_num_threads(), own.data_ptr(), weights.data_ptr())


def mix(own: Tensor, weights: Tensor, width: int) -> Tensor:
    """Return the team's values [S, B].

    Args:
        own: [S, B, N] contiguous values of the agents.
        weights: [S, B, N M + M + M + 1] contiguous W_1, b_1, w_2 and b_2 in every state.
        width: M, hidden units.
    """
    total = own.new_empty(own.shape[:2])
    library("mixer").mix_forward(ctypes.byref(_Mixer.of(own, weights, width)), total.data_ptr())
    return total


def mix_backward(own: Tensor, weights: Tensor, width: int, grad: Tensor) -> tuple[Tensor, Tensor]:
    """Return the gradients by the agents' values and by the weights of what has this gradient by the team's values."""
    by_own, by_weights, grad = torch.empty_like(own), torch.empty_like(weights), grad.contiguous()
    pointers = (grad.data_ptr(), by_own.data_ptr(), by_weights.data_ptr())
    library("mixer").mix_backward(ctypes.byref(_Mixer.of(own, weights, width)), *pointers)
    return by_own, by_weights
