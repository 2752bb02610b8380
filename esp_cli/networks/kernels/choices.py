"""Choices among actions with the slopes of what losses are made of, compiled; see `networks.policies`."""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import torch
from torch import Tensor

from esp_cli.networks.kernels.library import call, fields
from esp_cli.networks.kernels.perceptron import LearningPass


class _Choices(ctypes.Structure):
    _fields_ = (
        *fields(ctypes.c_int64, "seeds", "parts", "rows", "actions", "threads"),
        *fields(ctypes.c_int64, "by_seed", "by_part", "by_row", "by_action"),
        *fields(ctypes.c_void_p, "orders", "outputs"),
    )


class _Slope(ctypes.Structure):
    _fields_ = (
        *fields(ctypes.c_int64, "learned", "moves", "old_parts"),
        *fields(ctypes.c_float, "entropy_weight", "gap_weight", "clip", "clip_weight"),
        *fields(ctypes.c_void_p, "action", "entropy_weights", "gap_weights", "old", "advantage", "clip_weights"),
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


class Slope(NamedTuple):
    """What losses add to the slope by the outputs."""

    clipped: Clipped | None = None
    gaps: Tensor | float | None = None  # weights, a number or [S, 1, R]

    def asked(self) -> _Slope:
        """Return what the kernel is asked for; it keeps the tensors that it points at."""
        asked, kept = _Slope(), list[Tensor]()

        def data(x: Tensor) -> int:
            kept.append(x.contiguous())
            return kept[-1].data_ptr()

        def weight(x: Tensor | float) -> tuple[float, int | None]:
            return (0.0, data(x)) if isinstance(x, Tensor) else (x, None)

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
        (num_seeds, num_parts, num_actions), num_rows = orders.shape, run.num_rows
        sizes = (num_seeds, num_parts, num_rows, num_actions)
        return run.learn("choices", "learn_choices", _Choices(*sizes, orders=orders.data_ptr()), self.asked())

    def back(self, outputs: Tensor, orders: Tensor) -> Tensor:
        """Return the slope by outputs, laid out as they are.

        The outputs [S, P R, A] are of P parts, the originals and copies, whose actions contiguous int64 orders [S, P,
        A] bring to those of the originals.
        """
        by_outputs = torch.empty_like(outputs)
        if by_outputs.stride() != outputs.stride():
            by_outputs = torch.empty_strided(outputs.shape, outputs.stride())
        (num_seeds, num_parts, num_actions), (by_seed, by_row, by_action) = orders.shape, outputs.stride()
        num_rows = outputs.shape[1] // num_parts
        sizes = (num_seeds, num_parts, num_rows, num_actions, torch.get_num_threads())
        steps = (by_seed, by_row * num_rows, by_row, by_action)
        choices = _Choices(*sizes, *steps, orders.data_ptr(), outputs.data_ptr())
        call("choices", "choose_backward", choices, self.asked(), by_outputs)
        return by_outputs
