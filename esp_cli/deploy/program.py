"""A policy as plain arrays: the layers, memory and head of one seed's greedy policy, which every export is made from.

A program maps a row of observation, and of memory where it has one, to outputs, an action and the next memory:

    x = [observation, previous action]     the latter for recurrent policies of off-policy learners alone
    x = layer(x) for each layer            affine x W + b, activation, layer normalisation, gated recurrent unit
    action = argmax(x)                     head `choose`, or
    action = u tanh|u| / |u|               head `squash`, for each group u of x: a planar vector, or a single number

The memory is [hidden state of the unit, previous action], the latter one-hot where it is a choice.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from esp_cli.networks.bodies import GRU, MLP
from esp_cli.networks.exploration import BoundedPoint, EpsilonGreedy, ExploringCategorical
from esp_cli.networks.heads import BoundedGaussian, Categorical
from esp_cli.networks.layers import SeedLayerNorm, SeedLinear, SeedMLP
from esp_cli.networks.policy import HistoryPolicy, Policy
from esp_cli.networks.separate import Separate

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
        """What it learned, in the order in which exports store it."""
        return self.weight, self.bias


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
class Activation:
    """Relu or tanh of every number of a row `width` wide."""

    name: Literal["relu", "tanh"]
    width: int

    @property
    def arrays(self) -> tuple[Floats, ...]:
        """Nothing: it learned nothing."""
        return ()

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
        """What it learned, in the order in which exports store it."""
        return (*self.input.arrays, *self.recurrent.arrays)

    @property
    def flops(self) -> int:
        """Both products, and for every number two sigmoids (four each with their sums), tanh and the mixing."""
        return self.input.flops + self.recurrent.flops + 14 * self.hidden


Layer = Affine | Norm | Activation | Recurrent


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
    """

    num_inputs: int
    layers: tuple[Layer, ...]
    num_outputs: int
    hidden: int
    previous: int
    head: Literal["choose", "squash"]
    groups: tuple[int, ...]

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
            "layers": [_describe(layer) for layer in self.layers],
        }


def _describe(layer: Layer) -> dict[str, object]:
    if isinstance(layer, Affine):
        return {"kind": "affine", "inputs": layer.weight.shape[0], "outputs": layer.weight.shape[1]}
    if isinstance(layer, Norm):
        return {"kind": "norm", "width": layer.weight.size}
    if isinstance(layer, Activation):
        return {"kind": layer.name, "width": layer.width}
    return {"kind": "gru", "inputs": layer.input.weight.shape[0], "hidden": layer.hidden}


def program_of(policy: Policy) -> Program:
    """Return the program of a policy with a single seed.

    Raises:
        ValueError: a network or head that exports do not know.
    """
    actor, head = policy.actor, policy.head
    parts = actor.parts if isinstance(actor, Separate) else None
    actor = actor.network if isinstance(actor, Separate) else actor
    if isinstance(actor, MLP):
        layers = _perceptron(actor)
    elif isinstance(actor, GRU):
        norm = [_norm(actor.norm)] if isinstance(actor.norm, SeedLayerNorm) else []
        unit = Recurrent(_affine(actor.gru.input), _affine(actor.gru.recurrent))
        layers = [*_perceptron(actor.body), unit, *norm, _affine(actor.head)]
    else:
        raise ValueError(f"a network of the kind {type(actor).__name__} cannot be exported; mlp and gru can")
    if parts is not None:
        layers.append(_sums(parts))
    if isinstance(head, Categorical | ExploringCategorical | EpsilonGreedy):
        groups: tuple[int, ...] = ()
    elif isinstance(head, BoundedGaussian | BoundedPoint):
        groups = _groups(head.disc)
    else:
        raise ValueError(f"a head of the kind {type(head).__name__} cannot be exported")
    hidden = actor.memory_width
    previous = policy.head.action_width if isinstance(policy, HistoryPolicy) and policy.recurrent else 0
    first = next(layer for layer in layers if not isinstance(layer, Activation))
    width = first.weight.shape[0] if isinstance(first, Affine | Norm) else first.input.weight.shape[0]
    return Program(
        num_inputs=width - previous,
        layers=tuple(layers),
        num_outputs=head.num_outputs,
        hidden=hidden,
        previous=previous,
        head="squash" if groups else "choose",
        groups=groups,
    )


def _perceptron(mlp: SeedMLP) -> list[Layer]:
    """Return the layers in the order in which `SeedMLP` applies them."""
    norms = None if mlp.norms is None else [_norm(norm) for norm in mlp.norms]
    layers: list[Layer] = [norms[0]] if norms else []
    last = len(mlp.layers) - 1
    for k, linear in enumerate(mlp.layers):
        affine = _affine(linear)
        layers.append(affine)
        if k < last or mlp.activate_output:
            layers.append(Activation("relu" if mlp.activation == "relu" else "tanh", affine.bias.size))
            layers += [norms[k + 1]] if norms else []
    return layers


def _affine(linear: object) -> Affine:
    assert isinstance(linear, SeedLinear)
    return Affine(_plain(linear.weight[0]), _plain(linear.bias[0, 0]))


def _sums(parts: Tensor) -> Affine:
    """Return the sums of an action's parts as one more layer."""
    matrix = _plain(parts)
    return Affine(matrix, np.zeros(matrix.shape[1], np.float32))


def _norm(norm: object) -> Norm:
    assert isinstance(norm, SeedLayerNorm)
    return Norm(_plain(norm.weight[0, 0]), _plain(norm.bias[0, 0]))


def _plain(tensor: Tensor) -> Floats:
    return tensor.detach().cpu().float().numpy().copy()


def _groups(disc: Tensor) -> tuple[int, ...]:
    """Return the widths of the blocks of a block-diagonal matrix of ones."""
    widths, place = [], 0
    while place < len(disc):
        width = int(disc[place].sum())
        widths.append(width)
        place += width
    return tuple(widths)
