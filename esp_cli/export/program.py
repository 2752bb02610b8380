"""A policy as plain arrays: the layers, memory and head of one seed's greedy policy, which every export is made from.

A program maps a row of observation, and of memory where it has one, to outputs, an action and the next memory:

    x = [observation, previous action]     the latter for recurrent policies of off-policy learners alone
    x = layer(x) for each layer
    action = argmax(x)                     head `choose`, among the allowed actions where the task has masks; or
    action = u tanh|u| / |u|               head `squash`, for each group u of x: a planar vector, or a single number

The memory is [hidden state of the unit, previous action], the latter one-hot where it is a choice. Of a team, whose
agents exchange messages, the rows of a world's agents are adjacent. Of a network over sets the observation is the own
numbers, and each set comes as a table of its things, as many as there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np
from torch import Tensor, nn

from esp_cli.export import layers
from esp_cli.export.layers import Floats, Layer
from esp_cli.export.sets import SetOf, pool_sets
from esp_cli.networks.constrained import ConstrainedLinear, Equivariant
from esp_cli.networks.contract import Network
from esp_cli.networks.exploration import BoundedPoint, EpsilonGreedy, ExploringCategorical
from esp_cli.networks.heads import BoundedGaussian, Categorical
from esp_cli.networks.layers import SeedLayerNorm, SeedLinear, SeedMLP
from esp_cli.networks.message_passing import REACH_SQUARED, MessagePassing
from esp_cli.networks.plain import GRU, MLP
from esp_cli.networks.policy import HistoryPolicy, Policy
from esp_cli.networks.sets import RecurrentSetNetwork, SetNetwork
from esp_cli.networks.symmetrised import Separate
from esp_envs.errors import UserError


@dataclass(frozen=True)
class Program:
    """One greedy policy."""

    num_inputs: int  # D, numbers of an observation
    layers: tuple[Layer, ...]
    num_outputs: int  # numbers of the last layer
    hidden: int  # H, numbers of the hidden state; 0 for a policy that remembers nothing
    previous: int  # numbers of the previous action in the memory
    head: Literal["choose", "squash"]  # how the outputs become an action
    groups: Sequence[int]  # widths of what is squashed together; empty where the head chooses
    team: int = 1  # agents that act together, with their rows side by side; 1 where each acts by itself
    masked: bool = False  # whether a mask of allowed actions [A] comes along; one that allows none allows all
    # of a network over sets: where a task's observation has the own numbers, and each set's things with their numbers
    own: Sequence[int] = ()
    sets: Sequence[tuple[str, Sequence[Sequence[int]]]] = ()

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
        return len(self.weights) // 4

    def split(self, obs: Floats) -> tuple[Floats, dict[str, Floats]]:
        """Return what the program reads of a task's observations [B, D]: own numbers [B, d], tables [B, K, W]."""
        return (obs[:, self.own] if self.sets else obs), {name: obs[:, columns] for name, columns in self.sets}

    def describe(self) -> dict[str, object]:
        """Return the program without its weights, as JSON stores it."""
        return vars(self) | {"layers": [layer.describe() for layer in self.layers]}


def program_of(policy: Policy) -> Program:
    """Return the program of a policy with a single seed."""
    actor, head = policy.actor, policy.head
    sums: list[Layer] = []
    if isinstance(actor, Separate):  # the sums of an action's parts are one more layer
        parts = _plain(actor.parts)
        actor, sums = actor.network, [layers.affine(parts, np.zeros(parts.shape[1], np.float32))]
    previous = head.num_outputs if isinstance(policy, HistoryPolicy) and policy.recurrent else 0
    own, sets = _sets(actor, previous) if isinstance(actor, SetNetwork | RecurrentSetNetwork) else (_network(actor), {})
    groups: list[int] = []
    if isinstance(head, BoundedGaussian | BoundedPoint):  # blocks of ones, in which a row's first one is the first row
        groups = head.disc.argmax(1).unique(return_counts=True)[1].tolist()
    elif not isinstance(head, Categorical | ExploringCategorical | EpsilonGreedy):
        raise UserError(f"a head of the kind {type(head).__name__} cannot be exported")
    return Program(
        num_inputs=len(sets["own"]) if sets else policy.num_observed,
        layers=(*own, *sums),
        num_outputs=head.num_outputs,
        hidden=actor.memory_width,
        previous=previous,
        head="squash" if groups else "choose",
        groups=groups,
        team=actor.team,
        masked=head.masks,
        **sets,
    )


def _network(actor: Network) -> list[Layer]:
    if isinstance(actor, MLP | Equivariant):
        return _perceptron(actor)
    if isinstance(actor, GRU):
        norm = [_norm(actor.norm)] if isinstance(actor.norm, SeedLayerNorm) else []
        unit = layers.gru(*_arrays(actor.gru.input), *_arrays(actor.gru.recurrent))
        return [*_perceptron(actor.body), unit, *norm, _affine(actor.head)]
    if isinstance(actor, MessagePassing):
        return _message_passing(actor)
    raise UserError(
        f"a network of the kind {type(actor).__name__} cannot be exported; mlp, gru, set, equivariant, mpn and empn "
        "can, without symmetrise and order=nearest"
    )


def _sets(actor: SetNetwork | RecurrentSetNetwork, previous: int) -> tuple[list[Layer], dict[str, Any]]:
    """Return layers, and where an observation has what they read."""
    encoder, rows = actor.features.encoder, actor.features.encoder.rows
    if rows.places or not rows.own:
        raise UserError(
            "set cannot be exported where a task with shifts shows several places, or no number is the agent's own"
        )
    columns = [column for part in rows.layout.own for column in range(part.where.start, part.where.stop)]
    kept = [columns.index(column) for where in rows.own for column in range(where.start, where.stop)]
    own = () if encoder.own is None else _arrays(encoder.own.layers[0])
    sets = []
    for family, place, reader, embed in zip(
        rows.families, rows.offsets, rows.readers, encoder.embed.values(), strict=True
    ):
        (first, bias), second = map(_arrays, cast("nn.ModuleList", embed.layers))
        width = len(first) - encoder.num_own
        things = [np.arange(part.where.start, part.where.stop).reshape(family.count, -1) for part in family.parts]
        at = None if reader is None else columns.index(reader)
        arrays = (first[:width], first[width:], bias, *second)
        sets.append(SetOf(family.name, np.hstack(things).tolist(), place, at, arrays))
    features = pool_sets(sets, own, kept, len(columns), previous, rows.near, actor.activation)
    found = {"own": columns, "sets": [(each.name, each.columns) for each in sets]}
    return [features, *(_perceptron(actor.head) if isinstance(actor, SetNetwork) else _network(actor.unit))], found


def _message_passing(actor: MessagePassing) -> list[Layer]:
    encoder, own = actor.encoder, list[Layer]()
    begin, shape = actor.picture.start, encoder.shape
    for layer, side, stride in zip(encoder.layers, encoder.sides, encoder.strides, strict=True):
        filters = layers.convolution(*_arrays(layer), begin, shape, side, stride)
        own += [filters, layers.activation("relu", filters.width)]
        begin, shape = 0, layers.convolved(shape, filters.arrays[1].size, side, stride)
    own.append(layers.global_max_pool(shape[0], shape[1] * shape[2]))
    for layer in actor.layers:
        linear = _affine(layer)
        inputs, outputs = linear.arrays[0].shape
        hear = layers.aggregate(actor.others.start, actor.team, (inputs - 2) // 2, REACH_SQUARED)
        own += [hear, linear, layers.activation("relu", outputs)]
    return [*own, _affine(actor.head)]


def _perceptron(mlp: SeedMLP | Equivariant) -> list[Layer]:
    norms = [_norm(norm) for norm in getattr(mlp, "norms", None) or ()]
    own, last = norms[:1], len(mlp.layers) - 1
    for k, linear in enumerate(mlp.layers):
        own.append(_affine(linear))
        if k < last or getattr(mlp, "activate_output", False):
            own += [layers.activation(mlp.activation, own[-1].arrays[1].size), *norms[k + 1 : k + 2]]
    return own


def _affine(linear: object) -> Layer:
    return layers.affine(*_arrays(linear))


def _arrays(linear: object) -> tuple[Floats, Floats]:
    """Return weight [in, out] and bias [out] of a linear layer."""
    if isinstance(linear, ConstrainedLinear):
        return _plain(linear.weight()[0]), _plain(linear.bias()[0, 0])
    assert isinstance(linear, SeedLinear)
    return _plain(linear.weight[0]), _plain(linear.bias[0, 0])


def _norm(norm: object) -> Layer:
    assert isinstance(norm, SeedLayerNorm)
    return layers.norm(_plain(norm.weight[0, 0]), _plain(norm.bias[0, 0]))


def _plain(tensor: Tensor) -> Floats:
    return tensor.detach().cpu().float().numpy().copy()
