"""Networks that know the widths of their rows alone: a perceptron and a recurrent network."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import ClassVar, Literal

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from esp_cli.networks.contract import ActivationName, Generators, IoSpec, Memoryless, Network, NetworkConfig, WithVJP
from esp_cli.networks.kernels.library import WORTH_COMPILING, computes, has_compiler
from esp_cli.networks.layers import GAINS, SeedLayerNorm, SeedLinear, SeedMLP
from esp_cli.networks.ordering import NearestFirst
from esp_cli.networks.perceptron import Deferred, Shape, perceptron
from esp_cli.networks.recurrent import SeedGRU
from esp_envs.errors import UserError


class CompiledConfig(NetworkConfig):
    """The settings of networks that consist of perceptrons."""

    activation: ActivationName = Field("tanh", description="of the actor; MAPPO paper: relu")
    compiled: Literal["auto"] | bool = Field(
        "auto",
        description="kernels compiled for this processor: faster, other rounding; auto: on for 100k steps and more on "
        "the CPU where there is a C++ compiler",
    )

    def decided(self, steps: int, device: str) -> CompiledConfig:
        """Return these settings with `compiled` decided: on where the run gains more than compiling takes."""
        if self.compiled != "auto":
            return self
        fits = device == "cpu" and self.can_compile
        return self.model_copy(update={"compiled": fits and steps >= WORTH_COMPILING and has_compiler()})

    @property
    def can_compile(self) -> bool:
        """Whether kernels compute what the other settings ask for."""
        return True


class PlainConfig(CompiledConfig):
    """The settings of both plain networks."""

    precision: Literal["float32", "bfloat16"] = Field("float32", description="of the perceptron's matrix products")
    layer_norm: bool = Field(False, description="paper: on; ours off, it slows learning on the particle tasks")
    separate_parts: bool = Field(
        False, description="discrete wheel pairs: one output per speed of each wheel; a pair's output is their sum"
    )
    order: Literal["given", "nearest"] = Field(
        "given", description="of like things in an observation; nearest: each set sorted by distance, the nearest first"
    )

    def build(
        self, generators: Generators, inputs: int, outputs: int, output_gain: float, io: IoSpec | None
    ) -> Network:
        network = (GRU if self.recurrent else MLP)(generators, inputs, outputs, self, output_gain)
        return network if self.order == "given" else NearestFirst(network, self.io_or_refuse(io), self.products[1])

    @property
    def products(self) -> tuple[torch.dtype, bool]:
        """How networks compute: the precision as torch names it, and whether by kernels."""
        return getattr(torch, self.precision), self.compiled is True and not self.layer_norm

    @model_validator(mode="after")
    def _fits(self) -> PlainConfig:
        if self.separate_parts and self.symmetrise:
            raise UserError("separate_parts and symmetrise exclude each other; leave one of them off")
        if self.compiled is True and self.precision != "float32":
            raise UserError("compiled perceptrons compute in float32; leave compiled off, or precision as it is")
        return self

    @property
    def can_compile(self) -> bool:
        return self.precision == "float32" and not self.layer_norm

    def without_effect(self) -> frozenset[str]:
        return frozenset({"precision", "compiled"}) if self.layer_norm else frozenset()

    def least_parameters(self, inputs: int) -> int:
        return sum(a * b for a, b in pairwise((inputs, *self.hidden)))


class MlpConfig(PlainConfig):
    """The settings of a perceptron."""

    name: Literal["mlp"] = "mlp"


class GruConfig(PlainConfig):
    """The settings of a recurrent network."""

    recurrent: ClassVar[bool] = True

    name: Literal["gru"] = "gru"


class MLP(SeedMLP, Memoryless):
    """A perceptron."""

    def __init__(
        self, generators: Generators, inputs: int, outputs: int, config: PlainConfig, output_gain: float
    ) -> None:
        sizes = (inputs, *config.hidden, outputs)
        super().__init__(generators, sizes, config.activation, output_gain, config.layer_norm, False, *config.products)

    def unroll(self, x: Tensor, truncation: int = 0) -> Tensor:
        return self(x)

    def with_vjp(self, x: Tensor, shape: Sequence[int], truncation: int = 0, defer: bool = True) -> WithVJP:
        if self.norms is not None:
            return super().with_vjp(x, shape, truncation)
        may_learn = defer and computes(self.compiled, x)
        return Deferred(self._shape(), x, self._all_parameters, shape, may_learn)


class GRU(Network):
    """Hidden layers, a gated recurrent unit, a linear head: the recurrent network of the MAPPO paper."""

    def __init__(
        self, generators: Generators, inputs: int, outputs: int, config: PlainConfig, output_gain: float
    ) -> None:
        super().__init__()
        width = config.hidden[-1]
        gain = GAINS[config.activation]
        sizes = (inputs, *config.hidden)
        self.memory_width = width
        self.body = SeedMLP(generators, sizes, config.activation, gain, config.layer_norm, True, *config.products)
        self.gru = SeedGRU(generators, width, width, self.body.compiled)
        self.norm = SeedLayerNorm(len(generators), width) if config.layer_norm else nn.Identity()
        self.head = SeedLinear(generators, width, outputs, output_gain)

    def step(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        memory = self.gru(self.body(x), memory)
        return self.head(self.norm(memory)), memory

    def unroll(self, x: Tensor, truncation: int = 0) -> Tensor:
        # all but the recurrence itself is done for all steps at once
        memories = self.gru.unroll(self.body(x.transpose(1, 2)), truncation)
        rows, shape = self.norm(memories.flatten(1, 2)), Shape("relu", False, torch.float32, compiled=True)
        outputs = perceptron(shape, [rows], [*self.head.parameters()]) if self.gru.compiled else self.head(rows)
        return outputs.unflatten(1, memories.shape[1:3]).transpose(1, 2)
