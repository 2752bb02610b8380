"""A gated recurrent unit with a leading seed axis, unrolled by hand; see `layers`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor, nn

from esp_cli.networks.kernels.library import begin, computes
from esp_cli.networks.kernels.recurrent import CompiledUnroll
from esp_cli.networks.layers import SeedLinear
from esp_cli.networks.perceptron import activate_, passed


class SeedGRU(nn.Module):
    """A gated recurrent unit (Cho et al., 2014) for S seeds.

    r = s(x W_r + h U_r), z = s(x W_z + h U_z), n = tanh(x W_n + r * (h U_n + b_n)), h' = (1 - z) n + z h.
    """

    def __init__(self, generators: Sequence[torch.Generator], inputs: int, hidden: int, compiled: bool = False) -> None:
        super().__init__()
        self.hidden, self.compiled = hidden, compiled
        if compiled:
            begin("recurrent")
        self.input = SeedLinear(generators, inputs, 3 * hidden, 1.0)
        self.recurrent = SeedLinear(generators, hidden, 3 * hidden, 1.0)

    def forward(self, x: Tensor, h: Tensor) -> Tensor:
        """Advance one step: x [S, B, in], h [S, B, H] -> h' [S, B, H]."""
        xr, xz, xn = self.input(x).chunk(3, -1)
        hr, hz, hn = self.recurrent(h).chunk(3, -1)
        reset, update = torch.sigmoid(xr + hr), torch.sigmoid(xz + hz)
        candidate = torch.tanh(torch.addcmul(xn, reset, hn))
        return torch.lerp(candidate, h, update)

    def unroll(self, x: Tensor, truncation: int = 0) -> Tensor:
        """Advance through whole episodes from empty memory: x [S, T, B, in] -> every memory [S, T, B, H]."""
        unroll = CompiledUnroll if computes(self.compiled, x) else _Unroll
        return passed(partial(unroll, truncation), [x], [*self.parameters()])


def _gates(weight: Tensor) -> Tensor:
    """Return what belongs to r, z and n of a weight or bias [S, ..., 3H] by itself: [3, S, ..., H]."""
    return weight.unflatten(2, (3, -1)).permute(2, 0, 1, 3).contiguous()


class _Unroll:
    """All steps of a gated recurrent unit by torch, from empty memory; see `CompiledUnroll`."""

    def __init__(self, truncation: int, inputs: Sequence[Tensor], layers: Sequence[Tensor], keep: bool) -> None:
        (x,), (weight, bias, recurrent, inner_bias) = inputs, layers
        self._x, self._weights, self._truncation = x, (weight, recurrent), truncation
        (w_r, w_z, w_n), (u_r, u_z, u_n) = _gates(weight), _gates(recurrent)
        (b_r, b_z, _), (_, _, c_n), (_, _, b_n) = _gates(bias + inner_bias), _gates(inner_bias), _gates(bias)
        self._all = x.new_empty(x.shape[0], 1 + x.shape[1], x.shape[2], recurrent.shape[1])  # empty memory first
        self._all[:, 0] = 0
        self._kept: list[tuple[Tensor, Tensor]] = []  # r, z, n [3, S, B, H] and h U_n + b_n [S, B, H] of every step
        gates, inner = x.new_empty(3, *self._all[:, 0].shape), torch.empty_like(self._all[:, 0])
        for t in range(x.shape[1]):
            if keep:
                gates, inner = torch.empty_like(gates), torch.empty_like(inner)
                self._kept.append((gates, inner))
            now, memory, (reset, update, candidate) = x[:, t], self._all[:, t], gates
            torch.baddbmm(b_r, now, w_r, out=reset).baddbmm_(memory, u_r)
            torch.baddbmm(b_z, now, w_z, out=update).baddbmm_(memory, u_z)
            gates[:2].sigmoid_()
            torch.baddbmm(c_n, memory, u_n, out=inner)
            torch.baddbmm(b_n, now, w_n, out=candidate).addcmul_(reset, inner)
            activate_(candidate, "tanh")
            torch.lerp(candidate, memory, update, out=self._all[:, t + 1])
        self.outputs = self._all[:, 1:]

    def backward_to(self, grad: Tensor, *_: Sequence[bool]) -> tuple[list[Tensor], list[Tensor]]:
        """Return the gradients by all layers and by x of what has this gradient by the memories."""
        x, (inputs, memories) = self._x, map(_gates, self._weights)
        by_inputs, by_memories = torch.zeros_like(inputs), torch.zeros_like(memories)
        by_x, carry = torch.empty_like(x), torch.zeros_like(self._all[:, 0])
        d = carry.new_empty(4, *carry.shape)  # by r, z and n before their activations, and by h U_n + b_n
        gap, by_sums = torch.empty_like(carry), carry.new_zeros(4, len(carry), 1, carry.shape[2])
        (w_r, w_z, w_n), (u_r, u_z, u_n) = inputs.transpose(2, 3), memories.transpose(2, 3)
        for t, (gates, inner) in reversed([*enumerate(self._kept)]):
            (reset, update, candidate), before = gates, self._all[:, t]
            carry += grad[:, t]
            past = carry * update
            torch.ops.aten.tanh_backward.grad_input(torch.sub(carry, past, out=gap), candidate, grad_input=d[2])
            torch.mul(d[2], inner, out=d[0])
            torch.mul(torch.sub(before, candidate, out=gap), carry, out=d[1])
            torch.ops.aten.sigmoid_backward.grad_input(d[:2], gates[:2], grad_input=d[:2])
            torch.mul(d[2], reset, out=d[3])
            by_sums += d.sum(2, keepdim=True)
            for k, by_memory in enumerate((0, 1, 3)):
                by_inputs[k].baddbmm_(x[:, t].transpose(1, 2), d[k])
                by_memories[k].baddbmm_(before.transpose(1, 2), d[by_memory])
            by_x[:, t] = torch.bmm(d[0], w_r).baddbmm_(d[1], w_z).baddbmm_(d[2], w_n)
            if self._truncation and t % self._truncation == 0:
                carry.zero_()
            else:
                carry = past.baddbmm_(d[0], u_r).baddbmm_(d[1], u_z).baddbmm_(d[3], u_n)
        r, z, n, inner = by_sums
        parts = (by_inputs.unbind(0), (r, z, n), by_memories.unbind(0), (r, z, inner))
        return [torch.cat(gates, -1) for gates in parts], [by_x]
