"""Layers with a leading seed axis: parameters are [S, in, out], data [S, B, in], one matrix product for all seeds.

Seed k's parameters come from seed k's generator and its outputs and gradients depend on nothing else, so a seed
learns the same alone and among ten.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import islice

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
        layers: Iterator[SeedLinear] = islice(self.layers, first, None)  # type: ignore[arg-type]
        parameters = [parameter for layer in layers for parameter in (layer.weight, layer.bias)]
        few = x.shape[0] * x.shape[1] <= CACHED_ROWS and self.precision == torch.float32
        if few and not torch.is_grad_enabled():  # acting: a step of all worlds
            return _run(x, parameters, self.activation, self.activate_output)[-1]
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


def _run(x: Tensor, parameters: Sequence[Tensor], activation: str, activate_output: bool) -> list[Tensor]:
    """Return x and what every layer of a perceptron gives."""
    run, last = [x], len(parameters) // 2 - 1
    for k in range(last + 1):
        layer = _hidden if k < last or activate_output else _linear
        run.append(layer(parameters[2 * k + 1], run[-1], parameters[2 * k], activation))
    return run


class _Perceptron(Function):
    """y = W_n act(... act(x W_1 + b_1) ...) + b_n with in-place activations and a backward that reuses its buffers.

    An activation's derivative is read off its output (relu: h > 0, tanh: 1 - h^2), so nothing but the
    activations is kept. Autograd through torch's layers computes the same and is the reference in the tests.
    """

    @staticmethod
    def forward(ctx, x, activation, activate_output, precision, *parameters):  # type: ignore[no-untyped-def]
        ctx.dtype, ctx.rounds = x.dtype, precision != torch.float32
        if ctx.rounds:
            x, parameters = x.to(precision), tuple(p.to(precision) for p in parameters)
        weights = parameters[::2]
        ctx.size = max(1, CACHED_ROWS // x.shape[0])
        kept, outputs = [], []
        for piece in x.split(ctx.size, 1):
            run = _run(piece, parameters, activation, activate_output)
            kept += run[: len(weights) + activate_output]
            outputs.append(run[-1])
        ctx.save_for_backward(*kept, *weights)
        ctx.count, ctx.activation, ctx.activate_output = len(weights), activation, activate_output
        y = outputs[0] if len(outputs) == 1 else torch.cat([y.transpose(1, 2) for y in outputs], 2).transpose(1, 2)
        return y.float() if ctx.rounds else y

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        kept, weights = ctx.saved_tensors[: -ctx.count], ctx.saved_tensors[-ctx.count :]
        per_piece = ctx.count + ctx.activate_output
        if ctx.rounds:
            grad = grad.to(weights[0].dtype)
        grads: list[Tensor | None] = [None] * (2 * ctx.count)
        below = []
        for n, upper in enumerate(grad.split(ctx.size, 1)):
            inputs, here = kept[n * per_piece : (n + 1) * per_piece], upper
            if ctx.activate_output:
                here = _activation_backward(here.clone(), inputs[-1], ctx.activation)
            for k in reversed(range(ctx.count)):
                if ctx.needs_input_grad[4 + 2 * k]:  # not where a critic only passes a gradient on to the actor
                    grads[2 * k] = _outer(inputs[k], here, grads[2 * k])
                    grads[2 * k + 1] = _added(here.sum(1, keepdim=True), grads[2 * k + 1])
                if k > 0:
                    here = torch.bmm(here, weights[k].transpose(1, 2))
                    here = _activation_backward(here, inputs[k], ctx.activation)
            if ctx.needs_input_grad[0]:
                below.append(torch.bmm(here, weights[0].transpose(1, 2)))
        if ctx.rounds:
            grads = [None if g is None else g.float() for g in grads]
        return torch.cat(below, 1).to(ctx.dtype) if below else None, None, None, None, *grads


CACHED_ROWS = 4096
"""Rows, over all seeds, that go through a perceptron at once: what is kept of them fits a processor's cache."""

THIN = 16
"""Outputs below which a batched product runs several times faster with rows and columns exchanged (MKL, measured)."""


# A single column is computed as two: for one seed and one column torch would take a matrix-vector routine, which rounds
# otherwise than the batched product that several seeds take.


def affine(bias: Tensor, x: Tensor, weight: Tensor, scale: float = 1.0) -> Tensor:
    """Return scale (x W + b) [S, B, out]; for a thin output as the transpose of W' x' + b', so with B innermost."""
    if weight.shape[-1] >= THIN:
        return torch.baddbmm(bias, x, weight, beta=scale, alpha=scale)
    if weight.shape[-1] == 1:
        return affine(pad(bias, (0, 1)), x, pad(weight, (0, 1)), scale)[..., :1]
    return torch.baddbmm(
        bias.transpose(1, 2), weight.transpose(1, 2), x.transpose(1, 2), beta=scale, alpha=scale
    ).transpose(1, 2)


def _linear(bias: Tensor, x: Tensor, weight: Tensor, _: str) -> Tensor:
    return affine(bias, x, weight)


def _hidden(bias: Tensor, x: Tensor, weight: Tensor, activation: str) -> Tensor:
    """Return act(x W + b)."""
    if activation == "relu" or x.dtype == torch.bfloat16:
        return activate_(affine(bias, x, weight), activation)
    return _tanh_from_sigmoid_(affine(bias, x, weight, 2.0).sigmoid_())


def _outer(x: Tensor, grad: Tensor, more: Tensor | None = None) -> Tensor:
    """Return x' grad, the gradient [S, in, out] of a weight, added to `more`."""
    if grad.shape[-1] >= THIN:
        rows = x.transpose(1, 2)
        return torch.bmm(rows, grad) if more is None else more.baddbmm_(rows, grad)
    if grad.shape[-1] == 1:
        return _added(_outer(x, pad(grad, (0, 1)))[..., :1], more)
    return _added(torch.bmm(grad.transpose(1, 2), x).transpose(1, 2), more)


def _added(part: Tensor, more: Tensor | None) -> Tensor:
    return part if more is None else more.add_(part)


def activate_(x: Tensor, activation: str) -> Tensor:
    """Apply an activation in place; tanh x is computed as 2 s(2x) - 1, three times as fast as torch's tanh."""
    if activation == "relu":
        return torch.relu_(x)
    if x.requires_grad:  # autograd follows torch's own alone
        return torch.tanh_(x)
    if x.dtype == torch.bfloat16:  # too coarse around s(0) = 1/2
        return x.copy_(activate_(x.float(), activation))
    return _tanh_from_sigmoid_(x.mul_(2).sigmoid_())


_MINUS_ONE = torch.tensor(-1.0)


def _tanh_from_sigmoid_(x: Tensor) -> Tensor:
    return torch.add(_MINUS_ONE, x, alpha=2, out=x)


def _activation_backward(grad: Tensor, output: Tensor, activation: str) -> Tensor:
    """Multiply `grad` in place by the activation's derivative at its `output`."""
    if activation == "relu":
        return torch.ops.aten.threshold_backward.grad_input(grad, output, 0, grad_input=grad)
    return torch.ops.aten.tanh_backward.grad_input(grad, output, grad_input=grad)
