"""A policy as plain arrays: the layers, memory and head of one seed's greedy policy, which every export is made from.

A program maps a row of observation, and of memory where it has one, to outputs, an action and the next memory:

    x = [observation, previous action]     the latter for recurrent policies of off-policy learners alone
    x = layer(x) for each layer
    action = argmax(x)                     head `choose`, among the allowed actions where the task has masks; or
    action = u tanh|u| / |u|               head `squash`, for each group u of x: a planar vector, or a single number

The memory is [hidden state of the unit, previous action], the latter one-hot where it is a choice. Of a team, whose
agents exchange messages, the rows of a world's agents are adjacent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

NORM_EPSILON = 1e-5
"""Layer normalisation adds this to the variance (torch's default)."""
SQUASH_EPSILON = 1e-18
"""Squashing adds this to the squared length (`esp_cli.networks.heads.squash`)."""


class Layer:
    """One step of a program.

    Attributes:
        kind: its name in JSON.
    """

    kind: str

    @property
    def arrays(self) -> tuple[Floats, ...]:
        """The learned arrays, in the order in which exports store them."""
        return ()

    @property
    def flops(self) -> int:
        """Operations for one row: each addition, multiplication, comparison or call of tanh, exp or sqrt is one."""
        return 0

    def describe(self) -> dict[str, object]:
        """Return the layer as JSON stores it: without its weights, but with their shapes."""
        numbers = {name: value for name, value in vars(self).items() if not isinstance(value, np.ndarray | Layer)}
        return {"kind": self.kind, **numbers, "shapes": [list(array.shape) for array in self.arrays]}


@dataclass(frozen=True)
class Learned(Layer):
    """A layer with a weight and a bias."""

    weight: Floats
    bias: Floats

    @property
    def arrays(self) -> tuple[Floats, ...]:
        """Weight and bias."""
        return self.weight, self.bias

    @property
    def inputs(self) -> int:
        """Rows of the weight."""
        return len(self.weight)

    @property
    def outputs(self) -> int:
        """Numbers of the bias."""
        return self.bias.size


class Affine(Learned):
    """x W + b with W [in, out] and b [out]."""

    kind = "affine"

    @property
    def flops(self) -> int:
        """A multiplication and an addition for each weight."""
        return 2 * self.weight.size


class Norm(Learned):
    """(x - mean) / sqrt(variance + 1e-5) * weight + bias over a row."""

    kind = "norm"

    @property
    def flops(self) -> int:
        """Sums for mean and variance (1 + 3 a number), then four operations a number."""
        return 8 * self.weight.size


@dataclass(frozen=True)
class Activation(Layer):
    """Relu or tanh of every number of a row `width` wide."""

    kind: Literal["relu", "tanh"]
    width: int

    @property
    def flops(self) -> int:
        """One a number."""
        return self.width


@dataclass(frozen=True)
class Recurrent(Layer):
    """A gated recurrent unit of H numbers: r, z = s(p + q); n = tanh(p + r q); h' = n + z (h - n).

    p = x W + b and q = h U + c, each in the order r, z, n.
    """

    input: Affine
    recurrent: Affine
    kind = "gru"

    @property
    def hidden(self) -> int:
        """H."""
        return self.recurrent.inputs

    @property
    def arrays(self) -> tuple[Floats, ...]:
        """W, b, U and c."""
        return (*self.input.arrays, *self.recurrent.arrays)

    @property
    def flops(self) -> int:
        """Both products; per number two sigmoids (four operations each, sums included), tanh and the interpolation."""
        return self.input.flops + self.recurrent.flops + 14 * self.hidden


@dataclass(frozen=True)
class Slice(Layer):
    """Columns `begin` to `end` of a row."""

    begin: int
    end: int
    kind = "slice"


@dataclass(frozen=True)
class Convolution(Learned):
    """A filter of side k at every `stride`-th place: [channels x rows x columns] to [outputs x h x w], channels first.

    The weight is [channels * k * k, outputs], counted by channel, then row, then column.
    """

    channels: int
    rows: int
    columns: int
    side: int
    stride: int
    kind = "convolution"

    @property
    def filters(self) -> Floats:
        """The weight as [outputs, channels, k, k]."""
        return self.weight.T.reshape(self.outputs, self.channels, self.side, self.side)

    @property
    def places(self) -> tuple[int, int]:
        """Rows h and columns w of the output."""
        return (self.rows - self.side) // self.stride + 1, (self.columns - self.side) // self.stride + 1

    @property
    def width(self) -> int:
        """Width of the output."""
        return self.outputs * math.prod(self.places)

    @property
    def flops(self) -> int:
        """A multiplication and an addition for each weight and place."""
        return 2 * self.weight.size * math.prod(self.places)


@dataclass(frozen=True)
class GlobalMaxPool(Layer):
    """The largest number of each channel: [channels x places] to [channels]."""

    channels: int
    places: int
    kind = "global_max_pool"

    @property
    def flops(self) -> int:
        """A comparison for each place but the first."""
        return self.channels * (self.places - 1)


@dataclass(frozen=True)
class MessageAggregation(Layer):
    """Own features x beside the neighbours' mean message: [x, mean relative position / reach, mean of their x].

    The observation holds the relative positions of the others from column `begin` on, two numbers each, in team order.
    Neighbours have a squared distance below `reach_squared`. The means divide by their number plus one, for the agent
    itself.
    """

    begin: int
    team: int
    width: int
    reach_squared: float
    kind = "aggregate"

    @property
    def others(self) -> int:
        """Agents of the team but one."""
        return self.team - 1

    @property
    def end(self) -> int:
        """The column after the last relative position."""
        return self.begin + 2 * self.others

    @property
    def reach(self) -> float:
        """Unit of the relative positions."""
        return math.sqrt(self.reach_squared)

    @property
    def flops(self) -> int:
        """Per other agent: distance (3), comparison, count, and two operations per number of position and features."""
        return self.others * (9 + 2 * self.width) + 4


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
        """Operations for one action."""
        own = self.num_outputs if self.head == "choose" else 5 * self.num_outputs
        return sum(layer.flops for layer in self.layers) + own

    def describe(self) -> dict[str, object]:
        """Return the program without its weights, as JSON stores it."""
        names = ("num_inputs", "num_outputs", "hidden", "previous", "head", "groups", "team", "masked")
        return {name: getattr(self, name) for name in names} | {"layers": [layer.describe() for layer in self.layers]}
