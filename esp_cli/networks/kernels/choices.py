"""Choices among actions with the slopes of what losses are made of, compiled; see `networks.policies`."""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import torch
from torch import Tensor

from esp_cli.networks.kernels.library import call, fields


class _Choices(ctypes.Structure):
    _fields_ = (
        *fields(ctypes.c_int64, "seeds", "parts", "rows", "actions", "threads", "by_seed", "by_row", "by_action"),
        *fields(ctypes.c_void_p, "orders", "outputs", "log_prob", "prob", "entropy", "gap"),
    )


class _Slope(ctypes.Structure):
    _fields_ = (
        *fields(ctypes.c_int64, "learned", "moves_copies", "moves_originals"),
        *fields(ctypes.c_float, "entropy_weight", "gap_weight"),
        *fields(ctypes.c_void_p, "action", "by_log_prob", "entropy_weights", "gap_weights"),
    )


class Slope(NamedTuple):
    """What losses add to the slope by the outputs."""

    # actions of S R rows, the slope by their log-probabilities [S, L, R] and that by entropies, a number or [S, 1, R]
    chosen: tuple[Tensor, Tensor, Tensor | float] | None = None
    gaps: tuple[Tensor | float, str] | None = None  # weights, a number or [S, 1, R], and which side is held fixed


class CompiledChoices:
    """Softmax of outputs [S, P R, A] of P parts, each reordered to the originals' actions.

    Args:
        outputs: of the network, in any layout.
        orders: [S, P, A] int64, which output of a part is the original's action.

    Attributes:
        log_probs, probs: [S, A, P, R].
        entropies, gaps: [S, P, R]; a gap is KL[part || original].
    """

    def __init__(self, outputs: Tensor, orders: Tensor) -> None:
        num_seeds, num_parts, num_actions = orders.shape
        num_rows = outputs.shape[1] // num_parts
        self._outputs, self._orders = outputs, orders.contiguous()
        numbers = outputs.new_empty(2, num_seeds, num_actions, num_parts, num_rows)
        self.log_probs, self.probs = numbers.unbind(0)
        self.entropies, self.gaps = outputs.new_empty(2, num_seeds, num_parts, num_rows).unbind(0)
        kept = (self._orders, outputs, self.log_probs, self.probs, self.entropies, self.gaps)
        sizes = (num_seeds, num_parts, num_rows, num_actions, torch.get_num_threads())
        self._arguments = _Choices(*sizes, *outputs.stride(), *(x.data_ptr() for x in kept))
        call("choices", "choose", self._arguments)

    def back(self, slope: Slope) -> Tensor:
        """Return the slope by the outputs, laid out as they are."""
        by_outputs = torch.empty_like(self._outputs)
        if by_outputs.stride() != self._outputs.stride():
            by_outputs = torch.empty_strided(self._outputs.shape, self._outputs.stride())
        asked, kept = _Slope(), list[Tensor]()

        def data(x: Tensor) -> int:
            kept.append(x.contiguous())
            return kept[-1].data_ptr()

        def weight(x: Tensor | float) -> tuple[float, int | None]:
            return (0.0, data(x)) if isinstance(x, Tensor) else (x, None)

        if slope.chosen is not None:
            action, by_log_prob, by_entropy = slope.chosen
            asked.learned, asked.action, asked.by_log_prob = by_log_prob.shape[1], data(action), data(by_log_prob)
            asked.entropy_weight, asked.entropy_weights = weight(by_entropy)
        if slope.gaps is not None:
            weights, fixed = slope.gaps
            asked.gap_weight, asked.gap_weights = weight(weights)
            asked.moves_copies, asked.moves_originals = fixed != "transformed", fixed != "original"
        call("choices", "choose_backward", self._arguments, asked, by_outputs)
        return by_outputs
