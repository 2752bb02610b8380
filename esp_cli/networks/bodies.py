"""Whole networks behind one contract, whether they remember or not.

Adding a network is one class and one line in `NETWORKS`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from esp_cli.networks.layers import GAINS, SeedGRU, SeedLayerNorm, SeedLinear, SeedMLP


class NetworkConfig(BaseModel):
    """The shape of actor and critic alike."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Literal["mlp", "gru"] = "mlp"
    hidden: tuple[Annotated[int, Field(ge=1, le=4096)], ...] = Field(
        (64, 64), min_length=1, max_length=16, description="hidden widths; MAPPO paper: two of 64"
    )
    activation: Literal["relu", "tanh"] = Field("tanh", description="of the actor; MAPPO paper: relu")
    precision: Literal["float32", "bfloat16"] = Field("float32", description="of the perceptron's matrix products")
    layer_norm: bool = Field(False, description="paper: on; ours off, it slows learning on the particle tasks")

    @property
    def dtype(self) -> torch.dtype:
        """The precision as torch names it."""
        return getattr(torch, self.precision)


class Network(nn.Module, ABC):
    """S networks of one shape; `memory` is what they carry from step to step ([S, B, 0] if nothing)."""

    memory_width = 0

    def initial_memory(self, num_seeds: int, batch: int, like: Tensor) -> Tensor:
        """Return the empty memory [S, B, H] of a new episode."""
        return like.new_zeros(num_seeds, batch, self.memory_width)

    @abstractmethod
    def step(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Advance one step: x [S, B, in], memory [S, B, H] -> (y [S, B, out], memory [S, B, H])."""

    @abstractmethod
    def unroll(self, x: Tensor, truncation: int = 0) -> Tensor:
        """Run over whole episodes, which begin with empty memory.

        Args:
            x: [S, B, T, in].
            truncation: cut the gradient through time every so many steps; 0 never does.

        Returns:
            y: [S, B, T, out].
        """


class MLP(SeedMLP, Network):
    """A perceptron; remembers nothing."""

    def __init__(
        self,
        generators: Sequence[torch.Generator],
        inputs: int,
        outputs: int,
        config: NetworkConfig,
        output_gain: float,
    ) -> None:
        sizes = (inputs, *config.hidden, outputs)
        super().__init__(generators, sizes, config.activation, output_gain, config.layer_norm, False, config.dtype)

    def step(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Apply the perceptron to one step."""
        return self(x), memory

    def unroll(self, x: Tensor, truncation: int = 0) -> Tensor:
        """Apply the perceptron to all steps at once."""
        return self(x.flatten(1, 2)).unflatten(1, x.shape[1:3])


class GRU(Network):
    """Hidden layers, a gated recurrent unit, a linear head: the recurrent network of the MAPPO paper."""

    def __init__(
        self,
        generators: Sequence[torch.Generator],
        inputs: int,
        outputs: int,
        config: NetworkConfig,
        output_gain: float,
    ) -> None:
        super().__init__()
        width = config.hidden[-1]
        gain = GAINS[config.activation]
        sizes = (inputs, *config.hidden)
        self.memory_width = width
        self.body = SeedMLP(generators, sizes, config.activation, gain, config.layer_norm, True, config.dtype)
        self.gru = SeedGRU(generators, width, width)
        self.norm = SeedLayerNorm(len(generators), width) if config.layer_norm else nn.Identity()
        self.head = SeedLinear(generators, width, outputs, output_gain)

    def step(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Advance one step."""
        memory = self.gru(self.body(x), memory)
        return self.head(self.norm(memory)), memory

    def unroll(self, x: Tensor, truncation: int = 0) -> Tensor:
        """Run over whole episodes; all but the recurrence itself is done for all steps at once."""
        batch, num_steps = x.shape[1:3]
        in_time_order = x.transpose(1, 2).flatten(1, 2)
        projected = self.gru.input(self.body(in_time_order)).unflatten(1, (num_steps, batch))
        memories = self.gru.unroll(projected.transpose(0, 1).contiguous(), truncation)
        rows = memories.transpose(0, 1).flatten(1, 2)
        return self.head(self.norm(rows)).unflatten(1, (num_steps, batch)).transpose(1, 2)


NETWORKS: dict[str, type[MLP] | type[GRU]] = {"mlp": MLP, "gru": GRU}


def build_network(
    generators: Sequence[torch.Generator], inputs: int, outputs: int, config: NetworkConfig, output_gain: float
) -> Network:
    """Build the network that `config.name` names.

    Args:
        generators: one CPU generator per seed, which draw the initial weights.
        inputs: width of a row.
        outputs: width of an output row.
        config: shape.
        output_gain: orthogonal gain of the last layer.
    """
    return NETWORKS[config.name](generators, inputs, outputs, config, output_gain)
