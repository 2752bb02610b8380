"""Perceptrons compiled for the processor at hand: what `perceptron.Pass` does, in one call each way."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from itertools import accumulate, pairwise

import torch
from torch import Tensor

from esp_cli.kernels.library import PADDING, fields, library, padded


class _Perceptron(ctypes.Structure):
    _fields_ = (
        *fields(ctypes.c_int64, "seeds", "rows", "layers", "tanh", "activate_output", "threads", "stride"),
        *fields(ctypes.c_void_p, "widths", "parameters", "strides", "inputs", "hidden"),
    )


class _Outputs(ctypes.Structure):
    _fields_ = (("at", ctypes.c_void_p), *fields(ctypes.c_int64, "seed", "row", "column"))

    @classmethod
    def of(cls, x: Tensor) -> _Outputs:
        return cls(x.data_ptr(), *x.stride())


def _with_whole_rows(x: Tensor) -> Tensor:
    """Return x [S, ., .] with each seed's numbers in a row; views of a learner's buffer are so already."""
    return x if x.stride(2) == 1 and x.stride(1) == x.shape[2] else x.contiguous()


class CompiledPass:
    """A pass through a perceptron that keeps its activations until its `backward`; see `perceptron.Pass`.

    Args:
        inputs: [S, B, ...] parts of x, side by side, on the CPU.
        parameters: W_1, b_1, ..., W_n, b_n.
        activation: "relu" or "tanh".
        activate_output: whether it ends with an activation.
        rows_innermost: whether the outputs [S, B, out] lie in memory as [S, out, B]; those of thin outputs always do.
        keep: whether there will be a backward.

    Attributes:
        outputs: y.
    """

    @torch.no_grad()
    def __init__(
        self,
        inputs: Sequence[Tensor],
        parameters: Sequence[Tensor],
        activation: str,
        activate_output: bool,
        rows_innermost: bool = False,
        keep: bool = True,
    ) -> None:
        x = _with_whole_rows(inputs[0] if len(inputs) == 1 else torch.cat([*inputs], -1))
        self._read = list(pairwise(accumulate((part.shape[-1] for part in inputs), initial=0)))
        widths = [x.shape[2], *(bias.shape[2] for bias in parameters[1::2])]
        self._shapes = [p.shape[1:] for p in parameters]
        self._count = sum((a + 1) * b for a, b in pairwise(widths))
        activated = widths[1:] if activate_output else widths[1:-1]
        room = sum(map(padded, activated)) if keep else 0
        given, hidden = [_with_whole_rows(p.detach()) for p in parameters], x.new_empty(x.shape[0] * x.shape[1] * room)
        tables = (
            (ctypes.c_int64 * len(widths))(*widths),
            (ctypes.c_void_p * len(given))(*(p.data_ptr() for p in given)),
            (ctypes.c_int64 * len(given))(*(p.stride(0) for p in given)),
        )
        self._arguments = _Perceptron(
            x.shape[0],
            x.shape[1],
            len(widths) - 1,
            activation == "tanh",
            activate_output,
            torch.get_num_threads(),
            x.stride(0),
            *(ctypes.addressof(table) for table in tables),
            x.data_ptr(),
            hidden.data_ptr() if keep else None,
        )
        self._alive = (x, given, hidden, tables)
        size = (x.shape[0], x.shape[1], widths[-1])
        columns_first = rows_innermost or widths[-1] < PADDING
        self.outputs = x.new_empty(size[0], size[2], size[1]).transpose(1, 2) if columns_first else x.new_empty(size)
        library("perceptron").forward(ctypes.byref(self._arguments), ctypes.byref(_Outputs.of(self.outputs)))

    def backward(self, grad: Tensor) -> list[Tensor]:
        """Return the gradients by all parameters, side by side [S, P], of what has this gradient by the outputs."""
        found = self._room()
        self._pull(grad, found, None)
        return [found]

    def backward_to(
        self, grad: Tensor, learns: Sequence[bool], asked: Sequence[bool]
    ) -> tuple[list[Tensor | None], list[Tensor | None]]:
        """Return the gradients by the parameters that learn and by the inputs that ask; None for the others."""
        x = self._alive[0]
        found, below = self._room() if any(learns) else None, x.new_empty(x.shape) if any(asked) else None
        self._pull(grad, found, below)
        ends = pairwise(accumulate(map(torch.Size.numel, self._shapes), initial=0))
        grads = [
            None if found is None or not wanted else found[:, begin:end].unflatten(1, size)
            for wanted, (begin, end), size in zip(learns, ends, self._shapes, strict=True)
        ]
        columns = zip(asked, self._read, strict=False)
        return grads, [None if below is None or not wanted else below[..., a:b] for wanted, (a, b) in columns]

    def _room(self) -> Tensor:
        """Return an empty buffer [S, P] for the gradients by all parameters."""
        x = self._alive[0]
        return x.new_empty(x.shape[0], self._count)

    def _pull(self, grad: Tensor, found: Tensor | None, below: Tensor | None) -> None:
        """Write the gradients by all parameters [S, P] and by the inputs [S, B, in], where there is room for them."""
        library("perceptron").backward(
            ctypes.byref(self._arguments),
            ctypes.byref(_Outputs.of(grad)),
            None if found is None else found.data_ptr(),
            None if below is None else below.data_ptr(),
        )
