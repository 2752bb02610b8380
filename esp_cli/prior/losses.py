"""Losses as weighted sums of equations on what networks output, and the paper's consistency losses among them.

S_pi (Eq. 8), S_V (Eq. 9) and S_Q (supplement eq. 19) are stated once, element by element. Learners average them with
their slopes (`consistency_gap`); a foreign training loop gives them to autograd.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from math import prod
from typing import Any, NamedTuple

import torch
from torch import Tensor

from esp_cli.prior.seed_batch import average, shares
from esp_cli.symmetry.frame import Frame


class Stated(NamedTuple):
    """An equation, evaluated."""

    # computes, where somebody asks, [S, P, R], whose mean it is; or a number per seed [S], or one []
    elements: Callable[[], Tensor]
    share: Tensor | float | None  # of each element in the mean of its seed; see `shares`. None for a number.
    slope: Any  # that of the terms before, or None, with its own times its weight added


Equation = Callable[[Any, float, Any], Stated]  # (outputs, weight, slope of the terms before or None) -> what is stated


class Term(NamedTuple):
    """A weighted equation on some outputs; see `Loss`."""

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
    @torch.no_grad()
    def value(self) -> Tensor:
        """[S], or [] where nothing depends on the seed."""
        total = torch.zeros(())
        for weight, elements, share in self._evaluate()[0]:
            x = elements()
            total = total + weight * (x if share is None else average(x, share))
        return total

    def gradients(self, parameters: Sequence[Tensor]) -> list[tuple[Sequence[Tensor], list[Tensor]]]:
        """Return learned parameters, maybe again, and gradients of each seed's loss by each [S, ...] or all [S, P]."""
        found: list[tuple[Sequence[Tensor], list[Tensor]]] = []
        graphs: list[tuple[Tensor, Tensor]] = []
        with torch.no_grad():
            for root, slope in self._evaluate()[1]:
                if not isinstance(root, OfGraph):
                    found.append((root.parameters, root.vjp(slope)))
                elif root.graph.requires_grad:
                    graphs.append((root.graph, slope))
        if graphs:
            # a number: given slopes as gradients of vectors, torch imports sympy for a second
            totals = [(graph * slope).sum() for graph, slope in graphs]
            total = sum(totals[1:], start=totals[0])
            by = torch.autograd.grad(total, parameters, allow_unused=True, materialize_grads=True)
            found.append((parameters, [*by]))
        return found

    def _evaluate(self) -> tuple[list[tuple[float, Any, Tensor | float | None]], list[tuple[Any, Tensor]]]:
        stated, sums = [], dict[int, tuple[Any, Any]]()
        for on, weight, equation in self.terms:
            _, before = sums.get(id(on), (on, None))
            elements, share, slope = equation(on, weight, before)
            sums[id(on)] = (on, slope)
            stated.append((weight, elements, share))
        return stated, [root for on, slope in sums.values() for root in on.back(slope)]


class Values:
    """What a critic outputs for originals and copies, C numbers a row.

    A slope is by `rows`, or what a kernel is asked to compute together with them, where it `defers`: where the values
    are not computed yet, and need not be. `sizes` are S, P and R = B T C.
    """

    def __init__(self, values: Any, frame: Frame) -> None:
        self._values, self._frame = values, frame
        num_seeds, *rows, self.count = values.size
        self.defers = values.waits and values.parameters[-1].numel() == num_seeds and not frame.moves_agents
        self.sizes = (num_seeds, frame.parts, prod(rows) * self.count // frame.parts)

    @cached_property
    def rows(self) -> Tensor:
        """[S, P, R] in the frame."""
        return self._frame.pull_values(self._values.tensor).flatten(2)

    def divergence(self, copies: slice, originals: slice) -> Tensor:
        """Return S_V or S_Q of some parts."""
        return value_consistency_loss(self.rows[:, copies], self.rows[:, originals])

    def add_divergence_slope(self, slope: Any, weights: Tensor | float) -> Any:
        """Add the slope of the sum of divergences times weights."""
        if not (slope is None or isinstance(slope, Tensor)):
            return slope._replace(gap_weight=weights)
        slope = torch.zeros_like(self.rows) if slope is None else slope
        by_copies = (self.rows[:, 1:] - self.rows[:, :1]).mul_(2 * weights)
        slope[:, 1:].add_(by_copies)
        slope[:, :1].sub_(by_copies if by_copies.shape[1] == 1 else by_copies.sum(1, keepdim=True))
        return slope

    def back(self, slope: Any) -> list[tuple[Any, Any]]:
        if not isinstance(slope, Tensor):
            return [(self._values.learn(slope.learn, self.sizes[1]), slope)]
        rows = (self._values.size[1] // self.sizes[1], *self._values.size[2:])
        return [(self._values, self._frame.push_values(slope.unflatten(2, rows)))]


class OfGraph:
    """What a network returned under autograd: `graph`, and `tensor` without the graph."""

    waits = False

    def __init__(self, graph: Tensor) -> None:
        self.tensor, self.graph, self.size = graph.detach(), graph, graph.shape

    def back(self, slope: Tensor) -> list[tuple[OfGraph, Tensor]]:
        return [(self, slope)]


def _itself(on: OfGraph, weight: float, slope: Tensor | None) -> Stated:
    own = torch.full_like(on.tensor, weight)
    return Stated(lambda: on.tensor, None, own if slope is None else slope + own)


def value_consistency_loss(transformed: Tensor, original: Tensor) -> Tensor:
    """Return S_V = (V(s) - V(L_g s))^2 (Eq. 9) of values [S, B, C] in the critic's own (normalised) units."""
    return (original - transformed).square()


def consistency_gap(mask: Tensor | None) -> Equation:
    """Return the mean of S_pi, S_V or S_Q over copies and rows that count, as an equation on policies or on values."""

    def equation(on: Any, weight: float, slope: Any) -> Stated:
        num_seeds, num_parts, num_rows = on.sizes
        share = shares(mask, (num_seeds, num_parts - 1, num_rows))
        slope = on.add_divergence_slope(slope, weight * share)
        return Stated(lambda: on.divergence(slice(1, None), slice(0, 1)), share, slope)

    return equation
