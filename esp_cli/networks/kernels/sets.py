"""Kernels of networks over sets; `esp_cli.networks.sets` has the same by torch."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

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


class PooledPass(CompiledPass):
    """A pass of things [S, B, K, .] through a perceptron that ends with an activation.

    The outputs are mean and maximum over each set, [S, B, 2H], and for `each` also what it gives of each thing, [S, B,
    K, H]. To compute what layers give to many things costs less than to keep it.
    """

    computes_again = True

    def __init__(
        self, activation: str, each: bool, parts: Sequence[Tensor], parameters: Sequence[Tensor], keep: bool
    ) -> None:
        self._sets, self._each = parts[0].shape[:3], each
        self._by_each: Tensor | None = None
        super().__init__(parts, parameters, activation, True, keep=keep, things=self._sets[2])

    def backward_to(
        self, grad: Tensor, learns: Sequence[bool], asked: Sequence[bool], by_each: Tensor | None = None
    ) -> tuple[list[Tensor | None], list[Tensor | None]]:
        self._by_each = None if by_each is None else by_each.contiguous()
        return super().backward_to(grad.contiguous(), learns, asked)

    def _passed(self, like: Tensor, columns_first: bool) -> Any:
        width = self._plan.widths[-1]
        outputs = like.new_empty(*self._sets[:2], 2 * width)
        things = like.new_empty(*self._sets, width) if self._each else None
        call("sets", "pool", self._arguments, RowsAt.of(outputs), _rows(things))
        return outputs if things is None else (outputs, things)

    def _pull(self, grad: Tensor, found: Tensor | None, below: Below) -> None:
        call("sets", "pool_backward", self._arguments, RowsAt.of(grad), _rows(self._by_each), found, below)


def _rows(things: Tensor | None) -> RowsAt:
    return RowsAt() if things is None else RowsAt.of(things.flatten(1, 2))
