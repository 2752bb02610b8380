"""Kernels of networks over sets; `esp_cli.networks.sets` has the same by torch."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from esp_cli.networks.kernels.library import call


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
    """Sort the things of a set by distance in rows [B, D] on the CPU, in place.

    Args:
        rows: contiguous.
        columns: where each thing's numbers are, [K, W].
        at: the number of a thing with which its place begins.
        reader: the column of the place from which distances are; None for the origin.
    """
    own = -1 if reader is None else reader
    call(
        "sets",
        "sort",
        _shape(*rows.shape, *columns.shape, at, own, torch.get_num_threads()),
        columns.contiguous(),
        rows,
    )


class _CompiledPool(torch.autograd.Function):
    """`compiled_pool` under autograd."""

    @staticmethod
    def forward(ctx, things):  # type: ignore[no-untyped-def]
        things = things.contiguous()
        found = things.new_empty(*things.shape[:2], 2 * things.shape[3])
        ctx.sizes = (things.shape[0] * things.shape[1], *things.shape[2:], torch.get_num_threads())
        call("sets", "pool", _shape(*ctx.sizes), things, found)
        ctx.save_for_backward(things, found)
        return found

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        things, found = ctx.saved_tensors
        by_things = torch.empty_like(things)
        call("sets", "pool_backward", _shape(*ctx.sizes), things, found, grad.contiguous(), by_things)
        return by_things


def compiled_pool(things: Tensor) -> Tensor:
    """Return mean and maximum over the things of a set: [S, B, K, H] to [S, B, 2H]."""
    return _CompiledPool.apply(things)  # type: ignore[no-untyped-call]
