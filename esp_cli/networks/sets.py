"""A network over sets: like things enter by shared weights, so that neither their order nor their number matters.

A row is the own numbers and families of like things (`Layout.families`). Each thing is described by its numbers, its
distance, and that between it and the nearest thing of each family; a perceptron that its family shares embeds it beside
the own numbers. Mean and maximum over each family, and the own numbers, enter a perceptron (deep sets, Zaheer et al.,
2017). The distances between things take the place of attention among them: a landmark that another agent is nearer to
is worth less, and to know that costs a subtraction a pair.

Shape letters: S seeds, B rows, N agents, H features of a thing.
"""

from __future__ import annotations

from typing import Literal

import torch
from pydantic import Field as Setting
from torch import Tensor, nn

from esp_cli.networks.contract import Generators, IoSpec, Memoryless, Network
from esp_cli.networks.joint_q import HYPER_GAIN
from esp_cli.networks.layers import SeedMLP
from esp_cli.networks.plain import GRU, GruConfig
from esp_cli.networks.set_features import Rows, SetShape, TeamFeatures, along
from esp_envs.errors import UserError


class SetConfig(SetShape):
    """The settings of the network over sets."""

    name: Literal["set"] = "set"
    memory: bool = Setting(
        False,
        description="each actor remembers: behind the sets is a gated recurrent unit as wide as the last hidden layer",
    )

    @property
    def recurrent(self) -> bool:  # type: ignore[override]
        """Whether actors carry memory; critics see the whole scene and carry none."""
        return self.memory

    def build(
        self, generators: Generators, inputs: int, outputs: int, output_gain: float, io: IoSpec | None
    ) -> Network:
        io = sets_or_refuse(self.name, self.io_or_refuse(io))
        if self.memory and io.num_values is None:
            return RecurrentSetNetwork(generators, io, inputs, outputs, self, output_gain)
        return SetNetwork(generators, io, outputs, self, output_gain)

    def joint_critic(self, generators: Generators, io: IoSpec, actions: int, further: int) -> nn.Module | None:
        return SetQ(generators, io, self, actions, further)

    def mixer(self, generators: Generators, io: IoSpec, width: int, further: int) -> nn.Module | None:
        return SetMixer(generators, io, self, width, further)


def sets_or_refuse(name: str, io: IoSpec) -> IoSpec:
    """Return what a network reads, where an actor sees like things; else raise a UserError."""
    if io.num_values is None and not io.spaces.observation.families:
        raise UserError(
            f"{name} reads sets of like things, but {io.spaces.label} shows none; say which fields are some "
            "(Field.family), or use mlp"
        )
    return io


class SetNetwork(Memoryless):
    """Sets in, outputs of an agent, of a team or of each agent of it out, read off its and the row's features."""

    def __init__(
        self,
        generators: Generators,
        io: IoSpec,
        outputs: int,
        config: SetConfig,
        output_gain: float,
        rows: Rows | None = None,
    ) -> None:
        super().__init__()
        self.activation = config.activation
        self.features = TeamFeatures(generators, io, config, rows=rows)
        width, self.values_each = self.features.width, io.num_values is not None and outputs > 1
        if self.values_each:
            self.features.each_or_refuse(io)
            outputs, width = 1, width + config.width
        sizes = (width, *config.hidden, outputs)
        self.head = SeedMLP(generators, sizes, config.activation, output_gain, compiled=config.compiled is True)

    def forward(self, x: Tensor) -> Tensor:
        parts, agents = self.features(x, each=self.values_each)
        if agents is None or not self.values_each:
            return self.head(*parts)
        return self.head(*along(parts, agents), agents).squeeze(-1)


class RecurrentSetNetwork(Network):
    """An agent's sets in, its outputs out, with a memory of their features; the previous action may stand behind."""

    def __init__(
        self, generators: Generators, io: IoSpec, inputs: int, outputs: int, config: SetConfig, output_gain: float
    ) -> None:
        super().__init__()
        self.activation, self.width = config.activation, io.layout.width
        self.features = TeamFeatures(generators, io, config)
        unit = GruConfig(hidden=config.hidden, activation=config.activation, compiled=config.compiled)
        self.unit = GRU(generators, self.features.width + inputs - self.width, outputs, unit, output_gain)
        self.memory_width = self.unit.memory_width

    def step(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        return self.unit.step(self._seen(x), memory)

    def unroll(self, x: Tensor, truncation: int = 0) -> Tensor:
        return self.unit.unroll(self._seen(x.flatten(1, 2)).unflatten(1, x.shape[1:3]), truncation)

    def _seen(self, x: Tensor) -> Tensor:
        parts, _ = self.features(x[..., : self.width])
        return torch.cat([*parts, x[..., self.width :]], -1)


class SetQ(nn.Module):
    """MADDPG's critic over the set of all agents' (observation, action); `further` numbers stand behind a scene."""

    def __init__(self, generators: Generators, io: IoSpec, config: SetConfig, actions: int, further: int) -> None:
        super().__init__()
        self.features = TeamFeatures(generators, io, config, actions)
        self.features.each_or_refuse(io)
        self.width, self.actions = io.layout.width, actions
        sizes = (self.features.width + further, *config.hidden, 1)
        self.head = SeedMLP(generators, sizes, config.activation, 1.0, compiled=config.compiled is True)

    def forward(self, seen: Tensor, action: Tensor) -> Tensor:
        """Return Q [S, ..., 1] of what is seen [S, ..., D] and joint actions [S, ..., N A]."""
        rows = seen.flatten(1, -2)
        own = action.flatten(1, -2).unflatten(-1, (-1, self.actions))
        parts, _ = self.features(rows[..., : self.width], own)
        return self.head(*parts, rows[..., self.width :]).unflatten(1, seen.shape[1:-1])


class SetMixer(nn.Module):
    """QMIX's mixer over a set of agents: Q_tot = w_2' elu(sum_i w_1(h_i, h) q_i + b_1) + b_2, with weights >= 0.

    h_i are the features of agent i and h those of the scene, so that exchanging agents changes nothing.
    """

    def __init__(self, generators: Generators, io: IoSpec, config: SetConfig, width: int, further: int) -> None:
        super().__init__()
        self.features = TeamFeatures(generators, io, config)
        self.features.each_or_refuse(io)
        self.seen, self.width, scene = io.layout.width, width, self.features.width + further
        sizes = ((scene + config.width, *config.hidden, width), (scene, *config.hidden, 2 * width + 1))
        compiled = config.compiled is True
        self.own, self.team = (SeedMLP(generators, s, "relu", HYPER_GAIN, compiled=compiled) for s in sizes)

    def forward(self, values: Tensor, state: Tensor) -> Tensor:
        """Mix the agents' values [S, ..., N] in what is seen [S, ..., D]: [S, ...]."""
        own, rows = values.flatten(1, -2), state.flatten(1, -2)
        parts, agents = self.features(rows[..., : self.seen], each=True)
        assert agents is not None
        parts = [*parts, rows[..., self.seen :]]
        weights = self.own(*along(parts, agents), agents).abs()
        bias, second, offset = self.team(*parts).split((self.width, self.width, 1), -1)
        hidden = torch.nn.functional.elu((weights * own.unsqueeze(-1)).sum(2) + bias)
        return ((hidden * second.abs()).sum(-1) + offset.squeeze(-1)).view(values.shape[:-1])
