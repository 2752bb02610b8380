"""Policies at originals and at copies of them, in one frame, with the slopes of what losses are made of.

Shape letters: S seeds, P parts (the originals and K copies of them), R rows of a part (B scenes, T steps, N agents), A
actions, W numbers of a continuous action. The first L parts are those that a learner's loss takes: all, or originals.
"""

from __future__ import annotations

import math
from functools import cached_property
from math import prod

import torch
from torch import Tensor

from esp_cli.networks.contract import WithVJP
from esp_cli.networks.kernels.choices import Clipped, Slope
from esp_cli.networks.perceptron import Deferred
from esp_cli.symmetry.frame import Frame
from esp_envs.errors import UserError

_HALF_LOG_TAU = 0.5 * math.log(2 * math.pi)

Weights = Tensor | float  # A number, or [S, 1, R]


class _Choices:
    """Choices among A actions with probabilities softmax(outputs), actions first; see `Categorical.normalise`."""

    def __init__(self, outputs: WithVJP, frame: Frame) -> None:
        self._outputs, self._frame = outputs, frame
        num_seeds, *rows, _ = outputs.size
        self.sizes = (num_seeds, frame.parts, prod(rows) // frame.parts)

    @cached_property
    def _places(self) -> Tensor | None:
        orders = self._frame.orders(self._outputs.size[-1]) if self._frame.parts > 1 else None
        return None if orders is None else _places(orders.expand(self.sizes[0], -1, -1))

    @cached_property
    def log_probs(self) -> Tensor:
        """[S, A, P, R]."""
        outputs, places = self._outputs.tensor, self._places
        if places is None:
            logits = self._frame.pull_outputs(outputs).movedim(-1, 1).flatten(3)
        else:
            by_action = outputs.flatten(1, -2).transpose(1, 2).unflatten(2, (self._frame.parts, -1))
            logits = by_action.reshape(-1, by_action.shape[3]).index_select(0, places).view(by_action.shape)
        return torch.log_softmax(logits, 1)

    @cached_property
    def probs(self) -> Tensor:
        return self.log_probs.exp()

    @cached_property
    def _inner(self) -> Tensor:
        return self.probs * self.log_probs

    def log_prob(self, action: Tensor, learned: int) -> Tensor:
        """Return log pi(action) [S, L, R] of the originals' actions [S, B, T, N(, W)]."""
        return self.log_probs.gather(1, _index(action, learned)).squeeze(1)

    def entropy(self, learned: int) -> Tensor:
        """Return the entropies [S, L, R]."""
        return self._inner[:, :, :learned].sum(1).neg_()

    def divergence(self, copies: slice, originals: slice) -> Tensor:
        """Return KL[copy || original] [S, K, R] of some parts."""
        return self._gap(copies, originals).sum(1)

    def _gap(self, copies: slice, originals: slice) -> Tensor:
        p, log_p, log_q = self.probs[:, :, copies], self.log_probs[:, :, copies], self.log_probs[:, :, originals]
        return p * (log_p - log_q)


class CategoricalPolicies(_Choices):
    """Choices by torch; a slope is by log-probabilities, up to a multiple of the probabilities, which softmax drops."""

    def add_slope(self, slope: Tensor | None, action: Tensor, by_log_prob: Tensor, by_entropy: Weights) -> Tensor:
        """Add the slope of what depends on log pi(action), by which it is [S, L, R], and on these entropies."""
        learned = by_log_prob.shape[1]
        if slope is None and learned == self.sizes[1]:
            slope = self._inner * -_beside(by_entropy)
        else:
            slope = torch.zeros_like(self.probs) if slope is None else slope
            slope[:, :, :learned].sub_(self._inner[:, :, :learned] * _beside(by_entropy))
        return slope.scatter_add_(1, _index(action, learned), by_log_prob.unsqueeze(1))

    def add_divergence_slope(self, slope: Tensor | None, weights: Weights) -> Tensor:
        """Add the slope of the sum of divergences times weights."""
        slope, weights = torch.zeros_like(self.probs) if slope is None else slope, _beside(weights)
        slope[:, :, 1:].add_(self._gap(slice(1, None), slice(1)).mul_(weights))
        by_original = self.probs[:, :, 1:] * weights
        slope[:, :, :1].sub_(by_original if by_original.shape[2] == 1 else by_original.sum(2, keepdim=True))
        return slope

    def back(self, slope: Tensor) -> list[tuple[WithVJP, Tensor]]:
        """Return what networks returned, and the slopes by it."""
        by_logits = torch._log_softmax_backward_data(slope, self.log_probs, 1, slope.dtype)
        rows = self._outputs.size[1:-1]
        if self._places is not None:
            moved = torch.empty_like(by_logits).view(-1, self.sizes[2])
            moved.index_copy_(0, self._places, by_logits.view(moved.shape))
            return [(self._outputs, moved.view(*by_logits.shape[:2], -1).transpose(1, 2).unflatten(1, rows))]
        by_logits = by_logits.unflatten(3, (rows[0] // self.sizes[1], *rows[1:])).movedim(1, -1)
        return [(self._outputs, self._frame.push_outputs(by_logits))]


class CompiledCategoricalPolicies(_Choices):
    """Choices whose slopes a kernel computes, of copies that only reorder outputs; a slope says what to ask of it."""

    def __init__(self, outputs: WithVJP, frame: Frame, orders: Tensor) -> None:
        super().__init__(outputs, frame)
        self._orders = orders.expand(self.sizes[0], -1, -1).contiguous()

    def add_clipped_slope(self, slope: Slope | None, clipped: Clipped) -> Slope:
        """Add the slope of a clipped objective and of entropies, one of each."""
        before = slope or Slope()
        if before.clipped is not None:
            raise UserError("a kernel takes one clipped objective of the same outputs; set network.compiled=false")
        return before._replace(clipped=clipped)

    def add_divergence_slope(self, slope: Slope | None, weights: Weights) -> Slope:
        before = slope or Slope()
        return before._replace(gaps=weights if before.gaps is None else before.gaps + weights)

    def back(self, slope: Slope) -> list[tuple[WithVJP, Tensor]]:
        outputs = self._outputs
        if isinstance(outputs, Deferred) and outputs.waits:
            return [(outputs.learn(lambda run: slope.learn(run, self._orders), self.sizes[1]), self._orders)]
        by_outputs = slope.back(outputs.tensor.flatten(1, -2), self._orders)
        return [(outputs, by_outputs.unflatten(1, outputs.size[1:-1]))]


def _places(orders: Tensor) -> Tensor:
    """Return where, among rows [S A P] of outputs, those of the originals' actions are that orders [S, P, A] give."""
    num_seeds, num_parts, num_actions = orders.shape
    rows = torch.arange(orders.numel(), device=orders.device).view(num_seeds, num_actions, num_parts)
    return rows.gather(1, orders.transpose(1, 2)).flatten()


def _index(action: Tensor, learned: int) -> Tensor:
    """Return actions [S, B, T, N] as the index [S, 1, L, R]."""
    return action.reshape(len(action), 1, 1, -1).expand(-1, -1, learned, -1)


def _beside(weights: Weights) -> Weights:
    return weights.unsqueeze(1) if isinstance(weights, Tensor) else weights


class GaussianPolicies:
    """Gaussians whose means are the outputs, with one log deviation of each item for all rows.

    An item moved by a copy has the deviation of its new place. Slopes are by means [S, P, R, W] and deviations [S,
    items].
    """

    def __init__(self, outputs: WithVJP, frame: Frame, log_std: Tensor, item: Tensor) -> None:
        self._outputs, self._frame = outputs, frame
        self._deviation = WithVJP(log_std, lambda slope: [slope], [log_std])
        means, items = frame.pull_outputs(outputs.tensor), frame.pull_items(item, outputs.tensor)
        self._shape, self._means = means.shape, means.flatten(2, -2)
        self._shares_items = items is None  # all parts have their items in the same places
        # [S, P, R, W], or [S, 1, 1, W]
        self._item = item.expand(len(log_std), 1, 1, -1) if items is None else items.flatten(2, -2)
        self._log_std = log_std.detach().gather(1, self._item.flatten(1)).view(self._item.shape)
        self._precision, self.sizes = (-self._log_std).exp(), tuple(self._means.shape[:3])

    def log_prob(self, action: Tensor, learned: int) -> Tensor:
        square = self._standardised(action, learned).square()
        return -(0.5 * square + self._log_std[:, :learned] + _HALF_LOG_TAU).sum(-1)

    def entropy(self, learned: int) -> Tensor:
        entropy = (self._log_std[:, :learned] + (0.5 + _HALF_LOG_TAU)).sum(-1)
        return entropy.expand(self._means[:, :learned].shape[:-1])

    def divergence(self, copies: slice, originals: slice) -> Tensor:
        gap, log_ratio = self._gap(copies, originals)
        return 0.5 * (gap.square() + (log_ratio.exp() - 1 - log_ratio)).sum(-1)

    def _gap(self, copies: slice, originals: slice) -> tuple[Tensor, Tensor]:
        """Return how far the means lie apart, in deviations of the originals, and the log ratio of the variances."""
        gap = (self._means[:, copies] - self._means[:, originals]) * self._of(self._precision, originals)
        return gap, 2 * (self._of(self._log_std, copies) - self._of(self._log_std, originals))

    def add_slope(
        self, slope: tuple[Tensor, Tensor] | None, action: Tensor, by_log_prob: Tensor, by_entropy: Weights
    ) -> tuple[Tensor, Tensor]:
        by_means, by_log_std = slope or self._no_slope()
        learned, above = by_log_prob.shape[1], by_log_prob.unsqueeze(-1)
        z = self._standardised(action, learned)
        entropies = (torch.zeros_like(by_log_prob) + by_entropy).unsqueeze(-1)
        self._add_by_items(by_log_std, (z.square() - 1).mul_(above).add_(entropies), slice(learned))
        by_means[:, :learned].add_(z.mul_(self._precision[:, :learned]).mul_(above))
        return by_means, by_log_std

    def add_divergence_slope(self, slope: tuple[Tensor, Tensor] | None, weights: Weights) -> tuple[Tensor, Tensor]:
        by_means, by_log_std = slope or self._no_slope()
        weights = weights.unsqueeze(-1) if isinstance(weights, Tensor) else weights
        gap, log_ratio = self._gap(slice(1, None), slice(1))
        weighted, excess = gap * weights, (log_ratio.exp() - 1) * weights
        self._add_by_items(by_log_std, -(weighted * gap) - excess, slice(1))
        if len(self._item[0]) > 1:
            self._add_by_items(by_log_std, excess, slice(1, None))
        weighted.mul_(self._of(self._precision, slice(1)))
        by_means[:, 1:].add_(weighted)
        by_means[:, :1].sub_(weighted.sum(1, keepdim=True))
        return by_means, by_log_std

    def back(self, slope: tuple[Tensor, Tensor]) -> list[tuple[WithVJP, Tensor]]:
        by_means, by_log_std = slope
        by_outputs = self._frame.push_outputs(by_means.unflatten(2, self._shape[2:-1]))
        return [(self._outputs, by_outputs), (self._deviation, by_log_std)]

    def _standardised(self, action: Tensor, learned: int) -> Tensor:
        return (action.flatten(1, -2).unsqueeze(1) - self._means[:, :learned]) * self._precision[:, :learned]

    def _no_slope(self) -> tuple[Tensor, Tensor]:
        return torch.zeros_like(self._means), torch.zeros_like(self._deviation.tensor)

    def _of(self, x: Tensor, parts: slice) -> Tensor:
        return x if len(x[0]) == 1 else x[:, parts]

    def _add_by_items(self, total: Tensor, slopes: Tensor, parts: slice) -> None:
        """Add slopes by the deviations of some parts [S, P, R, W] to those by the items [S, items]."""
        item = self._of(self._item, parts)
        slopes = slopes.sum((1, 2), keepdim=True) if self._shares_items else slopes
        total.scatter_add_(1, item.expand_as(slopes).flatten(1), slopes.flatten(1))


Policies = CategoricalPolicies | CompiledCategoricalPolicies | GaussianPolicies
