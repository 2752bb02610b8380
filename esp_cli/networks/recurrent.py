"""A gated recurrent unit with a leading seed axis, unrolled by hand; see `layers`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.autograd import Function

from esp_cli.networks.layers import SeedLinear
from esp_cli.networks.perceptron import activate_


class SeedGRU(nn.Module):
    """A gated recurrent unit (Cho et al., 2014) for S seeds.

    r = s(x W_r + h U_r), z = s(x W_z + h U_z), n = tanh(x W_n + r * (h U_n + b_n)), h' = (1 - z) n + z h.
    """

    def __init__(self, generators: Sequence[torch.Generator], inputs: int, hidden: int) -> None:
        super().__init__()
        self.hidden = hidden
        self.input = SeedLinear(generators, inputs, 3 * hidden, 1.0)
        self.recurrent = SeedLinear(generators, hidden, 3 * hidden, 1.0)

    def forward(self, x: Tensor, h: Tensor) -> Tensor:
        """Advance one step: x [S, B, in], h [S, B, H] -> h' [S, B, H]."""
        return self.advance(self.input(x), h)

    def advance(self, projected: Tensor, h: Tensor) -> Tensor:
        """Advance one step from the already projected input [S, B, 3H]."""
        xr, xz, xn = projected.chunk(3, -1)
        hr, hz, hn = self.recurrent(h).chunk(3, -1)
        reset, update = torch.sigmoid(xr + hr), torch.sigmoid(xz + hz)
        candidate = torch.tanh(torch.addcmul(xn, reset, hn))
        return torch.lerp(candidate, h, update)

    def unroll(self, projected: Tensor, truncation: int = 0) -> Tensor:
        """Advance through whole episodes from empty memory: [T, S, B, 3H] -> every memory [T, S, B, H].

        The same as `advance` step by step, with a backward written by hand that works in place and makes one product
        for the gradient of the weights of all steps; gradients through time are cut every `truncation` steps (0:
        never).
        """
        weight, bias = self.recurrent.weight, self.recurrent.bias
        return _Unrolled.apply(projected, weight, bias, truncation)  # type: ignore[no-untyped-call]


class _Unrolled(Function):
    """All steps of a gated recurrent unit; `SeedGRU.advance` under autograd is the reference in the tests."""

    @staticmethod
    def forward(ctx, projected, weight, bias, truncation):  # type: ignore[no-untyped-def]
        num_steps, num_seeds, batch, width = projected.shape
        hidden = width // 3
        memories = projected.new_zeros(num_steps + 1, num_seeds, batch, hidden)
        gates = torch.empty_like(projected, memory_format=torch.contiguous_format)  # r, z, n of every step
        inner = torch.empty_like(memories[1:])  # h U_n + b_n of every step
        recurrent = torch.empty_like(gates[0])  # h U + b
        for t in range(num_steps):
            memory, x, gate = memories[t], projected[t], gates[t]
            opened, candidate = gate[..., : 2 * hidden], gate[..., 2 * hidden :]
            torch.baddbmm(bias, memory, weight, out=recurrent)
            torch.add(x[..., : 2 * hidden], recurrent[..., : 2 * hidden], out=opened).sigmoid_()
            inner[t].copy_(recurrent[..., 2 * hidden :])
            reset, update = opened.chunk(2, -1)
            torch.addcmul(x[..., 2 * hidden :], reset, inner[t], out=candidate)
            activate_(candidate, "tanh")
            torch.lerp(candidate, memory, update, out=memories[t + 1])
        ctx.save_for_backward(memories, gates, inner, weight)
        ctx.truncation = truncation
        return memories[1:]

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        memories, gates, inner, weight = ctx.saved_tensors
        num_steps, hidden = grad.shape[0], grad.shape[3]
        into, back = torch.empty_like(gates), torch.empty_like(gates)  # of x W and of h U + b
        backwards, carry = weight.transpose(1, 2), torch.zeros_like(memories[0])
        passed, gap = torch.empty_like(carry), torch.empty_like(carry)
        for t in reversed(range(num_steps)):
            reset, update, candidate = gates[t].chunk(3, -1)
            opening, inward = into[t, ..., : 2 * hidden], into[t, ..., 2 * hidden :]
            carry += grad[t]
            torch.mul(carry, update, out=passed)
            torch.ops.aten.tanh_backward.grad_input(torch.sub(carry, passed, out=gap), candidate, grad_input=inward)
            torch.mul(inward, inner[t], out=opening[..., :hidden])
            torch.mul(torch.sub(memories[t], candidate, out=gap), carry, out=opening[..., hidden:])
            torch.ops.aten.sigmoid_backward.grad_input(opening, gates[t, ..., : 2 * hidden], grad_input=opening)
            back[t, ..., : 2 * hidden].copy_(opening)
            torch.mul(inward, reset, out=back[t, ..., 2 * hidden :])
            if ctx.truncation and t % ctx.truncation == 0:
                carry.zero_()
            else:
                torch.baddbmm(passed, back[t], backwards, out=carry)
        rows = back.transpose(0, 1).flatten(1, 2)
        before = memories[:-1].transpose(0, 1).flatten(1, 2)
        return into, torch.bmm(before.transpose(1, 2), rows), rows.sum(1, keepdim=True), None
