"""QMIX's mixer with its hypernetwork, compiled; see `networks.joint_q`."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from math import prod

import torch
from torch import Tensor

from esp_cli.networks.kernels.library import call, fields
from esp_cli.networks.kernels.perceptron import Below, CompiledPass
from esp_envs.errors import UserError


class _Mixer(ctypes.Structure):
    _fields_ = (*fields(ctypes.c_int64, "agents", "width"), ("own", ctypes.c_void_p))


class CompiledMixer(CompiledPass):
    """A pass through hypernetwork and mixer to the team's values [S, B]; see `CompiledPass`.

    The first input is `own` [S, B, N], the agents' values, contiguous. The hypernetwork has two layers or more, whose
    outputs are W_1 [N M], b_1 [M], w_2 [M] and b_2 for a mixer of M = `width` hidden units.
    """

    def __init__(self, width: int, inputs: Sequence[Tensor], parameters: Sequence[Tensor], keep: bool) -> None:
        own, *inputs = inputs
        if own.shape[:2] != (inputs[0].shape[0], prod(inputs[0].shape[1:-1])):
            raise UserError(f"a mixer got values {list(own.shape)} for states {list(inputs[0].shape)}")
        self._own, self._by_own = own.detach(), torch.empty_like(own)
        self._mixer = _Mixer(own.shape[2], width, own.data_ptr())
        super().__init__(inputs, parameters, "relu", False, keep=keep)

    def backward_to(
        self, grad: Tensor, learns: Sequence[bool], asked: Sequence[bool]
    ) -> tuple[list[Tensor | None], list[Tensor | None]]:
        grads, below = super().backward_to(grad.contiguous(), learns, asked[1:])
        return grads, [self._by_own, *below]

    def _pull(self, grad: Tensor, found: Tensor | None, below: Below) -> None:
        call("mixer", "mix_backward", self._arguments, self._mixer, grad, found, below, self._by_own)

    def _passed(self, like: Tensor, columns_first: bool) -> Tensor:
        total = like.new_empty(self._size)
        call("mixer", "mix_forward", self._arguments, self._mixer, total)
        return total
