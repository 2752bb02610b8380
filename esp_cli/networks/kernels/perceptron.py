"""Perceptrons compiled for the processor at hand: what `networks.perceptron` does, in one call each way."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import lru_cache
from itertools import accumulate, pairwise
from math import prod
from typing import Any, ClassVar, NamedTuple

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


Lies = tuple[torch.Size, tuple[int, ...], torch.dtype]  # shape, strides and type of a tensor


def _lies(x: Tensor) -> Lies:
    return x.shape, x.stride(), x.dtype


@lru_cache
def _counted(shape: torch.Size, steps: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """Return sizes and strides of few axes that count the rows of inputs [S, ..., d]; None where these are too few."""
    if not shape.numel():  # no rows, or rows of no numbers: a part of a set's inputs that is empty
        return (1, 1, max(1, prod(shape[1:-1]))), (0, 0, 0)
    sizes, strides = [1] * _AXES, [0] * _AXES
    for size, stride in zip(shape[1:-1], steps[1:-1], strict=True):
        if sizes[-1] == 1 or strides[-1] == size * stride:
            sizes[-1], strides[-1] = sizes[-1] * size, stride
        elif size > 1:
            sizes, strides = [*sizes, size], [*strides, stride]
    while len(sizes) > _AXES and sizes[0] == 1:
        del sizes[0], strides[0]
    return (tuple(sizes), tuple(strides)) if len(sizes) == _AXES else None


class _Plan:
    """What does not change from pass to pass of a network whose inputs and parameters lie alike; see `_Perceptron`."""

    def __init__(
        self, inputs: Sequence[Lies], parameters: Sequence[tuple[int, Lies]], activate_output: bool, **others: int
    ) -> None:
        lies = [where for _, where in parameters]
        self.inputs, self.shapes = [shape[-1] for shape, *_ in inputs], [shape[1:] for shape, *_ in lies]
        self.widths = (sum(self.inputs), *(size[1] for size in self.shapes[1::2]))
        self.size = (lies[0][0][0], prod(inputs[0][0][1:-1]))
        if self.widths[0] != self.shapes[0][0] or any(
            (x[0], prod(x[1:-1])) != self.size or kind != torch.float32 for x, _, kind in inputs
        ):
            shapes = ", ".join(f"{kind} {list(shape)}" for shape, _, kind in inputs)
            raise UserError(f"a perceptron for float32 rows [{self.size[0]}, ..., {self.shapes[0][0]}] got {shapes}")
        self.count = sum(map(torch.Size.numel, self.shapes))
        activated = self.widths[1:] if activate_output else self.widths[1:-1]
        self.room = prod(self.size) * sum(map(padded, activated))
        columns = [_Columns(None, x[-1], steps[0], steps[-1], *(_counted(x, steps) or ())) for x, steps, _ in inputs]
        self.columns = (_Columns * len(columns))(*columns)
        self._tables = (
            (ctypes.c_int64 * len(self.widths))(*self.widths),
            (ctypes.c_void_p * len(lies))(*(at for at, _ in parameters)),
            (ctypes.c_int64 * len(lies))(*(steps[0] for _, steps, _ in lies)),
        )
        widths, at, strides = (ctypes.addressof(table) for table in self._tables)
        seeds, rows = self.size
        self.arguments = _Perceptron(
            seeds=seeds, rows=rows, layers=len(self.widths) - 1, activate_output=activate_output, parts=len(columns),
            widths=widths, parameters=at, strides=strides, **others,
        )  # fmt: skip


_plan = lru_cache(maxsize=256)(_Plan)


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
        inputs = [x if _counted(x.shape, x.stride()) else x.detach().contiguous() for x in inputs]
        given = [_whole_rows(p) for p in parameters]
        self._plan = plan = _plan(
            tuple(map(_lies, inputs)),
            tuple((p.data_ptr(), _lies(p)) for p in given),
            activate_output,
            tanh=activation == "tanh",
            threads=torch.get_num_threads(),
            things=things,
        )
        self._size = plan.size
        hidden = given[0].new_empty(plan.room) if keep and not self.computes_again else None
        columns = type(plan.columns).from_buffer_copy(plan.columns)
        for part, x in zip(columns, inputs, strict=True):
            part.at = x.data_ptr()
        self._arguments = _Perceptron.from_buffer_copy(plan.arguments)
        self._arguments.inputs = ctypes.addressof(columns)
        self._arguments.hidden = None if hidden is None else hidden.data_ptr()
        self._alive = (inputs, given, hidden, columns)
        self.outputs = self._passed(given[0], rows_innermost or plan.widths[-1] < PADDING)

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
        ends = pairwise(accumulate(self._plan.inputs, initial=0))
        columns = [at if wanted else None for wanted, at in zip(asked, ends, strict=False)]
        wanted = [at for at in columns if at]
        first, end = (wanted[0][0], wanted[-1][1]) if wanted else (0, 0)
        below = grad.new_empty(*self._size, end - first)
        self._pull(grad, found, Below(below.data_ptr() if wanted else None, first, end))
        return self._split(found, learns), [at and below[..., at[0] - first : at[1] - first] for at in columns]

    def _passed(self, like: Tensor, columns_first: bool) -> Any:
        """Go through all layers and return what the last one gives."""
        (num_seeds, num_rows), width = self._size, self._plan.widths[-1]
        size = (num_seeds, width, num_rows) if columns_first else (num_seeds, num_rows, width)
        outputs = like.new_empty(size)
        outputs = outputs.transpose(1, 2) if columns_first else outputs
        call("perceptron", "forward", self._arguments, RowsAt.of(outputs))
        return outputs

    def _pull(self, grad: Tensor, found: Tensor | None, below: Below) -> None:
        """Write the gradients by all parameters [S, P] and by some columns of the inputs, where there is room."""
        call("perceptron", "backward", self._arguments, RowsAt.of(grad), found, below)

    def _room(self, like: Tensor) -> Tensor:
        return like.new_empty(self._size[0], self._plan.count)

    def _split(self, found: Tensor | None, learns: Sequence[bool]) -> list[Tensor | None]:
        """Return the part of a buffer [S, P] that belongs to each parameter, where it learns."""
        shapes = self._plan.shapes
        parts = [None] * len(shapes) if found is None else found.split([size.numel() for size in shapes], 1)
        return [
            None if part is None or not wanted else part.unflatten(1, size)
            for wanted, part, size in zip(learns, parts, shapes, strict=True)
        ]


class LearningPass(CompiledPass):
    """A pass whose outputs a kernel turns into the slope of a loss at once, block by block; they are kept nowhere.

    The parts of a row of [S, R, parts, in] stay together; the perceptron ends without an activation.
    """

    computes_again = True

    def __init__(self, rows: Tensor, parameters: Sequence[Tensor], activation: str) -> None:
        self.num_rows = rows.shape[1]
        super().__init__([rows], parameters, activation, False, keep=False, things=rows.shape[2])

    def _passed(self, like: Tensor, columns_first: bool) -> Tensor:
        return like

    def learn(self, kernel: str, function: str, *of_loss: ctypes.Structure) -> Tensor:
        """Return the gradients [S, P] by all parameters of a loss that a kernel knows."""
        found = self._room(self.outputs)
        call(kernel, function, self._arguments, *of_loss, found)
        return found


class _Regression(ctypes.Structure):
    _fields_ = (
        *fields(ctypes.c_int64, "learned"),
        *fields(ctypes.c_float, "delta", "weight", "gap_weight"),
        ("target", ctypes.c_void_p),
    )


class Regression(NamedTuple):
    """Huber losses of values of the first parts of rows, and squared gaps between each copy and the original.

    `algorithms.objectives.value_loss` is the same in torch.
    """

    target: Tensor  # [S, 1, R]
    learned: int  # L
    delta: float
    weight: float
    gap_weight: float = 0.0

    def learn(self, run: LearningPass) -> Tensor:
        """Return the gradients [S, P] by the parameters of a perceptron whose only output are the values."""
        target, numbers = self.target.contiguous(), (self.delta, self.weight, self.gap_weight)
        return run.learn("perceptron", "learn_values", _Regression(self.learned, *numbers, target.data_ptr()))
