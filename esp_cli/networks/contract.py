"""What every network is to policies and critics, and what a user may choose of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from itertools import pairwise
from typing import Annotated, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, model_validator
from torch import Tensor, nn


class NetworkConfig(BaseModel):
    """The shape of actor and critic alike."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Literal["mlp", "gru", "mpn", "empn", "equivariant"] = "mlp"
    hidden: tuple[Annotated[int, Field(ge=1, le=4096)], ...] = Field(
        (64, 64), min_length=1, max_length=16, description="hidden widths; MAPPO paper: two of 64"
    )
    activation: Literal["relu", "tanh"] = Field("tanh", description="of the actor; MAPPO paper: relu")
    precision: Literal["float32", "bfloat16"] = Field("float32", description="of the perceptron's matrix products")
    layer_norm: bool = Field(False, description="paper: on; ours off, it slows learning on the particle tasks")
    group: str = Field("c4", description="of empn and equivariant: what their layers commute with")
    symmetrise: str | None = Field(
        None, description="a group: the network's answers to all images of what it sees are averaged"
    )

    separate_parts: bool = Field(
        False, description="discrete wheel pairs: one output per speed of each wheel, a pair's being their sum"
    )

    @property
    def dtype(self) -> torch.dtype:
        """The precision as torch names it."""
        return getattr(torch, self.precision)

    @model_validator(mode="after")
    def _fits(self) -> NetworkConfig:
        if self.name not in ("mlp", "gru") and (self.layer_norm or self.precision != "float32"):
            raise ValueError(
                f"layer_norm and precision are for mlp and gru, not for {self.name}; leave them as they are"
            )
        if self.separate_parts and (self.name not in ("mlp", "gru") or self.symmetrise):
            raise ValueError("separate_parts is for mlp and gru without symmetrise; leave it off")
        return self

    def least_parameters(self, inputs: int) -> int:
        """Return a number of weights that a network of this shape has at least, to tell a damaged shape by.

        Args:
            inputs: width of a row.
        """
        # relative positions and pictures enter by few weights, and a constrained layer rounds its number of features
        plain = self.name in ("mlp", "gru")
        widths = (inputs, *self.hidden) if plain else (1, *self.hidden)
        count = sum(a * b for a, b in pairwise(widths))
        return count if plain else count // 4


class Network(nn.Module, ABC):
    """S networks of one shape; `memory` is what they carry from step to step ([S, B, 0] if nothing)."""

    memory_width = 0
    team = 1
    """Rows that are read together: the agents of a world, side by side, where they exchange messages."""

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
