"""A policy as plain arrays: the layers, memory and head of one seed's greedy policy, which every export is made from.

A program maps a row of observation, and of memory where it has one, to outputs, an action and the next memory:

    x = [observation, previous action]     the latter for recurrent policies of off-policy learners alone
    x = layer(x) for each layer            affine x W + b, activation, layer normalisation, gated recurrent unit;
                                           for pictures a slice, convolutions, global max pooling, message aggregation
    action = argmax(x)                     head `choose`, among the allowed actions where the task has masks; or
    action = u tanh|u| / |u|               head `squash`, for each group u of x: a planar vector, or a single number

The memory is [hidden state of the unit, previous action], the latter one-hot where it is a choice. Of a team, whose
agents exchange messages, the rows of a world's agents are adjacent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from esp_cli.export.layers import Layer, describe


@dataclass(frozen=True)
class Program:
    """One greedy policy.

    Attributes:
        num_inputs: D, numbers of an observation.
        layers: in their order.
        num_outputs: numbers of the last layer.
        hidden: H, numbers of the hidden state; 0 for a policy that remembers nothing.
        previous: numbers of the previous action in the memory.
        head: how the outputs become an action.
        groups: widths of what is squashed together; empty where the head chooses.
        team: agents that act together, with their rows side by side; 1 where each acts by itself.
        masked: whether a mask of the allowed actions [A] comes with every observation; one that allows none allows all.
    """

    num_inputs: int
    layers: tuple[Layer, ...]
    num_outputs: int
    hidden: int
    previous: int
    head: Literal["choose", "squash"]
    groups: tuple[int, ...]
    team: int = 1
    masked: bool = False

    @property
    def memory_width(self) -> int:
        """Numbers that it carries from step to step."""
        return self.hidden + self.previous

    @property
    def weights(self) -> bytes:
        """Every array of every layer, one after the other, as little-endian float32."""
        return b"".join(array.astype("<f4").tobytes() for layer in self.layers for array in layer.arrays)

    @property
    def num_parameters(self) -> int:
        """Learned numbers."""
        return len(self.weights) // 4

    @property
    def flops(self) -> int:
        """Operations for one action: each addition, multiplication, comparison or call of tanh, exp or sqrt is one."""
        own = self.num_outputs if self.head == "choose" else 5 * self.num_outputs
        return sum(layer.flops for layer in self.layers) + own

    def describe(self) -> dict[str, object]:
        """Return the program without its weights, as JSON stores it."""
        return {
            "num_inputs": self.num_inputs,
            "num_outputs": self.num_outputs,
            "hidden": self.hidden,
            "previous": self.previous,
            "head": self.head,
            "groups": list(self.groups),
            "team": self.team,
            "masked": self.masked,
            "layers": [describe(layer) for layer in self.layers],
        }
