"""A gated recurrent unit with a leading seed axis, unrolled by hand; see `layers`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.autograd import Function

from esp_cli.networks.kernels.library import begin, computes
from esp_cli.networks.kernels.recurrent import CompiledUnroll
from esp_cli.networks.layers import SeedLinear
from esp_cli.networks.perceptron import activate_


class SeedGRU(nn.Module):
    """A gated recurrent unit (Cho et al., 2014) for S seeds.

    r = s(x W_r + h U_r), z = s(x W_z + h U_z), n = tanh(x W_n + r * (h U_n + b_n)), h' = (1 - z) n + z h.

    Args:
        generators: one per seed; they draw the initial weights.
        inputs: width of an input row.
        hidden: H, width of the memory.
        compiled: whether it is unrolled by the compiled kernel on the CPU.
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
        return self.advance(self.input(x), h)

    def advance(self, projected: Tensor, h: Tensor) -> Tensor:
        """Advance one step from the already projected input [S, B, 3H]."""
        xr, xz, xn = projected.chunk(3, -1)
        hr, hz, hn = self.recurrent(h).chunk(3, -1)
        reset, update = torch.sigmoid(xr + hr), torch.sigmoid(xz + hz)
        candidate = torch.tanh(torch.addcmul(xn, reset, hn))
        return torch.lerp(candidate, h, update)

    def unroll(self, x: Tensor, truncation: int = 0) -> Tensor:
        """Advance through whole episodes from empty memory: x [S, T, B, in] -> every memory [S, T, B, H].

        The same as `forward` step by step, with a backward written by hand that works in place on what fits a cache;
        gradients through time are cut every `truncation` steps (0: never).
        """
        layers = (self.input.weight, self.input.bias, self.recurrent.weight, self.recurrent.bias)
        if computes(self.compiled, x):
            if torch.is_grad_enabled():
                return _CompiledUnrolled.apply(x, truncation, *layers)  # type: ignore[no-untyped-call]
            return CompiledUnroll(x, layers, truncation, keep=False).memories
        if torch.is_grad_enabled():
            return _Unrolled.apply(x, truncation, *layers)  # type: ignore[no-untyped-call]
        return _advanced(x, *layers)[0][:, 1:]


def _gates(weight: Tensor) -> Tensor:
    """Return what belongs to r, z and n of a weight or bias [S, ..., 3H] by itself: [3, S, ..., H]."""
    return weight.unflatten(2, (3, -1)).permute(2, 0, 1, 3).contiguous()


def _advanced(
    x: Tensor, weight: Tensor, bias: Tensor, recurrent: Tensor, inner_bias: Tensor, keep: bool = False
) -> tuple[Tensor, list[Tensor], list[Tensor]]:
    """Return all memories [S, 1 + T, B, H], and if kept r, z, n [3, S, B, H] and h U_n + b_n [S, B, H] of every step.

    The memory of t = 0 is empty.
    """
    num_seeds, num_steps, batch = x.shape[:3]
    (w_r, w_z, w_n), (u_r, u_z, u_n) = _gates(weight), _gates(recurrent)
    (b_r, b_z, _), (_, _, c_n), (_, _, b_n) = _gates(bias + inner_bias), _gates(inner_bias), _gates(bias)
    memories = x.new_empty(num_seeds, 1 + num_steps, batch, recurrent.shape[1])
    memories[:, 0] = 0
    gates, inner = x.new_empty(3, *memories[:, 0].shape), torch.empty_like(memories[:, 0])
    every: tuple[list[Tensor], list[Tensor]] = ([], [])
    for t in range(num_steps):
        if keep and t:
            gates, inner = torch.empty_like(gates), torch.empty_like(inner)
        now, memory, (reset, update, candidate) = x[:, t], memories[:, t], gates
        torch.baddbmm(b_r, now, w_r, out=reset).baddbmm_(memory, u_r)
        torch.baddbmm(b_z, now, w_z, out=update).baddbmm_(memory, u_z)
        gates[:2].sigmoid_()
        torch.baddbmm(c_n, memory, u_n, out=inner)
        torch.baddbmm(b_n, now, w_n, out=candidate).addcmul_(reset, inner)
        activate_(candidate, "tanh")
        torch.lerp(candidate, memory, update, out=memories[:, t + 1])
        every[0].append(gates)
        every[1].append(inner)
    return memories, *every


class _Unrolled(Function):
    """All steps of a gated recurrent unit; `SeedGRU.forward` under autograd is the reference in the tests."""

    @staticmethod
    def forward(ctx, x, truncation, weight, bias, recurrent, inner_bias):  # type: ignore[no-untyped-def]
        memories, gates, inner = _advanced(x, weight, bias, recurrent, inner_bias, keep=True)
        ctx.save_for_backward(x, weight, recurrent, memories, *gates, *inner)
        ctx.truncation = truncation
        return memories[:, 1:]

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        x, weight, recurrent, memories, *kept = ctx.saved_tensors
        num_steps = len(kept) // 2
        learned = _Learned(weight, recurrent)
        by_x, carry = torch.empty_like(x), torch.zeros_like(memories[:, 0])
        d = carry.new_empty(4, *carry.shape)  # by r, z and n before their activations, and by h U_n + b_n
        gap = torch.empty_like(carry)
        for t in reversed(range(num_steps)):
            (reset, update, candidate), inner, before = kept[t], kept[num_steps + t], memories[:, t]
            carry += grad[:, t]
            passed = carry * update
            torch.ops.aten.tanh_backward.grad_input(torch.sub(carry, passed, out=gap), candidate, grad_input=d[2])
            torch.mul(d[2], inner, out=d[0])
            torch.mul(torch.sub(before, candidate, out=gap), carry, out=d[1])
            torch.ops.aten.sigmoid_backward.grad_input(d[:2], kept[t][:2], grad_input=d[:2])
            torch.mul(d[2], reset, out=d[3])
            by_x[:, t] = learned.add(d, x[:, t], before)
            if ctx.truncation and t % ctx.truncation == 0:
                carry.zero_()
            else:
                carry = learned.through_time(d, passed)
        return by_x, None, *learned.gradients()


class _CompiledUnrolled(Function):
    """The same by the kernel."""

    @staticmethod
    def forward(ctx, x, truncation, *layers):  # type: ignore[no-untyped-def]
        ctx.run = CompiledUnroll(x, layers, truncation, keep=True)
        ctx.save_for_backward(x, *layers)  # so that autograd notices a change of them
        return ctx.run.memories.detach()  # the tensor itself would hold, by its grad_fn, what holds it

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        _ = ctx.saved_tensors
        by_x, found = ctx.run.backward(grad)
        return by_x, None, *found


class _Learned:
    """The weights of a gated recurrent unit by gates, and the gradients by them, a sum over the steps."""

    def __init__(self, weight: Tensor, recurrent: Tensor) -> None:
        self.inputs, self.memories = _gates(weight), _gates(recurrent)
        self.by_inputs, self.by_memories = torch.zeros_like(self.inputs), torch.zeros_like(self.memories)
        self.by_sums = weight.new_zeros(4, weight.shape[0], 1, self.inputs.shape[-1])

    def add(self, d: Tensor, x: Tensor, memory: Tensor) -> Tensor:
        """Add a step's gradients, known those by its sums [4, S, B, H], and return that by its input [S, B, in]."""
        x, memory = x.transpose(1, 2), memory.transpose(1, 2)
        self.by_sums += d.sum(2, keepdim=True)
        for k, (by_input, by_memory) in enumerate(zip(self.by_inputs, self.by_memories, strict=True)):
            by_input.baddbmm_(x, d[k])
            by_memory.baddbmm_(memory, d[k if k < 2 else 3])
        w_r, w_z, w_n = self.inputs.transpose(2, 3)
        return torch.bmm(d[0], w_r).baddbmm_(d[1], w_z).baddbmm_(d[2], w_n)

    def through_time(self, d: Tensor, passed: Tensor) -> Tensor:
        """Return the gradient by the memory before a step, added to what passes it by; in place."""
        u_r, u_z, u_n = self.memories.transpose(2, 3)
        return passed.baddbmm_(d[0], u_r).baddbmm_(d[1], u_z).baddbmm_(d[3], u_n)

    def gradients(self) -> list[Tensor]:
        """Return those by W, its bias, U and its bias."""
        r, z, n, inner = self.by_sums
        parts = ((*self.by_inputs,), (r, z, n), (*self.by_memories,), (r, z, inner))
        return [torch.cat(gates, -1) for gates in parts]
