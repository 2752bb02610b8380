"""Outputs for actions with parts, such as the two wheels of a robot: one output per value of each part."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from esp_cli.networks.contract import Network
from esp_envs.errors import UserError
from esp_envs.spec import ActionSpace, Discrete


def action_parts(space: ActionSpace) -> Tensor:
    """Return the 0/1 matrix [values of all parts, actions] of the part values that make up each action."""
    if isinstance(space, Discrete):
        columns = list(zip(*space.points, strict=True))
        values = [sorted(set(column)) for column in columns]
        if len(values) > 1 and math.prod(map(len, values)) == space.count:
            parts = [(column, value) for column, choices in zip(columns, values, strict=True) for value in choices]
            has = [[x == value for x in column] for column, value in parts]
            return torch.tensor(has, dtype=torch.float32)
    raise UserError(
        "network.separate_parts is for discrete actions that are all combinations of part values, "
        "such as pairs of wheel speeds; leave it off"
    )


class Separate(Network):
    """y_j = sum over the parts p of action j of f(x)_p: the values (or logits) of an action's parts add up to its own.

    Greedy parts make the greedy action, and a softmax of the sums is a product of one distribution per part. A
    permutation of the parts, such as a mirror that swaps the wheels, permutes the sums.
    """

    def __init__(self, network: Network, parts: Tensor) -> None:
        super().__init__()
        self.network = network
        self.memory_width = network.memory_width
        self.parts: Tensor
        self.register_buffer("parts", parts, False)

    def step(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        y, memory = self.network.step(x, memory)
        return y @ self.parts, memory

    def unroll(self, x: Tensor, truncation: int = 0) -> Tensor:
        return self.network.unroll(x, truncation) @ self.parts
