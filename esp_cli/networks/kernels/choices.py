"""Choices among actions with the slopes of what losses are made of, compiled; see `networks.policies`."""

from __future__ import annotations

import ctypes
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from esp_cli.networks.kernels.library import call, fields
from esp_cli.networks.kernels.perceptron import LearningPass


class _Choices(ctypes.Structure):
    _fields_ = (
        *fields(ctypes.c_int64, "seeds", "parts", "rows", "actions", "threads"),
        *fields(ctypes.c_int64, "by_seed", "by_part", "by_row", "by_action"),
        *fields(ctypes.c_void_p, "orders", "outputs", "log_prob", "prob", "entropy", "gap"),
    )


class _Slope(ctypes.Structure):
    _fields_ = (
        *fields(ctypes.c_int64, "learned", "moves", "old_parts"),
        *fields(ctypes.c_float, "entropy_weight", "gap_weight", "clip", "clip_weight"),
        *fields(ctypes.c_void_p, "action", "by_log_prob", "entropy_weights", "gap_weights"),
        *fields(ctypes.c_void_p, "old", "advantage", "clip_weights"),
    )


class Clipped(NamedTuple):
    """A clipped objective and an entropy; see `algorithms.objectives.ppo_loss`."""

    action: Tensor  # of S R rows
    learned: int  # L
    old_log_prob: Tensor  # [S, 1 or L, R]
    advantage: Tensor  # [S, 1, R]
    epsilon: float
    weight: Tensor | float  # of the objective, a number or [S, 1, R]
    entropy_weight: Tensor | float


class Numbers(NamedTuple):
    """What is known of policies; the gap of a part is KL[part || original]."""

    log_probs: Tensor  # [S, A, P, R]
    probs: Tensor
    entropies: Tensor  # [S, P, R]
    gaps: Tensor


class Slope(NamedTuple):
    """What losses add to the slope by the outputs."""

    # actions of S R rows, the slope by their log-probabilities [S, L, R] and that by entropies, a number or [S, 1, R]
    chosen: tuple[Tensor, Tensor, Tensor | float] | None = None
    clipped: Clipped | None = None  # instead of `chosen`
    gaps: Tensor | float | None = None  # weights, a number or [S, 1, R]

    def asked(self) -> _Slope:
        """Return what the kernel is asked for; it keeps the tensors that it points at."""
        asked, kept = _Slope(), list[Tensor]()

        def data(x: Tensor) -> int:
            kept.append(x.contiguous())
            return kept[-1].data_ptr()

        def weight(x: Tensor | float) -> tuple[float, int | None]:
            return (0.0, data(x)) if isinstance(x, Tensor) else (x, None)

        if self.chosen is not None:
            action, by_log_prob, by_entropy = self.chosen
            asked.learned, asked.action, asked.by_log_prob = by_log_prob.shape[1], data(action), data(by_log_prob)
            asked.entropy_weight, asked.entropy_weights = weight(by_entropy)
        if (clipped := self.clipped) is not None:
            asked.learned, asked.action, asked.clip = clipped.learned, data(clipped.action), clipped.epsilon
            asked.old_parts, asked.old = clipped.old_log_prob.shape[1], data(clipped.old_log_prob)
            asked.advantage = data(clipped.advantage)
            asked.clip_weight, asked.clip_weights = weight(clipped.weight)
            asked.entropy_weight, asked.entropy_weights = weight(clipped.entropy_weight)
        if self.gaps is not None:
            asked.gap_weight, asked.gap_weights = weight(self.gaps)
            asked.moves = True
        asked.kept = kept
        return asked

    def learn(self, run: LearningPass, orders: Tensor) -> Tensor:
        """Return the gradients [S, P] by the parameters of a perceptron whose outputs are choices; see there."""
        orders = orders.contiguous()
        (num_seeds, num_parts, num_actions), num_rows = orders.shape, run.num_rows
        sizes = (num_seeds, num_parts, num_rows, num_actions)
        return run.learn("choices", "learn_choices", _Choices(*sizes, orders=orders.data_ptr()), self.asked())


class CompiledChoices:
    """Softmax of outputs [S, P R, A] of P parts, reordered to the originals' actions by int64 orders [S, P, A]."""

    def __init__(self, outputs: Tensor, orders: Tensor) -> None:
        self._outputs, self._orders = outputs, orders.contiguous()
        num_seeds, num_parts, num_actions = orders.shape
        self._sizes = (num_seeds, num_parts, outputs.shape[1] // num_parts, num_actions, torch.get_num_threads())

    def _arguments(self, *numbers: Tensor) -> _Choices:
        kept = (self._orders, self._outputs, *numbers)
        by_seed, by_row, by_action = self._outputs.stride()
        steps = (by_seed, by_row * self._sizes[2], by_row, by_action)
        return _Choices(*self._sizes, *steps, *(x.data_ptr() for x in kept))

    @cached_property
    def numbers(self) -> Numbers:
        """What is known of them, computed when it is asked for."""
        num_seeds, num_parts, num_rows, num_actions, _ = self._sizes
        by_action = self._outputs.new_empty(2, num_seeds, num_actions, num_parts, num_rows)
        numbers = Numbers(*by_action, *self._outputs.new_empty(2, num_seeds, num_parts, num_rows))
        call("choices", "choose", self._arguments(*numbers))
        return numbers

    def back(self, slope: Slope) -> Tensor:
        """Return the slope by the outputs, laid out as they are."""
        by_outputs = torch.empty_like(self._outputs)
        if by_outputs.stride() != self._outputs.stride():
            by_outputs = torch.empty_strided(self._outputs.shape, self._outputs.stride())
        asked = slope.asked()
        call("choices", "choose_backward", self._arguments(), asked, by_outputs)
        return by_outputs
