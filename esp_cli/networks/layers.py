"""Layers with a leading seed axis: parameters are [S, in, out], data [S, B, in], one matrix product for all seeds.

Seed k's parameters come from seed k's generator and its outputs and gradients depend on nothing else, so a seed
learns the same alone and among ten.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.nn.functional import pad

GAINS = {"relu": math.sqrt(2.0), "tanh": 5.0 / 3.0}
"""Orthogonal gain of a hidden layer, as in the MAPPO paper's code (torch.nn.init.calculate_gain)."""


def orthogonal(generators: Sequence[torch.Generator], rows: int, columns: int, gain: float) -> Tensor:
    """Draw one orthogonal matrix per seed (Saxe et al., 2014).

    Returns:
        [S, rows, columns] on the CPU, whatever the later device, so that a seed starts the same everywhere.
    """
    stack = [nn.init.orthogonal_(torch.empty(columns, rows), gain, generator=g).T for g in generators]
    return torch.stack([matrix.contiguous() for matrix in stack])


class SeedLinear(nn.Module):
    """y = x W + b for S seeds.

    Shape:
        x: [S, B, in] -> [S, B, out].
    """

    def __init__(self, generators: Sequence[torch.Generator], inputs: int, outputs: int, gain: float) -> None:
        super().__init__()
        self.weight = nn.Parameter(orthogonal(generators, inputs, outputs, gain))
        self.bias = nn.Parameter(torch.zeros(len(generators), 1, outputs))

    def forward(self, x: Tensor) -> Tensor:
        """Apply the layer."""
        return affine(self.bias, x, self.weight)


class SeedLayerNorm(nn.Module):
    """Layer normalisation with one gain and bias vector per seed (Ba et al., 2016)."""

    def __init__(self, num_seeds: int, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(num_seeds, 1, width))
        self.bias = nn.Parameter(torch.zeros(num_seeds, 1, width))

    def forward(self, x: Tensor) -> Tensor:
        """Normalise the last axis of x: [S, B, width]."""
        return torch.addcmul(self.bias, nn.functional.layer_norm(x, x.shape[-1:]), self.weight)


class SeedMLP(nn.Module):
    """A multi-layer perceptron for S seeds.

    Without layer normalisation forward and backward run through one hand-written function (`_Perceptron`) that keeps
    only the activations and works in place; with it, through torch's own layers.

    Args:
        generators: one per seed; they draw the initial weights.
        sizes: input width, hidden widths, output width.
        activation: "relu" or "tanh".
        output_gain: orthogonal gain of the last layer (0.01 for a policy head, 1 for a value).
        layer_norm: normalise the input and every hidden activation, as the MAPPO paper's code does.
        activate_output: end with an activation, for a body on which something else stands.
        precision: of the matrix products; parameters, inputs, outputs and parameter gradients stay float32.
    """

    def __init__(
        self,
        generators: Sequence[torch.Generator],
        sizes: Sequence[int],
        activation: str,
        output_gain: float,
        layer_norm: bool = False,
        activate_output: bool = False,
        precision: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        hidden_gain = GAINS[activation]
        gains = [hidden_gain] * (len(sizes) - 2) + [output_gain]
        self.layers = nn.ModuleList(
            SeedLinear(generators, a, b, gain) for a, b, gain in zip(sizes[:-1], sizes[1:], gains, strict=True)
        )
        self.activation = activation
        self.activate_output = activate_output
        self.precision = precision
        normed = sizes if activate_output else sizes[:-1]
        self.norms = nn.ModuleList(SeedLayerNorm(len(generators), w) for w in normed) if layer_norm else None

    def forward(self, x: Tensor) -> Tensor:
        """Map [S, B, in] to [S, B, out]."""
        return self._from_layer(0, x) if self.norms is None else self._forward_normed(x)

    def from_first_sums(self, sums: Tensor) -> Tensor:
        """Map what the first layer gives, x W_1 + b_1 before its activation, [S, B, H], to [S, B, out].

        Works in place on `sums`. Not with layer normalisation.
        """
        if len(self.layers) == 1 and not self.activate_output:
            return sums.float()
        x = activate_(sums, self.activation)
        return x.float() if len(self.layers) == 1 else self._from_layer(1, x)

    @torch.no_grad()
    def idle_units(self, x: Tensor) -> Tensor:
        """Return the share of hidden units that no row of x [S, B, in] wakes: [S]; of relu networks.

        A unit that is 0 everywhere gets no gradient and is lost to the network (Sokar et al., 2023).
        """
        x = x if self.norms is None else self.norms[0](x)
        idle = []
        for k, layer in enumerate(self.layers if self.activate_output else self.layers[:-1]):
            x = torch.relu(layer(x))
            idle.append((x <= 0).all(1))
            if self.norms is not None and k + 1 < len(self.norms):
                x = self.norms[k + 1](x)
        return torch.cat(idle, 1).float().mean(1)

    def _from_layer(self, first: int, x: Tensor) -> Tensor:
        parameters = [p for layer in self.layers[first:] for p in (layer.weight, layer.bias)]
        return _Perceptron.apply(  # type: ignore[no-untyped-call]
            x, self.activation, self.activate_output, self.precision, *parameters
        )

    def _forward_normed(self, x: Tensor) -> Tensor:
        assert self.norms is not None
        x = self.norms[0](x)
        last = len(self.layers) - 1
        for k, layer in enumerate(self.layers):
            x = layer(x)
            if k < last or self.activate_output:
                x = self.norms[k + 1](torch.relu(x) if self.activation == "relu" else torch.tanh(x))
        return x


class _Perceptron(Function):
    """y = W_n act(... act(x W_1 + b_1) ...) + b_n with in-place activations and a backward that reuses its buffers.

    An activation's derivative is read off its output (relu: h > 0, tanh: 1 - h^2), so nothing but the
    activations is kept. Autograd through torch's layers computes the same and is the reference in the tests.
    """

    @staticmethod
    def forward(ctx, x, activation, activate_output, precision, *parameters):  # type: ignore[no-untyped-def]
        ctx.dtype, x = x.dtype, x.to(precision)
        inputs, weights, last = [x], [w.to(precision) for w in parameters[::2]], len(parameters) // 2 - 1
        for k in range(last + 1):
            x = affine(parameters[2 * k + 1].to(precision), x, weights[k])
            if k < last or activate_output:
                inputs.append(activate_(x, activation))
        ctx.save_for_backward(*inputs, *weights)
        ctx.activation, ctx.activate_output = activation, activate_output
        return x.float()

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        saved = ctx.saved_tensors
        count = (len(saved) - 1) // 2 if ctx.activate_output else len(saved) // 2
        inputs, weights = saved[:-count], saved[-count:]
        grad = grad.to(weights[0].dtype)
        if ctx.activate_output:
            grad = _activation_backward(grad.clone(), inputs[count], ctx.activation)
        grads: list[Tensor | None] = [None] * (2 * count)
        for k in reversed(range(count)):
            if ctx.needs_input_grad[4 + 2 * k]:  # not where a critic only passes a gradient on to the actor
                grads[2 * k] = _outer(inputs[k], grad).float()
                grads[2 * k + 1] = grad.sum(1, keepdim=True).float()
            if k > 0:
                grad = _activation_backward(torch.bmm(grad, weights[k].transpose(1, 2)), inputs[k], ctx.activation)
        grad_x = torch.bmm(grad, weights[0].transpose(1, 2)).to(ctx.dtype) if ctx.needs_input_grad[0] else None
        return grad_x, None, None, None, *grads


THIN = 16
"""Outputs below which a batched product runs several times faster with rows and columns exchanged (MKL, measured)."""


# A single column is computed as two: for one seed and one column torch would take a matrix-vector routine, which rounds
# otherwise than the batched product that several seeds take.


def affine(bias: Tensor, x: Tensor, weight: Tensor) -> Tensor:
    """Return x W + b [S, B, out]; for a thin output as the transpose of W' x' + b', so with B innermost in memory."""
    if weight.shape[-1] >= THIN:
        return torch.baddbmm(bias, x, weight)
    if weight.shape[-1] == 1:
        return affine(pad(bias, (0, 1)), x, pad(weight, (0, 1)))[..., :1]
    return torch.baddbmm(bias.transpose(1, 2), weight.transpose(1, 2), x.transpose(1, 2)).transpose(1, 2)


def _outer(x: Tensor, grad: Tensor) -> Tensor:
    """Return x' grad, the gradient [S, in, out] of a weight."""
    if grad.shape[-1] >= THIN:
        return torch.bmm(x.transpose(1, 2), grad)
    if grad.shape[-1] == 1:
        return _outer(x, pad(grad, (0, 1)))[..., :1]
    return torch.bmm(grad.transpose(1, 2), x).transpose(1, 2)


def activate_(x: Tensor, activation: str) -> Tensor:
    """Apply an activation in place; tanh x is computed as 2 s(2x) - 1, three times as fast as torch's tanh."""
    if activation == "relu":
        return torch.relu_(x)
    if x.dtype == torch.bfloat16:  # too coarse around s(0) = 1/2
        return x.copy_(activate_(x.float(), activation))
    return x.mul_(2).sigmoid_().mul_(2).sub_(1)


def _activation_backward(grad: Tensor, output: Tensor, activation: str) -> Tensor:
    """Multiply `grad` in place by the activation's derivative at its `output`."""
    if activation == "relu":
        return torch.ops.aten.threshold_backward.grad_input(grad, output, 0, grad_input=grad)
    return torch.ops.aten.tanh_backward.grad_input(grad, output, grad_input=grad)


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
