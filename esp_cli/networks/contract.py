"""What every network offers to policies and critics, and the settings that every network has."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Annotated, ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from esp_cli.files.documents import Strict
from esp_cli.symmetry import FiniteGroup, admit, parse_group
from esp_cli.symmetry.maps import Block, action_blocks, layout_blocks, trivial
from esp_envs.errors import UserError
from esp_envs.spec import Layout, Spaces, joint_layout

Generators = Sequence[torch.Generator]  # one per seed
Reads = Literal["state", "observations", "own"]


@dataclass(frozen=True)
class IoSpec:
    """The input and output of a network in a task."""

    spaces: Spaces  # of the task
    # the global state, all agents' observations in a row, or one agent's own observation; rows of own observations
    # hold the agents of a world side by side
    reads: Reads
    # number of invariant outputs; None for an actor, whose outputs are one number per discrete action, or the numbers
    # of a continuous action
    num_values: int | None = None

    @property
    def layout(self) -> Layout:
        if self.reads == "observations":
            return joint_layout(self.spaces.observation, self.spaces.num_agents)
        return self.spaces.state if self.reads == "state" else self.spaces.observation

    def group(self, name: str) -> FiniteGroup:
        """Return a group that leaves agents in their places by its name."""
        group = parse_group(name, self.spaces.num_agents)
        if not isinstance(group, FiniteGroup) or any(element.permutation for element in group.elements):
            raise UserError(f"a network cannot be built for '{name}'; choose a finite group that moves no agents")
        if field := next((field for field in self.layout.fields if field.sorted_by), None):
            raise UserError(f"no network is equivariant on '{field.name}', whose items are sorted; use mlp or set")
        admit(name, group, self.spaces, instead="use another network")
        return group

    def inputs(self, group: FiniteGroup) -> list[Block]:
        return layout_blocks(self.layout, group)

    def outputs(self, group: FiniteGroup) -> list[Block]:
        if self.num_values is not None:
            return [trivial(group, self.num_values)]
        return action_blocks(self.spaces.action, group)


ActivationName = Literal["relu", "tanh"]
# the vector-Jacobian product of a network: from the slope of a loss by its outputs to those by its parameters in order,
# as they are, or all together side by side [S, P]
VJP = Callable[[Tensor], list[Tensor]]


class NetworkConfig(Strict, ABC):
    """The settings of one kind of network; a subclass has the fields of its kind and builds it."""

    recurrent: ClassVar[bool] = False  # whether the network carries memory from step to step
    free_of_counts: ClassVar[bool] = False  # whether the weights are the same for any number of agents and of things

    name: str = Field("", max_length=100)  # by which the user chose the network
    hidden: tuple[Annotated[int, Field(ge=1, le=4096)], ...] = Field(
        (64, 64), min_length=1, max_length=16, description="hidden widths; MAPPO paper: two of 64"
    )
    symmetrise: str | None = Field(
        None,
        max_length=100,
        description="a group: outputs for all images of the input are pulled back and averaged; local-d4: that of one "
        "image alone, in the frame of the input's vectors",
    )

    @abstractmethod
    def build(
        self, generators: Generators, inputs: int, outputs: int, output_gain: float, io: IoSpec | None
    ) -> Network:
        """Build the network, without the average that `symmetrise` asks for; arguments as of `build_network`.

        Raises:
            UserError: the network does not fit `io`, or needs it and there is none.
        """

    def joint_critic(self, generators: Generators, io: IoSpec, actions: int, further: int) -> nn.Module | None:
        """Build a critic of joint actions of agents that share their reward, as MADDPG has it; None for a perceptron.

        Args:
            generators: one CPU generator per seed, which draw the initial weights.
            io: what it sees of a scene.
            actions: A, numbers of an agent's encoded action.
            further: numbers behind the scene, such as the time.

        Returns:
            A module that maps seen [S, ..., D + further] and actions [S, ..., N A] to Q [S, ..., 1].
        """
        return None

    def mixer(self, generators: Generators, io: IoSpec, width: int, further: int) -> nn.Module | None:
        """Build QMIX's mixer; None for weights by a hypernetwork from one row. Arguments as of `joint_critic`.

        Returns:
            A module that maps values [S, ..., N] and what is seen [S, ..., D + further] to Q_tot [S, ...], which never
            falls when a value rises.
        """
        return None

    def io_or_refuse(self, io: IoSpec | None) -> IoSpec:
        """Return `io`, and refuse a place that gives none."""
        if io is None:
            raise UserError(f"the network {self.name} needs the meaning of its inputs, which this place does not give")
        return io

    def with_activation(self, activation: ActivationName) -> NetworkConfig:
        """Return these settings with another activation, where the network has a choice of it."""
        chosen = {"activation": activation} if "activation" in type(self).model_fields else {}
        return self.model_copy(update=chosen)

    def without_effect(self) -> frozenset[str]:
        """Return the names of settings that change nothing beside the others."""
        return frozenset()

    def decided(self, steps: int, device: str) -> NetworkConfig:
        """Return settings with what depends on steps per seed and "cpu" or "cuda" decided, as a run stores them."""
        return self

    def least_parameters(self, inputs: int) -> int:
        """Return a lower bound of the number of weights for rows of `inputs` numbers; a file with fewer is damaged."""
        # A constrained layer rounds its number of features, and pictures enter by few weights.
        return sum(a * b for a, b in pairwise((1, *self.hidden))) // 4


class Network(nn.Module, ABC):
    """S networks of one shape; `memory` is what they carry from step to step ([S, B, 0] if nothing)."""

    memory_width = 0
    team = 1  # rows that are read together: the agents of a world, side by side, where they exchange messages

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
            truncation: steps after which the gradient through time is cut; 0 never cuts it.

        Returns:
            y: [S, B, T, out].
        """

    def unroll_agents(self, x: Tensor, truncation: int = 0) -> Tensor:
        """Run over whole episodes of all agents of a world: [S, B, T, N, in] -> [S, B, T, N, out]."""
        rows = x.transpose(2, 3)
        return self.unroll(rows.flatten(1, 2), truncation).unflatten(1, rows.shape[1:3]).transpose(2, 3)

    @cached_property
    def _all_parameters(self) -> list[Tensor]:
        """All parameters; to list them takes as long as a product."""
        return [*self.parameters()]

    def with_vjp(self, x: Tensor, shape: Sequence[int], truncation: int = 0, defer: bool = True) -> WithVJP:
        """Return what `unroll_agents` does, in another shape and without a graph, and its VJP, by default autograd's.

        To `defer` lets a kernel compute the outputs later, together with a loss.
        """
        outputs = self.unroll_agents(x, truncation)

        def vjp(slope: Tensor) -> list[Tensor]:
            above = slope.reshape(outputs.shape)
            return [
                *torch.autograd.grad(outputs, self._all_parameters, above, allow_unused=True, materialize_grads=True)
            ]

        return WithVJP(outputs.detach().reshape(shape), vjp, self._all_parameters)


class WithVJP:
    """What a network returned, `tensor` without a graph, and the way back from slopes by it to some parameters."""

    waits = False  # whether nothing is computed yet; see `networks.perceptron.Deferred`

    def __init__(self, tensor: Tensor, vjp: VJP, parameters: Sequence[Tensor]) -> None:
        self.tensor, self.vjp, self.parameters, self.size = tensor, vjp, parameters, tensor.shape


class Memoryless(Network):
    """A network that maps each row by itself: a subclass defines `forward`, [S, B, in] -> [S, B, out]."""

    def step(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        return self(x), memory

    def unroll(self, x: Tensor, truncation: int = 0) -> Tensor:
        return self(x.flatten(1, -2)).unflatten(1, x.shape[1:-1])

    def unroll_agents(self, x: Tensor, truncation: int = 0) -> Tensor:
        return self.unroll(x, truncation) if self.team == 1 else super().unroll_agents(x, truncation)
