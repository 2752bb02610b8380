"""Reading a policy's program off its network and head."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from esp_cli.export.layers import (
    Activation,
    Affine,
    Convolution,
    Floats,
    GlobalMaxPool,
    Layer,
    MessageAggregation,
    Norm,
    Recurrent,
    Slice,
)
from esp_cli.export.program import Program
from esp_cli.networks.constrained import ConstrainedLinear, Equivariant
from esp_cli.networks.contract import Network
from esp_cli.networks.exploration import BoundedPoint, EpsilonGreedy, ExploringCategorical
from esp_cli.networks.heads import BoundedGaussian, Categorical
from esp_cli.networks.layers import SeedLayerNorm, SeedLinear, SeedMLP
from esp_cli.networks.message_passing import REACH_SQUARED, MessagePassing, PictureEncoder
from esp_cli.networks.plain import GRU, MLP
from esp_cli.networks.policy import HistoryPolicy, Policy
from esp_cli.networks.separate import Separate
from esp_envs.errors import UserError


def program_of(policy: Policy) -> Program:
    """Return the program of a policy with a single seed.

    Raises:
        UserError: a network or head that exports do not know.
    """
    actor, head = policy.actor, policy.head
    parts = actor.parts if isinstance(actor, Separate) else None
    actor = actor.network if isinstance(actor, Separate) else actor
    num_inputs, layers = _network(actor)
    if parts is not None:
        layers.append(_sums(parts))
    if isinstance(head, Categorical | ExploringCategorical | EpsilonGreedy):
        groups: tuple[int, ...] = ()
    elif isinstance(head, BoundedGaussian | BoundedPoint):
        groups = _groups(head.disc)
    else:
        raise UserError(f"a head of the kind {type(head).__name__} cannot be exported")
    previous = policy.head.action_width if isinstance(policy, HistoryPolicy) and policy.recurrent else 0
    return Program(
        num_inputs=num_inputs - previous,
        layers=tuple(layers),
        num_outputs=head.num_outputs,
        hidden=actor.memory_width,
        previous=previous,
        head="squash" if groups else "choose",
        groups=groups,
        team=actor.team,
    )


def _network(actor: Network) -> tuple[int, list[Layer]]:
    """Return how many numbers a network reads, and its layers."""
    if isinstance(actor, MLP):
        return _width(actor), _perceptron(actor)
    if isinstance(actor, GRU):
        norm = [_norm(actor.norm)] if isinstance(actor.norm, SeedLayerNorm) else []
        unit = Recurrent(_affine(actor.gru.input), _affine(actor.gru.recurrent))
        return _width(actor.body), [*_perceptron(actor.body), unit, *norm, _affine(actor.head)]
    if isinstance(actor, Equivariant):
        *hidden, last = map(_affine, actor.layers)
        activated = [part for layer in hidden for part in (layer, _activation(actor.activation, layer))]
        return len(hidden[0].weight), [*activated, last]
    if isinstance(actor, MessagePassing):
        return max(actor.picture.stop, actor.others.stop), _message_passing(actor)
    raise UserError(
        f"a network of the kind {type(actor).__name__} cannot be exported; mlp, gru, equivariant, mpn and empn can, "
        "without symmetrise"
    )


def _message_passing(actor: MessagePassing) -> list[Layer]:
    """Return the layers of a team: the pictures, then message passing."""
    layers: list[Layer] = [Slice(actor.picture.start, actor.picture.stop), *_pictures(actor.encoder)]
    for layer in actor.layers:
        affine = _affine(layer)
        width = (affine.weight.shape[0] - 2) // 2
        messages = MessageAggregation(actor.others.start, actor.team, width, REACH_SQUARED)
        layers += [messages, affine, _activation("relu", affine)]
    return [*layers, _affine(actor.head)]


def _pictures(encoder: PictureEncoder) -> list[Layer]:
    layers: list[Layer] = []
    shape = encoder.shape
    for layer, side, stride in zip(encoder.layers, encoder.sides, encoder.strides, strict=True):
        affine = _affine(layer)
        filters = Convolution(affine.weight, affine.bias, *shape, side, stride)
        layers += [filters, Activation("relu", filters.width)]
        shape = (filters.outputs, *filters.places)
    channels, rows, columns = shape
    return [*layers, GlobalMaxPool(channels, rows * columns)]


def _width(mlp: SeedMLP) -> int:
    return len(_affine(mlp.layers[0]).weight)


def _perceptron(mlp: SeedMLP) -> list[Layer]:
    """Return the layers in the order in which `SeedMLP` applies them."""
    norms = None if mlp.norms is None else [_norm(norm) for norm in mlp.norms]
    layers: list[Layer] = [norms[0]] if norms else []
    last = len(mlp.layers) - 1
    for k, linear in enumerate(mlp.layers):
        affine = _affine(linear)
        layers.append(affine)
        if k < last or mlp.activate_output:
            layers.append(_activation(mlp.activation, affine))
            layers += [norms[k + 1]] if norms else []
    return layers


def _affine(linear: object) -> Affine:
    if isinstance(linear, ConstrainedLinear):
        return Affine(_plain(linear.weight()[0]), _plain(linear.bias()[0, 0]))
    assert isinstance(linear, SeedLinear)
    return Affine(_plain(linear.weight[0]), _plain(linear.bias[0, 0]))


def _activation(name: str, after: Affine) -> Activation:
    return Activation("relu" if name == "relu" else "tanh", after.bias.size)


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
