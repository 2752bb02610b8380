"""Losses as weighted sums of equations on what networks output."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from esp_cli.prior.seed_batch import average


class Stated(NamedTuple):
    """An equation, evaluated.

    Attributes:
        elements: [S, P, R], whose mean it is; or a number per seed [S], or one [].
        share: of each element in the mean of its seed; see `shares`. None for a number.
        slope: that of the terms before, or None, with its own times its weight added.
    """

    elements: Tensor
    share: Tensor | float | None
    slope: Any


Equation = Callable[[Any, float, Any], Stated]
"""(outputs, weight, slope of the terms before or None) -> what is stated."""


class Term(NamedTuple):
    """An equation on some outputs.

    Attributes:
        on: see `Loss`.
        weight: in the sum.
        equation: see `Equation`.
    """

    on: Any
    weight: float
    equation: Equation


class Loss:
    """A loss per seed, a weighted sum of equations; losses add up, also with tensors that autograd knows.

    An equation gives its value and its slope by what a network outputs; the tests compare the slopes with autograd.
    `gradients` sums the slopes by outputs, and the VJP of each network takes its sum back to the weights. With a graph
    of the equations themselves an update takes up to twice as long.

    What equations are on has a method `back`, which turns the sum of slopes into (tensor, slope) pairs for autograd.

    Example:
        >>> x = torch.tensor([[3.0]], requires_grad=True)
        >>> (2 * Loss.of(x.square().sum(1))).gradients([x])[0][1]
        [tensor([[12.]])]
    """

    def __init__(self, *terms: Term) -> None:
        self.terms = terms

    @classmethod
    def of(cls, loss: Tensor) -> Loss:
        """Return the loss of a tensor [S] or [] that autograd knows; what it does not know is a constant."""
        return cls(Term(OfGraph(loss), 1.0, _itself))

    def __add__(self, other: Loss | Tensor) -> Loss:
        """Return the sum with another loss."""
        return Loss(*self.terms, *(other if isinstance(other, Loss) else Loss.of(other)).terms)

    __radd__ = __add__

    def __mul__(self, weight: float) -> Loss:
        """Return the loss times a number."""
        return Loss(*(Term(on, weight * before, equation) for on, before, equation in self.terms))

    __rmul__ = __mul__

    @property
    def value(self) -> Tensor:
        """[S], or [] where nothing depends on the seed."""
        stated, _ = self._evaluate()
        return sum((w * (x if share is None else average(x, share)) for w, x, share in stated), start=torch.zeros(()))

    def gradients(self, parameters: Sequence[Tensor]) -> list[tuple[Sequence[Tensor], list[Tensor]]]:
        """Return parameters and the gradients by them of each seed's own loss; the same parameters may come again.

        Gradients [S, ...] are those by each parameter, or one [S, P] by all side by side.

        Args:
            parameters: that are learned, for what autograd takes back.
        """
        found: list[tuple[Sequence[Tensor], list[Tensor]]] = []
        graphs: list[Tensor] = []
        for root, slope in self._evaluate()[1]:
            if not isinstance(root, OfGraph):
                found.append((root.parameters, root.vjp(slope)))
            elif root.graph.requires_grad:
                graphs.append(with_slope(root.graph, slope))
        if graphs:
            by = torch.autograd.grad(
                sum(graphs[1:], start=graphs[0]), parameters, allow_unused=True, materialize_grads=True
            )
            found.append((parameters, [*by]))
        return found

    @torch.no_grad()
    def _evaluate(self) -> tuple[list[tuple[float, Tensor, Tensor | float | None]], list[tuple[Any, Tensor]]]:
        """Return weights, elements and shares of all equations, and what networks returned with the slopes by it."""
        stated, sums = [], dict[int, tuple[Any, Any]]()
        for on, weight, equation in self.terms:
            _, before = sums.get(id(on), (on, None))
            elements, share, slope = equation(on, weight, before)
            sums[id(on)] = (on, slope)
            stated.append((weight, elements, share))
        return stated, [root for on, slope in sums.values() for root in on.back(slope)]


class OfGraph:
    """What a network returned under autograd.

    Attributes:
        tensor: without the graph.
        graph: with it.
    """

    def __init__(self, graph: Tensor) -> None:
        self.tensor, self.graph = graph.detach(), graph

    def back(self, slope: Tensor) -> list[tuple[OfGraph, Tensor]]:
        """Return the slope by itself."""
        return [(self, slope)]


def with_slope(x: Tensor, slope: Tensor) -> Tensor:
    """Return a number whose gradient by x is the slope."""
    return _WithSlope.apply(x, slope)  # type: ignore[no-untyped-call]


class _WithSlope(Function):
    """Starts autograd at a slope; given gradients of vectors, torch imports sympy, which takes a second."""

    @staticmethod
    def forward(ctx, x, slope):  # type: ignore[no-untyped-def]
        ctx.slope = slope
        return x.new_zeros(())

    @staticmethod
    def backward(ctx, _):  # type: ignore[no-untyped-def]
        return ctx.slope, None


def _itself(on: OfGraph, weight: float, slope: Tensor | None) -> Stated:
    own = torch.full_like(on.tensor, weight)
    return Stated(on.tensor, None, own if slope is None else slope + own)
