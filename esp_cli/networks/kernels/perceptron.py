"""Perceptrons compiled for the processor at hand: what `networks.perceptron` does, in one call each way."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import lru_cache
from itertools import accumulate, pairwise
from math import prod
from typing import Any, ClassVar

import torch
from torch import Tensor

from esp_cli.networks.kernels.library import PADDING, call, fields, padded
from esp_envs.errors import UserError

_AXES = 3  # AXES of perceptron.h


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
        *fields(ctypes.c_int64, "seeds", "rows", "layers", "tanh", "activate_output", "threads", "parts", "things"),
        *fields(ctypes.c_void_p, "widths", "parameters", "strides", "inputs", "hidden"),
    )


class RowsAt(ctypes.Structure):
    """Where a matrix [S, R, .] lies."""

    _fields_ = (("at", ctypes.c_void_p), *fields(ctypes.c_int64, "seed", "row", "column"))

    @classmethod
    def of(cls, x: Tensor) -> RowsAt:
        return cls(x.data_ptr(), *x.stride())


class Below(ctypes.Structure):
    """Where the gradient by some columns of the inputs goes."""

    _fields_ = (("at", ctypes.c_void_p), *fields(ctypes.c_int64, "begin", "end"))


def _whole_rows(x: Tensor) -> Tensor:
    """Return x [S, ., .] with each seed's numbers in a row; views of a learner's buffer are so already."""
    _, row, column = x.stride()
    return x if column == 1 and row == x.shape[2] else x.detach().contiguous()


def _counted(x: Tensor) -> tuple[Tensor, tuple[int, ...], tuple[int, ...]]:
    """Return x [S, ..., d], copied where need be, and sizes and strides of few axes that count its rows."""
    sizes, strides = [1] * _AXES, [0] * _AXES
    for size, stride in zip(x.shape[1:-1], x.stride()[1:-1], strict=True):
        if sizes[-1] == 1 or strides[-1] == size * stride:
            sizes[-1], strides[-1] = sizes[-1] * size, stride
        elif size > 1:
            sizes, strides = [*sizes, size], [*strides, stride]
    while len(sizes) > _AXES and sizes[0] == 1:
        del sizes[0], strides[0]
    if len(sizes) > _AXES:
        return _counted(x.contiguous()) if x.numel() else (x, (1, 1, 0), (0, 0, 0))
    return x, tuple(sizes), tuple(strides)


@lru_cache
def _tables(
    widths: tuple[int, ...], addresses: tuple[int, ...], strides: tuple[int, ...]
) -> tuple[ctypes.Array[Any], ...]:
    """Return what does not change from pass to pass of a network, as the kernel reads it."""
    return (
        (ctypes.c_int64 * len(widths))(*widths),
        (ctypes.c_void_p * len(addresses))(*addresses),
        (ctypes.c_int64 * len(strides))(*strides),
    )


class CompiledPass:
    """A pass through a perceptron to its outputs [S, B, out] that keeps its activations until its `backward`.

    Arguments as of `networks.perceptron.perceptron` and `Shape`. The inputs may lie anyhow in memory, and are read
    again by the backward. Rows are a multiple of `things`, which stay together.
    """

    computes_again: ClassVar[bool] = False  # whether `backward` computes the activations again instead

    def __init__(
        self,
        inputs: Sequence[Tensor],
        parameters: Sequence[Tensor],
        activation: str,
        activate_output: bool,
        rows_innermost: bool = False,
        keep: bool = True,
        things: int = 1,
    ) -> None:
        parts = [_counted(x.detach()) for x in inputs]
        given = [_whole_rows(p) for p in parameters]
        self._inputs = [x.shape[-1] for x in inputs]
        self._shapes = [p.shape[1:] for p in parameters]
        self._widths = (sum(self._inputs), *(size[1] for size in self._shapes[1::2]))
        self._size = (parameters[0].shape[0], prod(inputs[0].shape[1:-1]))
        if self._widths[0] != self._shapes[0][0] or any(
            (x.shape[0], prod(x.shape[1:-1])) != self._size or x.dtype != torch.float32 for x in inputs
        ):
            shapes = ", ".join(f"{x.dtype} {list(x.shape)}" for x in inputs)
            raise UserError(f"a perceptron for float32 rows [{self._size[0]}, ..., {self._shapes[0][0]}] got {shapes}")
        activated = self._widths[1:] if activate_output else self._widths[1:-1]
        room = prod(self._size) * sum(map(padded, activated))
        hidden = given[0].new_empty(room) if keep and not self.computes_again else None
        columns = (_Columns * len(parts))(*(_Columns.of(*part) for part in parts))
        tables = _tables(self._widths, tuple(p.data_ptr() for p in given), tuple(p.stride(0) for p in given))
        self._arguments = _Perceptron(
            *self._size,
            len(self._widths) - 1,
            activation == "tanh",
            activate_output,
            torch.get_num_threads(),
            len(parts),
            things,
            *map(ctypes.addressof, (*tables, columns)),
            None if hidden is None else hidden.data_ptr(),
        )
        self._alive = (parts, [p.detach() for p in given] if keep else given, hidden, tables, columns)
        self.outputs = self._passed(given[0], rows_innermost or self._widths[-1] < PADDING)

    def backward(self, grad: Tensor) -> list[Tensor]:
        """Return the gradients by all parameters, side by side [S, P], of what has this gradient by the outputs."""
        found = self._room(grad)
        self._pull(grad, found, Below())
        return [found]

    def backward_to(
        self, grad: Tensor, learns: Sequence[bool], asked: Sequence[bool]
    ) -> tuple[list[Tensor | None], list[Tensor | None]]:
        """Return the gradients by the parameters that learn and by the inputs that ask; None for the others."""
        found = self._room(grad) if any(learns) else None
        ends = pairwise(accumulate(self._inputs, initial=0))
        columns = [at if wanted else None for wanted, at in zip(asked, ends, strict=False)]
        wanted = [at for at in columns if at]
        first, end = (wanted[0][0], wanted[-1][1]) if wanted else (0, 0)
        below = grad.new_empty(*self._size, end - first)
        self._pull(grad, found, Below(below.data_ptr() if wanted else None, first, end))
        return self._split(found, learns), [at and below[..., at[0] - first : at[1] - first] for at in columns]

    def _passed(self, like: Tensor, columns_first: bool) -> Tensor:
        """Go through all layers and return what the last one gives."""
        (num_seeds, num_rows), width = self._size, self._widths[-1]
        size = (num_seeds, width, num_rows) if columns_first else (num_seeds, num_rows, width)
        outputs = like.new_empty(size)
        outputs = outputs.transpose(1, 2) if columns_first else outputs
        call("perceptron", "forward", self._arguments, RowsAt.of(outputs))
        return outputs

    def _pull(self, grad: Tensor, found: Tensor | None, below: Below) -> None:
        """Write the gradients by all parameters [S, P] and by some columns of the inputs, where there is room."""
        call("perceptron", "backward", self._arguments, RowsAt.of(grad), found, below)

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
