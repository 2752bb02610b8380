"""On-policy experience shaped for gradient steps."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from esp_cli.prior import SeedBatch


@dataclass
class Batch(SeedBatch):
    """Experience ready for gradient steps: B sequences of tau steps (tau = 1 unless the network is recurrent).

    Shape:
        obs [S, B, tau, N, D], state [S, B, tau, state width], action [S, B, tau, N(, width)],
        log_prob and advantage [S, B, tau, N], target and value [S, B, tau, C] in normalised units.
    """

    per_agent = ("log_prob", "advantage", "target", "value")

    log_prob: Tensor
    advantage: Tensor
    target: Tensor
    value: Tensor
