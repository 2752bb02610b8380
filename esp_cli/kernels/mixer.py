"""QMIX's mixer with its hypernetwork, compiled; see `networks.mixer`."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from esp_cli.kernels.library import call, fields
from esp_cli.kernels.perceptron import CompiledPass


class _Mixer(ctypes.Structure):
    _fields_ = (*fields(ctypes.c_int64, "agents", "width"), ("own", ctypes.c_void_p))


class CompiledMixer(CompiledPass):
    """A pass through hypernetwork and mixer that keeps what its `unmix` needs.

    Args:
        own: [S, B, N] contiguous values of the agents.
        inputs: parts of what the hypernetwork sees; see `CompiledPass`.
        parameters: of the hypernetwork, two layers or more, whose outputs are W_1 [N M], b_1 [M], w_2 [M] and b_2.
        width: M, hidden units.
        keep: whether there will be an `unmix`.

    Attributes:
        outputs: the team's values [S, B].
    """

    def __init__(
        self, own: Tensor, inputs: Sequence[Tensor], parameters: Sequence[Tensor], width: int, keep: bool
    ) -> None:
        self._own = own.detach()
        self._mixer = _Mixer(own.shape[2], width, own.data_ptr())
        super().__init__(inputs, parameters, "relu", False, keep=keep)

    def unmix(self, grad: Tensor, learns: Sequence[bool]) -> tuple[Tensor, list[Tensor | None]]:
        """Return the gradients by the agents' values and by the parameters that learn."""
        by_own, found, grad = torch.empty_like(self._own), self._room(grad), grad.contiguous()
        call("mixer", "mix_backward", self._arguments, self._mixer, grad, found, by_own)
        return by_own, self._split(found, learns)

    def _passed(self, like: Tensor, columns_first: bool) -> Tensor:
        total = like.new_empty(self._size)
        call("mixer", "mix_forward", self._arguments, self._mixer, total)
        return total
