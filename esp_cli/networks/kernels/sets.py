"""Kernels of networks over sets; `esp_cli.networks.sets` has the same by torch."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from esp_cli.networks.kernels.library import call
from esp_cli.networks.kernels.perceptron import Below, CompiledPass, RowsAt


def _shape(*sizes: int) -> ctypes.Array[ctypes.c_int64]:
    return (ctypes.c_int64 * len(sizes))(*sizes)


def compiled_distances(places: Sequence[Tensor]) -> list[Tensor]:
    """Return what `sets.distances_among` does, of places [S, B, K, 2] on the CPU."""
    sizes = [place.shape[2] for place in places]
    joined = torch.cat([*places], 2).contiguous()
    found = joined.new_empty(*joined.shape[:3], 1 + len(places))
    shape = _shape(found.shape[0] * found.shape[1], found.shape[2], len(places), torch.get_num_threads())
    call("sets", "distances", shape, _shape(*sizes), joined, found)
    return list(found.split(sizes, 2))


def sort_things(rows: Tensor, columns: Tensor, at: int, reader: int | None) -> None:
    """Sort the things of a set in contiguous rows [B, D] on the CPU, in place, by distance from the column `reader`.

    Each thing's numbers are in `columns` [K, W], and its place begins with the number `at`. None stands for the origin.
    """
    own = -1 if reader is None else reader
    call(
        "sets",
        "sort",
        _shape(*rows.shape, *columns.shape, at, own, torch.get_num_threads()),
        columns.contiguous(),
        rows,
    )


class _PooledPass(CompiledPass):
    """A pass of things [S, B, K, .] whose outputs are mean and maximum over each set, [S, B, 2H].

    To compute what layers give to many things costs less than to keep it; `each` has it [S, B, K, H], where asked for.
    Its owner may fill in the gradient by that, `by_each`, before `backward_to`.
    """

    computes_again = True

    def __init__(
        self, parts: Sequence[Tensor], parameters: Sequence[Tensor], activation: str, keep: bool, each: bool
    ) -> None:
        self._sets, width = parts[0].shape[:3], parameters[-1].shape[-1]
        self.each = parts[0].new_empty(*self._sets, width) if each else None
        self.by_each: Tensor | None = None
        super().__init__(parts, parameters, activation, True, keep=keep, things=self._sets[2])

    def _passed(self, like: Tensor, columns_first: bool) -> Tensor:
        outputs = like.new_empty(*self._sets[:2], 2 * self._plan.widths[-1])
        call("sets", "pool", self._arguments, RowsAt.of(outputs), _rows(self.each))
        return outputs

    def _pull(self, grad: Tensor, found: Tensor | None, below: Below) -> None:
        grad, by_each = grad.contiguous(), None if self.by_each is None else self.by_each.contiguous()
        call("sets", "pool_backward", self._arguments, RowsAt.of(grad), _rows(by_each), found, below)


def _rows(things: Tensor | None) -> RowsAt:
    return RowsAt() if things is None else RowsAt.of(things.flatten(1, 2))


class _Pooled(torch.autograd.Function):
    @staticmethod
    def forward(ctx, activation, each, num_parts, *tensors):  # type: ignore[no-untyped-def]
        ctx.set_materialize_grads(False)
        run = _PooledPass(tensors[:num_parts], tensors[num_parts:], activation, True, each)
        ctx.num_parts, ctx.run = num_parts, run
        ctx.save_for_backward(*tensors)  # so that autograd notices a change of them
        things, run.each = run.each, None
        return run.outputs.detach(), things

    @staticmethod
    def backward(ctx, grad, by_each):  # type: ignore[no-untyped-def]
        parts, first = ctx.saved_tensors[: ctx.num_parts], 3 + ctx.num_parts
        ctx.run.by_each, grad = by_each, torch.zeros_like(ctx.run.outputs) if grad is None else grad
        learns, asked = ctx.needs_input_grad[first:], ctx.needs_input_grad[3:first]
        grads, below = ctx.run.backward_to(grad, learns, asked)
        below = [None if by_x is None else by_x.view(x.shape) for by_x, x in zip(below, parts, strict=True)]
        return None, None, None, *below, *grads


def compiled_pool(
    parts: Sequence[Tensor], parameters: Sequence[Tensor], activation: str, each: bool
) -> tuple[Tensor, Tensor | None]:
    """Pass things of sets [S, B, K, .] through a perceptron that ends with an activation.

    Returned are mean and maximum over each set [S, B, 2H], and what it gives of each thing [S, B, K, H] where asked.
    """
    if torch.is_grad_enabled():
        return _Pooled.apply(activation, each, len(parts), *parts, *parameters)  # type: ignore[no-untyped-call]
    run = _PooledPass(parts, parameters, activation, keep=False, each=each)
    return run.outputs, run.each
