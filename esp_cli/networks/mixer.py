"""QMIX's mixer: a value of the team that never falls when an agent's own value rises."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import elu

from esp_cli.networks.layers import SeedMLP


class MonotonicMixer(nn.Module):
    """Q_tot = w_2(s)' elu(W_1(s)' q + b_1(s)) + b_2(s) with w, W >= 0 (Rashid et al., 2018), for S seeds.

    One hypernetwork reads the state and gives all weights and biases; absolute values make the weights non-negative.

    Args:
        generators: one per seed; they draw the initial weights.
        num_agents: N.
        state_width: width of what the hypernetwork sees.
        width: M, hidden units of the mixer.
        hidden: hidden units of the hypernetwork.
    """

    def __init__(
        self, generators: Sequence[torch.Generator], num_agents: int, state_width: int, width: int, hidden: int
    ) -> None:
        super().__init__()
        self.num_agents, self.width = num_agents, width
        outputs = num_agents * width + 2 * width + 1
        self.hypernetwork = SeedMLP(generators, (state_width, hidden, outputs), "relu", HYPER_GAIN)

    def forward(self, values: Tensor, state: Tensor) -> Tensor:
        """Mix the agents' values.

        Shape:
            values [S, ..., N], state [S, ..., state width] -> [S, ...].
        """
        num_seeds, lead = values.shape[0], values.shape[:-1]
        rows = self.hypernetwork(state.reshape(num_seeds, -1, state.shape[-1]))
        first, bias, second, offset = rows.split((self.num_agents * self.width, self.width, self.width, 1), -1)
        weights = first.abs().unflatten(-1, (self.num_agents, self.width))
        own = values.reshape(num_seeds, -1, self.num_agents)
        hidden = elu((own.unsqueeze(-1) * weights).sum(-2) + bias)
        return ((hidden * second.abs()).sum(-1) + offset.squeeze(-1)).view(lead)


HYPER_GAIN = 0.5
"""Orthogonal gain of the hypernetwork's last layer."""
