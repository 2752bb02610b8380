"""The layers of an exported policy as plain arrays; `program` says how they follow each other."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

NORM_EPSILON = 1e-5
"""Added to the variance by layer normalisation (torch's default)."""
SQUASH_EPSILON = 1e-18
"""Added to the squared length of what is squashed (`esp_cli.networks.heads.squash`)."""


@dataclass(frozen=True)
class Learned:
    """What a layer with a weight and a bias holds."""

    weight: Floats
    bias: Floats

    @property
    def arrays(self) -> tuple[Floats, ...]:
        """The learned arrays, in the order in which exports store them."""
        return self.weight, self.bias


class Fixed:
    """What a layer without weights holds."""

    @property
    def arrays(self) -> tuple[Floats, ...]:
        """Nothing: it learned nothing."""
        return ()


class Affine(Learned):
    """x W + b with W [in, out] and b [out]."""

    @property
    def flops(self) -> int:
        """A multiplication and an addition for each weight."""
        return 2 * self.weight.size


class Norm(Learned):
    """(x - mean) / sqrt(variance + 1e-5) * weight + bias over a row."""

    @property
    def flops(self) -> int:
        """Sums for mean and variance (1 + 3 a number), then four operations a number."""
        return 8 * self.weight.size


@dataclass(frozen=True)
class Activation(Fixed):
    """Relu or tanh of every number of a row `width` wide."""

    name: Literal["relu", "tanh"]
    width: int

    @property
    def flops(self) -> int:
        """One a number."""
        return self.width


@dataclass(frozen=True)
class Recurrent:
    """A gated recurrent unit of H numbers: r, z = s(p + q); n = tanh(p + r q); h' = n + z (h - n).

    p = x W + b and q = h U + c, each in the order r, z, n.
    """

    input: Affine
    recurrent: Affine

    @property
    def hidden(self) -> int:
        """H."""
        return len(self.recurrent.weight)

    @property
    def arrays(self) -> tuple[Floats, ...]:
        """The learned arrays, in the order in which exports store them."""
        return (*self.input.arrays, *self.recurrent.arrays)

    @property
    def flops(self) -> int:
        """Both products; per number two sigmoids (four operations each, sums included), tanh and the interpolation."""
        return self.input.flops + self.recurrent.flops + 14 * self.hidden


@dataclass(frozen=True)
class Slice(Fixed):
    """Columns `begin` to `end` of a row."""

    begin: int
    end: int

    @property
    def flops(self) -> int:
        """None."""
        return 0


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

    @property
    def outputs(self) -> int:
        """Channels of the output."""
        return self.bias.size

    @property
    def places(self) -> tuple[int, int]:
        """Rows h and columns w of the output."""
        return (self.rows - self.side) // self.stride + 1, (self.columns - self.side) // self.stride + 1

    @property
    def width(self) -> int:
        """Width of the output."""
        return self.outputs * self.places[0] * self.places[1]

    @property
    def flops(self) -> int:
        """A multiplication and an addition for each weight and place."""
        return 2 * self.weight.size * self.places[0] * self.places[1]


@dataclass(frozen=True)
class GlobalMaxPool(Fixed):
    """The largest number of each channel: [channels x places] to [channels]."""

    channels: int
    places: int

    @property
    def flops(self) -> int:
        """A comparison for each place but the first."""
        return self.channels * (self.places - 1)


@dataclass(frozen=True)
class MessageAggregation(Fixed):
    """Own features x and those of near agents: [x, mean relative position / reach, mean of their x].

    The observation holds the relative positions of the others from column `begin` on, two numbers each, in team order.
    Near agents have a squared distance below `reach_squared`. The means divide by their number plus one, for the agent
    itself.
    """

    begin: int
    team: int
    width: int
    reach_squared: float

    @property
    def end(self) -> int:
        """The column after the last relative position."""
        return self.begin + 2 * (self.team - 1)

    @property
    def reach(self) -> float:
        """Unit of the relative positions."""
        return math.sqrt(self.reach_squared)

    @property
    def flops(self) -> int:
        """Per other agent: distance (3), comparison, count, and two operations per number of position and features."""
        return (self.team - 1) * (9 + 2 * self.width) + 4


Layer = Affine | Norm | Activation | Recurrent | Slice | Convolution | GlobalMaxPool | MessageAggregation


def describe(layer: Layer) -> dict[str, object]:
    """Return a layer without its weights, as JSON stores it."""
    if isinstance(layer, Affine):
        return {"kind": "affine", "inputs": layer.weight.shape[0], "outputs": layer.weight.shape[1]}
    if isinstance(layer, Norm):
        return {"kind": "norm", "width": layer.weight.size}
    if isinstance(layer, Activation):
        return {"kind": layer.name, "width": layer.width}
    if isinstance(layer, Slice):
        return {"kind": "slice", "begin": layer.begin, "end": layer.end}
    if isinstance(layer, Convolution):
        return {"kind": "convolution", **_named(layer, "channels", "rows", "columns", "side", "stride", "outputs")}
    if isinstance(layer, GlobalMaxPool):
        return {"kind": "global_max_pool", "channels": layer.channels, "places": layer.places}
    if isinstance(layer, MessageAggregation):
        return {"kind": "aggregate", **_named(layer, "begin", "end", "team", "reach_squared")}
    return {"kind": "gru", "inputs": layer.input.weight.shape[0], "hidden": layer.hidden}


def _named(layer: Layer, *names: str) -> dict[str, object]:
    return {name: getattr(layer, name) for name in names}
