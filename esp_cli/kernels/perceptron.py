"""Perceptrons compiled for the processor at hand: what `perceptron.Pass` does, in one call each way."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from itertools import accumulate, pairwise
from math import prod

import torch
from torch import Tensor

from esp_cli.kernels.library import PADDING, call, fields, padded

_AXES = 3
"""AXES of perceptron.h."""


class _Columns(ctypes.Structure):
    _fields_ = (
        ("at", ctypes.c_void_p),
        *fields(ctypes.c_int64, "width", "seed", "column"),
        *fields(ctypes.c_int64 * _AXES, "sizes", "strides"),
    )

    @classmethod
    def of(cls, x: Tensor, sizes: Sequence[int], strides: Sequence[int]) -> _Columns:
        return cls(x.data_ptr(), x.shape[-1], x.stride(0), x.stride(-1), tuple(sizes), tuple(strides))


class _Perceptron(ctypes.Structure):
    _fields_ = (
        *fields(ctypes.c_int64, "seeds", "rows", "layers", "tanh", "activate_output", "threads", "parts"),
        *fields(ctypes.c_void_p, "widths", "parameters", "strides", "inputs", "hidden"),
    )


class _Rows(ctypes.Structure):
    _fields_ = (("at", ctypes.c_void_p), *fields(ctypes.c_int64, "seed", "row", "column"))

    @classmethod
    def of(cls, x: Tensor) -> _Rows:
        return cls(x.data_ptr(), *x.stride())


class _Below(ctypes.Structure):
    _fields_ = (("at", ctypes.c_void_p), *fields(ctypes.c_int64, "begin", "end"))


def _with_whole_rows(x: Tensor) -> Tensor:
    """Return x [S, ., .] with each seed's numbers in a row; views of a learner's buffer are so already."""
    return x if x.stride(2) == 1 and x.stride(1) == x.shape[2] else x.contiguous()


def _counted(x: Tensor) -> tuple[Tensor, list[int], list[int]]:
    """Return x [S, ..., d], copied where need be, and sizes and strides of few axes that count its rows."""
    sizes, strides = [1], [0]
    for size, stride in zip(x.shape[1:-1], x.stride()[1:-1], strict=True):
        if size == 1:
            continue
        if sizes[-1] == 1 or strides[-1] == size * stride:
            sizes[-1] *= size
            strides[-1] = stride
        else:
            sizes.append(size)
            strides.append(stride)
    if len(sizes) > _AXES:
        return _counted(x.contiguous())
    missing = _AXES - len(sizes)
    return x, [1] * missing + sizes, [0] * missing + strides


class CompiledPass:
    """A pass through a perceptron that keeps its activations until its `backward`; see `perceptron.Pass`.

    Args:
        inputs: [S, ..., d] parts of x, side by side, on the CPU; they may lie anyhow in memory.
        parameters: W_1, b_1, ..., W_n, b_n.
        activation: "relu" or "tanh".
        activate_output: whether it ends with an activation.
        rows_innermost: whether the outputs [S, B, out] lie in memory as [S, out, B]; those of thin outputs always do.
        keep: whether there will be a backward.

    Attributes:
        outputs: y [S, B, out].
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
        parts, given = [_counted(x.detach()) for x in inputs], [_with_whole_rows(p.detach()) for p in parameters]
        self._columns = list(pairwise(accumulate((x.shape[-1] for x in inputs), initial=0)))
        self._widths = [self._columns[-1][1], *(bias.shape[2] for bias in parameters[1::2])]
        self._size = (inputs[0].shape[0], prod(inputs[0].shape[1:-1]))
        self._shapes = [p.shape[1:] for p in parameters]
        activated = self._widths[1:] if activate_output else self._widths[1:-1]
        hidden = given[0].new_empty(prod(self._size) * sum(map(padded, activated)) if keep else 0)
        tables = (
            (ctypes.c_int64 * len(self._widths))(*self._widths),
            (ctypes.c_void_p * len(given))(*(p.data_ptr() for p in given)),
            (ctypes.c_int64 * len(given))(*(p.stride(0) for p in given)),
            (_Columns * len(parts))(*(_Columns.of(*part) for part in parts)),
        )
        self._arguments = _Perceptron(
            *self._size,
            len(self._widths) - 1,
            activation == "tanh",
            activate_output,
            torch.get_num_threads(),
            len(parts),
            *(ctypes.addressof(table) for table in tables),
            hidden.data_ptr() if keep else None,
        )
        self._alive = (parts, given, hidden, tables)
        self.outputs = self._passed(hidden, rows_innermost or self._widths[-1] < PADDING)

    def backward(self, grad: Tensor) -> list[Tensor]:
        """Return the gradients by all parameters, side by side [S, P], of what has this gradient by the outputs."""
        found = self._room(grad)
        self._pull(grad, found, _Below())
        return [found]

    def backward_to(
        self, grad: Tensor, learns: Sequence[bool], asked: Sequence[bool]
    ) -> tuple[list[Tensor | None], list[Tensor | None]]:
        """Return the gradients by the parameters that learn and by the inputs that ask; None for the others."""
        found = self._room(grad) if any(learns) else None
        columns = [at if wanted else None for wanted, at in zip(asked, self._columns, strict=False)]
        wanted = [at for at in columns if at]
        first, end = (wanted[0][0], wanted[-1][1]) if wanted else (0, 0)
        below = grad.new_empty(*self._size, end - first)
        self._pull(grad, found, _Below(below.data_ptr() if wanted else None, first, end))
        return self._split(found, learns), [at and below[..., at[0] - first : at[1] - first] for at in columns]

    def _passed(self, like: Tensor, columns_first: bool) -> Tensor:
        """Go through all layers and return what the last one gives."""
        (num_seeds, num_rows), width = self._size, self._widths[-1]
        size = (num_seeds, width, num_rows) if columns_first else (num_seeds, num_rows, width)
        outputs = like.new_empty(size)
        outputs = outputs.transpose(1, 2) if columns_first else outputs
        call("perceptron", "forward", self._arguments, _Rows.of(outputs))
        return outputs

    def _pull(self, grad: Tensor, found: Tensor | None, below: _Below) -> None:
        """Write the gradients by all parameters [S, P] and by some columns of the inputs, where there is room."""
        call("perceptron", "backward", self._arguments, _Rows.of(grad), found, below)

    def _room(self, like: Tensor) -> Tensor:
        """Return an empty buffer [S, P] for the gradients by all parameters."""
        return like.new_empty(self._size[0], sum(map(torch.Size.numel, self._shapes)))

    def _split(self, found: Tensor | None, learns: Sequence[bool]) -> list[Tensor | None]:
        """Return the part of a buffer [S, P] that belongs to each parameter, where it learns."""
        ends = pairwise(accumulate(map(torch.Size.numel, self._shapes), initial=0))
        return [
            None if found is None or not wanted else found[:, begin:end].unflatten(1, size)
            for wanted, (begin, end), size in zip(learns, ends, self._shapes, strict=True)
        ]
