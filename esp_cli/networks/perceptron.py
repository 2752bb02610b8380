"""The products and activations of a perceptron of S seeds, forward and backward, in pieces that fit a cache.

Parameters are [S, in, out], data [S, B, in]. Gradients are written by hand: an activation's derivative is read off its
output (relu: h > 0, tanh: 1 - h^2), so nothing but the activations is kept. Autograd through torch's layers computes
the same and is the reference in the tests.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from esp_cli.networks.contract import WithVJP
from esp_cli.networks.kernels.library import computes
from esp_cli.networks.kernels.perceptron import CompiledPass, LearningPass

# rows, over all seeds, that go through a perceptron at once: what is kept of them fits a processor's cache
CACHED_ROWS = 4096

# outputs below which a batched product runs several times faster with rows and columns exchanged (MKL, measured)
THIN = 16


class Shape(NamedTuple):
    """What a perceptron does beside its products."""

    activation: str  # "relu" or "tanh"
    activate_output: bool  # whether it ends with an activation
    precision: torch.dtype  # of the products; what goes in and out stays float32
    # whether the outputs [S, B, out] lie in memory as [S, out, B]; those of thin outputs always do
    rows_innermost: bool = False
    compiled: bool = False  # whether passes on the CPU go through the compiled kernel, in float32


def perceptron(shape: Shape, inputs: Sequence[Tensor], parameters: Sequence[Tensor]) -> Tensor:
    """Return y = W_n act(... act(x W_1 + b_1) ...) + b_n: [S, ..., out], with the axes of the inputs.

    The inputs [S, ..., d] are parts of x, side by side; gradients flow to those that ask for them.
    """
    return passed(partial(_pass, shape), inputs, parameters).unflatten(1, inputs[0].shape[1:-1])


def passed(make: Callable[..., Any], inputs: Sequence[Tensor], parameters: Sequence[Tensor]) -> Any:
    """Return the outputs of `make(inputs, parameters, keep)`, through which gradients flow where there is a graph.

    What it makes has `outputs`, one tensor or several, and where it is to `keep` what it needs for that `backward_to`,
    which takes the gradient by each; see `_Pass`.
    """
    if torch.is_grad_enabled():
        return _Passed.apply(make, len(inputs), *inputs, *parameters)  # type: ignore[no-untyped-call]
    return make(inputs, parameters, keep=False).outputs


class Deferred(WithVJP):
    """What a perceptron returns for rows, computed where somebody asks for it; where it `may_learn`, see `learn`.

    Rows and parameters may not change in place before the outputs are asked for and the VJP is used.
    """

    def __init__(
        self, shape: Shape, rows: Tensor, parameters: Sequence[Tensor], size: Sequence[int], may_learn: bool
    ) -> None:
        self._shape, self._rows, self._may_learn = shape, rows, may_learn
        self.parameters, self.size = parameters, torch.Size(size)

    @cached_property
    @torch.no_grad()
    def _run(self) -> _Pass | CompiledPass:
        return _pass(self._shape, [self._rows], self.parameters, keep=True)

    @property
    def waits(self) -> bool:  # type: ignore[override]
        return self._may_learn and "_run" not in self.__dict__

    @property
    def tensor(self) -> Tensor:  # type: ignore[override]
        return self._run.outputs.unflatten(1, self._rows.shape[1:-1]).reshape(self.size)

    def vjp(self, slope: Tensor) -> list[Tensor]:
        return self._run.backward(slope.reshape(self._run.outputs.shape))

    def learn(self, loss: Callable[[LearningPass], Tensor], parts: int) -> WithVJP:
        """Return the gradients of a loss of P parts, which follow each other in the rows, computed block by block."""
        rows = self._rows.flatten(1, -2).unflatten(1, (parts, -1)).transpose(1, 2)
        run = LearningPass(rows, self.parameters, self._shape.activation)
        return WithVJP(rows, lambda _: [loss(run)], self.parameters)


def _pass(shape: Shape, inputs: Sequence[Tensor], parameters: Sequence[Tensor], keep: bool) -> _Pass | CompiledPass:
    """Return a pass by the kernel where it is chosen, else by torch's operations; its outputs are [S, B, out]."""
    if computes(shape.compiled, inputs[0]):
        return CompiledPass(inputs, parameters, shape.activation, shape.activate_output, shape.rows_innermost, keep)
    return _Pass(shape, inputs, parameters, keep)


def _pieces(shape: Shape, inputs: Sequence[Tensor]) -> Iterator[Tensor]:
    """Return rows whose numbers lie side by side, some at a time."""
    for parts in zip(*(_split(x, _size(x)) for x in inputs), strict=True):
        yield (parts[0] if len(parts) == 1 else torch.cat(parts, -1)).to(shape.precision)


def _split(x: Tensor, size: int) -> Sequence[Tensor]:
    return x.split(size, 1) if x.shape[1] > size else (x,)


def _size(x: Tensor) -> int:
    return max(1, CACHED_ROWS // x.shape[0])


def _joined(outputs: list[Tensor]) -> Tensor:
    if len(outputs) == 1:
        return outputs[0].float()
    if outputs[0].stride(1) == 1:
        return torch.cat([y.transpose(1, 2) for y in outputs], 2).transpose(1, 2).float()
    return torch.cat(outputs, 1).float()


def _run(shape: Shape, x: Tensor, parameters: Sequence[Tensor]) -> list[Tensor]:
    run, last = [x], len(parameters) // 2 - 1
    for k in range(last + 1):
        weight, bias = parameters[2 * k], parameters[2 * k + 1]
        if k < last or shape.activate_output:
            run.append(_hidden(bias, run[-1], weight, shape.activation))
        else:
            run.append(affine(bias, run[-1], weight, rows_innermost=shape.rows_innermost))
    return run


class _Pass:
    """A pass through a perceptron that keeps its activations where there will be a backward; see `perceptron`."""

    def __init__(self, shape: Shape, inputs: Sequence[Tensor], parameters: Sequence[Tensor], keep: bool) -> None:
        if shape.precision != torch.float32:
            parameters = [p.to(shape.precision) for p in parameters]
        inputs = [x.flatten(1, -2) for x in inputs]
        self._shape, self._size, self._weights = shape, _size(inputs[0]), parameters[::2]
        runs = (_run(shape, piece, parameters) for piece in _pieces(shape, inputs))
        self._runs = list(runs) if keep else [run[-1:] for run in runs]
        self._widths = [x.shape[-1] for x in inputs]
        self.outputs = _joined([run[-1] for run in self._runs])

    def backward(self, grad: Tensor) -> list[Tensor]:
        with torch.no_grad():
            grads, _ = self.backward_to(grad, [True] * (2 * len(self._weights)), [])
        return [g for g in grads if g is not None]

    def backward_to(
        self, grad: Tensor, learns: Sequence[bool], asked: Sequence[bool]
    ) -> tuple[list[Tensor | None], list[Tensor | None]]:
        """Return the gradients by the parameters that learn and by the inputs that ask; None for the others."""
        weights, shape = self._weights, self._shape
        grads: list[Tensor | None] = [None] * (2 * len(weights))
        below: list[list[Tensor]] = [[] for _ in asked]
        columns = list(zip(asked, pairwise(accumulate(self._widths, initial=0)), below, strict=False))
        for run, upper in zip(self._runs, _split(grad.to(shape.precision), self._size), strict=True):
            here = _backward(shape, run, upper, weights, learns, grads)
            for wanted, (begin, end), parts in columns:
                if wanted:
                    parts.append(_down(here, weights[0][:, begin:end]))
        if shape.precision != torch.float32:
            grads = [None if g is None else g.float() for g in grads]
        return grads, [torch.cat(parts, 1).float() if parts else None for parts in below]


class _Passed(Function):
    @staticmethod
    def forward(ctx, make, num_inputs, *tensors):  # type: ignore[no-untyped-def]
        ctx.num_inputs, ctx.run = num_inputs, make(tensors[:num_inputs], tensors[num_inputs:], keep=True)
        ctx.save_for_backward(*tensors)  # so that autograd notices a change of them
        outputs = ctx.run.outputs  # which would hold, by their grad_fn, what holds them
        return outputs.detach() if isinstance(outputs, Tensor) else tuple(x.detach() for x in outputs)

    @staticmethod
    def backward(ctx, grad, *further):  # type: ignore[no-untyped-def]
        inputs, first = ctx.saved_tensors[: ctx.num_inputs], 2 + ctx.num_inputs
        learns, asked = ctx.needs_input_grad[first:], ctx.needs_input_grad[2:first]
        grads, below = ctx.run.backward_to(grad, learns, asked, *further)
        below = [None if by_x is None else by_x.view(x.shape) for by_x, x in zip(below, inputs, strict=True)]
        return None, None, *below, *grads


def _backward(
    shape: Shape,
    run: Sequence[Tensor],
    here: Tensor,
    weights: Sequence[Tensor],
    learns: Sequence[bool],
    grads: list[Tensor | None],
) -> Tensor:
    """Return the gradient by what the first layer gives before its activation, and add those by the parameters.

    `run` holds the inputs of every layer, and the output where it is activated; `here` is the gradient by the output.
    Parameters that do not learn, as where a critic only passes a gradient on to the actor, get none.
    """
    if shape.activate_output:
        here = _activation_backward(here.clone(), run[-1], shape.activation)
    for k in reversed(range(len(weights))):
        if learns[2 * k]:
            grads[2 * k] = _outer(run[k], here, grads[2 * k])
        if learns[2 * k + 1]:
            grads[2 * k + 1] = _added(here.sum(1, keepdim=True), grads[2 * k + 1])
        if k > 0:
            here = _activation_backward(_down(here, weights[k]), run[k], shape.activation)
    return here


# A single output is a sum of products: for one seed and one column torch would take a matrix-vector routine, which
# rounds otherwise than the batched product that several seeds take.


def affine(bias: Tensor, x: Tensor, weight: Tensor, scale: float = 1.0, rows_innermost: bool = False) -> Tensor:
    """Return scale (x W + b) [S, B, out]; for a thin output as the transpose of W' x' + b', so with B innermost."""
    if weight.shape[-1] == 1:
        return (x * weight.transpose(1, 2)).sum(2, keepdim=True).add_(bias).mul_(scale)
    if weight.shape[-1] >= THIN and not rows_innermost:
        return torch.baddbmm(bias, x, weight, beta=scale, alpha=scale)
    bias, weight = bias.transpose(1, 2), weight.transpose(1, 2)
    return torch.baddbmm(bias, weight, x.transpose(1, 2), beta=scale, alpha=scale).transpose(1, 2)


def _down(grad: Tensor, weight: Tensor) -> Tensor:
    """Return grad W', the gradient by what a layer reads."""
    across = weight.transpose(1, 2)
    return grad * across if weight.shape[-1] == 1 else torch.bmm(grad, across)


def _hidden(bias: Tensor, x: Tensor, weight: Tensor, activation: str) -> Tensor:
    if activation == "relu" or x.dtype == torch.bfloat16:
        return activate_(affine(bias, x, weight), activation)
    return _tanh_from_sigmoid_(affine(bias, x, weight, 2.0).sigmoid_())


def _outer(x: Tensor, grad: Tensor, more: Tensor | None = None) -> Tensor:
    """Return x' grad, the gradient [S, in, out] of a weight, added to `more`."""
    if grad.shape[-1] >= THIN:
        rows = x.transpose(1, 2)
        return torch.bmm(rows, grad) if more is None else more.baddbmm_(rows, grad)
    if grad.shape[-1] == 1:
        return _added((x * grad).sum(1, keepdim=True).transpose(1, 2), more)
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
