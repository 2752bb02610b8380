"""The losses of values with their slopes, compiled into a perceptron's pass; see `algorithms.objectives.value_loss`."""

from __future__ import annotations

import ctypes
from typing import NamedTuple

from torch import Tensor

from esp_cli.networks.kernels.library import fields
from esp_cli.networks.kernels.perceptron import LearningPass


class _Regression(ctypes.Structure):
    _fields_ = (
        *fields(ctypes.c_int64, "learned"),
        *fields(ctypes.c_float, "delta", "weight", "gap_weight"),
        ("target", ctypes.c_void_p),
    )


class Regression(NamedTuple):
    """Huber losses of values of the first parts of rows, and squared gaps between each copy and the original."""

    target: Tensor  # [S, 1, R]
    learned: int  # L
    delta: float
    weight: float
    gap_weight: float = 0.0

    def learn(self, run: LearningPass) -> Tensor:
        """Return the gradients [S, P] by the parameters of a perceptron whose only output are the values."""
        target, numbers = self.target.contiguous(), (self.delta, self.weight, self.gap_weight)
        return run.learn("perceptron", "learn_values", _Regression(self.learned, *numbers, target.data_ptr()))
