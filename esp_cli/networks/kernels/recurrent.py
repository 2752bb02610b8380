"""A gated recurrent unit unrolled over whole episodes, compiled; see `networks.recurrent.SeedGRU.unroll`."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from esp_cli.networks.kernels.library import call, fields, padded


class _Unit(ctypes.Structure):
    _fields_ = (
        *fields(ctypes.c_int64, "seeds", "steps", "rows", "inputs", "hidden", "truncation", "threads"),
        ("x_strides", ctypes.c_int64 * 3),
        ("x", ctypes.c_void_p),
        ("parameters", ctypes.c_void_p * 4),
        ("strides", ctypes.c_int64 * 4),
        ("memories", ctypes.c_void_p),
        ("gates", ctypes.c_void_p),
    )


class CompiledUnroll:
    """A run through whole episodes x [S, T, B, in] from empty memory; the outputs are the memories [S, T, B, H].

    The parameters are W [S, in, 3H], its bias [S, 1, 3H], U [S, H, 3H] and its bias. To `keep` adds a `backward_to`.
    """

    @torch.no_grad()
    def __init__(self, truncation: int, inputs: Sequence[Tensor], parameters: Sequence[Tensor], keep: bool) -> None:
        (x,) = inputs
        x = x if x.stride(3) == 1 else x.contiguous()
        given = [p.detach() if p[0].is_contiguous() else p.detach().contiguous() for p in parameters]
        num_seeds, num_steps, num_rows, num_inputs = x.shape
        hidden = given[2].shape[1]
        width = padded(hidden)
        memories = x.new_empty(num_seeds, num_steps, num_rows, width)
        gates = x.new_empty(num_seeds, num_steps, num_rows, 4 * width) if keep else None
        self._arguments = _Unit(
            num_seeds,
            num_steps,
            num_rows,
            num_inputs,
            hidden,
            truncation,
            torch.get_num_threads(),
            x.stride()[:3],
            x.data_ptr(),
            tuple(p.data_ptr() for p in given),
            tuple(p.stride(0) for p in given),
            memories.data_ptr(),
            None if gates is None else gates.data_ptr(),
        )
        self._alive, self._shapes = (x, given, memories, gates), [p.shape[1:] for p in parameters]
        call("recurrent", "gru_forward", self._arguments)
        self.outputs = memories[..., :hidden]

    def backward_to(self, grad: Tensor, *_: Sequence[bool]) -> tuple[list[Tensor], list[Tensor]]:
        """Return the gradients by all parameters and by x of what has this gradient by the memories."""
        x = self._alive[0]
        grad = grad if grad.stride(3) == 1 else grad.contiguous()
        sizes = [size.numel() for size in self._shapes]
        by_x, found = x.new_empty(x.shape), x.new_empty(x.shape[0], sum(sizes))
        strides = (ctypes.c_int64 * 3)(*grad.stride()[:3])
        call("recurrent", "gru_backward", self._arguments, grad, strides, found, by_x)
        parts = found.split(sizes, 1)
        return [part.unflatten(1, size) for part, size in zip(parts, self._shapes, strict=True)], [by_x]
