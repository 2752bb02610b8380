"""Reading a policy's program off its network and head."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from esp_cli.export import layers
from esp_cli.export.layers import Affine, Floats, Layer, Program
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
    sums: list[Layer] = []
    if isinstance(actor, Separate):  # the sums of an action's parts are one more layer
        parts = _plain(actor.parts)
        actor, sums = actor.network, [Affine(parts, np.zeros(parts.shape[1], np.float32))]
    own = _network(actor)
    if isinstance(head, Categorical | ExploringCategorical | EpsilonGreedy):
        groups: tuple[int, ...] = ()
    elif isinstance(head, BoundedGaussian | BoundedPoint):
        groups = _groups(head.disc)
    else:
        raise UserError(f"a head of the kind {type(head).__name__} cannot be exported")
    previous = policy.head.num_outputs if isinstance(policy, HistoryPolicy) and policy.recurrent else 0
    if isinstance(actor, MessagePassing):
        inputs = max(actor.picture.stop, actor.others.stop)
    else:
        inputs = next(layer.inputs for layer in own if isinstance(layer, Affine))
    return Program(
        num_inputs=inputs - previous,
        layers=(*own, *sums),
        num_outputs=head.num_outputs,
        hidden=actor.memory_width,
        previous=previous,
        head="squash" if groups else "choose",
        groups=groups,
        team=actor.team,
    )


def _network(actor: Network) -> list[Layer]:
    """Return the layers of a network."""
    if isinstance(actor, MLP):
        return _perceptron(actor)
    if isinstance(actor, GRU):
        norm = [_norm(actor.norm)] if isinstance(actor.norm, SeedLayerNorm) else []
        unit = layers.Recurrent(_affine(actor.gru.input), _affine(actor.gru.recurrent))
        return [*_perceptron(actor.body), unit, *norm, _affine(actor.head)]
    if isinstance(actor, Equivariant):
        *hidden, last = map(_affine, actor.layers)
        return [*(part for layer in hidden for part in (layer, _activation(actor.activation, layer))), last]
    if isinstance(actor, MessagePassing):
        return _message_passing(actor)
    raise UserError(
        f"a network of the kind {type(actor).__name__} cannot be exported; mlp, gru, equivariant, mpn and empn can, "
        "without symmetrise"
    )


def _message_passing(actor: MessagePassing) -> list[Layer]:
    """Return the layers of a team: the pictures, then message passing."""
    own: list[Layer] = [layers.Slice(actor.picture.start, actor.picture.stop), *_pictures(actor.encoder)]
    for layer in actor.layers:
        affine = _affine(layer)
        width = (affine.inputs - 2) // 2
        messages = layers.MessageAggregation(actor.others.start, actor.team, width, REACH_SQUARED)
        own += [messages, affine, _activation("relu", affine)]
    return [*own, _affine(actor.head)]


def _pictures(encoder: PictureEncoder) -> list[Layer]:
    own: list[Layer] = []
    shape = encoder.shape
    for layer, side, stride in zip(encoder.layers, encoder.sides, encoder.strides, strict=True):
        affine = _affine(layer)
        filters = layers.Convolution(affine.weight, affine.bias, *shape, side, stride)
        own += [filters, layers.Activation("relu", filters.width)]
        shape = (filters.outputs, *filters.places)
    channels, rows, columns = shape
    return [*own, layers.GlobalMaxPool(channels, rows * columns)]


def _perceptron(mlp: SeedMLP) -> list[Layer]:
    """Return the layers in the order in which `SeedMLP` applies them."""
    norms = [] if mlp.norms is None else [_norm(norm) for norm in mlp.norms]
    own: list[Layer] = [*norms[:1]]
    last = len(mlp.layers) - 1
    for k, linear in enumerate(mlp.layers):
        affine = _affine(linear)
        own.append(affine)
        if k < last or mlp.activate_output:
            own += [_activation(mlp.activation, affine), *norms[k + 1 : k + 2]]
    return own


def _affine(linear: object) -> Affine:
    if isinstance(linear, ConstrainedLinear):
        return Affine(_plain(linear.weight()[0]), _plain(linear.bias()[0, 0]))
    assert isinstance(linear, SeedLinear)
    return Affine(_plain(linear.weight[0]), _plain(linear.bias[0, 0]))


def _activation(name: str, after: Affine) -> layers.Activation:
    return layers.Activation("relu" if name == "relu" else "tanh", after.outputs)


def _norm(norm: object) -> layers.Norm:
    assert isinstance(norm, SeedLayerNorm)
    return layers.Norm(_plain(norm.weight[0, 0]), _plain(norm.bias[0, 0]))


def _plain(tensor: Tensor) -> Floats:
    return tensor.detach().cpu().float().numpy().copy()


def _groups(disc: Tensor) -> tuple[int, ...]:
    """Return the widths of the blocks of a block-diagonal matrix of ones."""
    starts = disc.argmax(1).unique(return_counts=True)  # a row's first one is where its block begins
    return tuple(starts[1].tolist())
