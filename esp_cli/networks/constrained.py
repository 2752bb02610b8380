"""Layers whose weights commute with a group: the equivariance constraint is solved, what is free in it is learned."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from esp_cli.networks.contract import ActivationName, Generators, IoSpec, Memoryless, Network, NetworkConfig
from esp_cli.networks.layers import GAINS, SeedMLP, orthogonal
from esp_cli.networks.perceptron import Shape, affine, perceptron
from esp_cli.symmetry import FiniteGroup
from esp_cli.symmetry.maps import Block, block_width, intertwiners, regular
from esp_envs.errors import UserError

Relaxation = Literal["residual", "weights", "gate"]
_CLOSED = 3.0  # a gate begins at sigmoid(-3) = 0.05


def copies_for(width: int, group: FiniteGroup, banks: int = 1) -> int:
    """Return how many regular features have about as many weights between two layers as `width` plain numbers."""
    return max(1, round(width / math.sqrt(banks * group.order)))


class ConstrainedLinear(nn.Module):
    """y = x W + b [S, B, out] for S seeds, with every W and b such that y transforms as it should when x does (Eq. 2).

    Between each block of the input and each of the output, W is a combination of the maps that commute with the group;
    the coefficients are the parameters. For the group of one element it is a plain linear layer. The initial weights
    are orthogonal ones of `gain`, projected onto what is allowed and scaled to keep their size.

    It begins with the symmetry, and `relax` is how fast it leaves it. "residual": by a plain layer beside it, which
    begins at 0 and need not commute, y = x (W + relax F) + ..., the layer of residual pathway priors (Finzi et al.,
    2021). "weights": by a number v(h) of each output h of a feature, which begins at 0, in two filter banks that
    commute, W(h) = W_1(h) (1 + relax v_1(h)) + W_2(h) relax v_2(h): relaxed weights (Wang et al., 2022; in learners
    Park et al., 2024).
    """

    def __init__(
        self,
        generators: Generators,
        inputs: Sequence[Block],
        outputs: Sequence[Block],
        gain: float,
        relax: float = 0.0,
        relaxation: Relaxation = "residual",
    ) -> None:
        super().__init__()
        self.inputs, self.outputs, self.relax, self.relaxation = list(inputs), list(outputs), relax, relaxation
        full = orthogonal(generators, block_width(inputs), block_width(outputs), gain)
        one = Block(np.ones((len(inputs[0].matrices), 1, 1)), 1)
        self.weights, self.biases = nn.ParameterDict(), nn.ParameterDict()
        row = 0
        for a, source in enumerate(self.inputs):
            column = 0
            for b, target in enumerate(self.outputs):
                basis = torch.as_tensor(intertwiners(source, target), dtype=torch.float32)
                if len(basis):
                    part = full[:, row : row + source.width, column : column + target.width]
                    part = part.unflatten(1, (source.copies, -1)).unflatten(3, (target.copies, -1))
                    scale = math.sqrt(source.size * target.size / len(basis))
                    # seed by seed: in one product for all, the rounding would depend on their number
                    start = torch.stack([torch.einsum("minj,kij->mnk", own, basis) for own in part]) * scale
                    self.weights[f"{a}-{b}"] = nn.Parameter(start)
                    self.register_buffer(f"basis-{a}-{b}", basis.flatten(1), False)
                column += target.width
            row += source.width
        for b, target in enumerate(self.outputs):
            basis = torch.as_tensor(intertwiners(one, target), dtype=torch.float32)
            if len(basis):
                self.biases[str(b)] = nn.Parameter(torch.zeros(len(generators), target.copies, len(basis)))
                self.register_buffer(f"constant-{b}", basis.flatten(1), False)
        self.num_seeds = len(generators)
        if relax and relaxation == "weights":
            self.bank = ConstrainedLinear(generators, inputs, outputs, gain)
            self.bank.biases = nn.ParameterDict()  # one bias is enough
            shares = [torch.zeros(len(generators), 2, 1, target.size) for target in self.outputs]
            self.shares = nn.ParameterList(shares)
        elif relax:
            self.free = nn.Parameter(torch.zeros_like(full))
            self.free_bias = nn.Parameter(torch.zeros(len(generators), 1, full.shape[2]))

    def weight(self) -> Tensor:
        like = next(iter(self.weights.values()))
        rows = []
        for a, source in enumerate(self.inputs):
            parts = []
            for b, target in enumerate(self.outputs):
                name = f"{a}-{b}"
                if name in self.weights:
                    made = self.weights[name] @ self.get_buffer(f"basis-{name}")  # [S, m, n, d_in * d_out]
                    made = made.unflatten(3, (source.size, target.size)).transpose(2, 3)
                    parts.append(made.reshape(self.num_seeds, source.width, target.width))
                else:
                    parts.append(like.new_zeros(self.num_seeds, source.width, target.width))
            rows.append(torch.cat(parts, 2) if len(parts) > 1 else parts[0])
        held = torch.cat(rows, 1) if len(rows) > 1 else rows[0]
        if not self.relax:
            return held
        if self.relaxation == "residual":
            return held + self.relax * self.free
        shares = zip(self.shares, self.outputs, strict=True)
        first, second = torch.cat([v.repeat(1, 1, 1, target.copies) for v, target in shares], 3).unbind(1)
        return held + self.relax * (held * first + self.bank.weight() * second)

    def bias(self) -> Tensor:
        like = next(iter(self.weights.values()))
        parts = []
        for b, target in enumerate(self.outputs):
            if str(b) in self.biases:
                parts.append((self.biases[str(b)] @ self.get_buffer(f"constant-{b}")).flatten(1))
            else:
                parts.append(like.new_zeros(self.num_seeds, target.width))
        held = torch.cat(parts, 1).unsqueeze(1)
        return held + self.relax * self.free_bias if self.relax and self.relaxation == "residual" else held

    def forward(self, x: Tensor) -> Tensor:
        return affine(self.bias(), x, self.weight())


class EquivariantConfig(NetworkConfig):
    """The settings of an equivariant perceptron."""

    name: Literal["equivariant"] = "equivariant"
    activation: ActivationName = Field("tanh", description="of the actor; MAPPO paper: relu")
    group: str = Field("c4", max_length=100, description="the layers commute with this group")
    relax: float = Field(
        0.0, ge=0, le=10, description="how fast each layer can leave the symmetry; 0: exactly equivariant"
    )
    relaxation: Relaxation = Field(
        "residual",
        description="by a plain layer beside each, by weights that differ between a feature's outputs, or by a gate: a "
        "plain network beside the whole, by a share that depends on the input",
    )

    def without_effect(self) -> frozenset[str]:
        return frozenset() if self.relax else frozenset({"relaxation"})

    def build(
        self, generators: Generators, inputs: int, outputs: int, output_gain: float, io: IoSpec | None
    ) -> Network:
        if not self.relax or self.relaxation != "gate":
            return Equivariant(generators, self.io_or_refuse(io), self, output_gain)
        exact = Equivariant(generators, self.io_or_refuse(io), self.model_copy(update={"relax": 0.0}), output_gain)
        free, gate = (
            SeedMLP(generators, (inputs, *self.hidden, width), self.activation, gain)
            for width, gain in ((outputs, output_gain), (1, 0.0))
        )
        return Gated(exact, free, gate, self.relax)


class Equivariant(Memoryless):
    """A perceptron of regular features over scalars, planar vectors and the like: equivariant in every layer."""

    def __init__(self, generators: Generators, io: IoSpec, config: EquivariantConfig, output_gain: float) -> None:
        super().__init__()
        if any(field.pixels is not None for field in io.layout.fields):
            raise UserError(
                f"the network 'equivariant' reads numbers, but {io.spaces.label} shows pictures; use empn or mlp"
            )
        self.group = io.group(config.group)
        banks = 2 if config.relax and config.relaxation == "weights" else 1
        hidden = [[regular(self.group, copies_for(width, self.group, banks))] for width in config.hidden]
        blocks = [io.inputs(self.group), *hidden, io.outputs(self.group)]
        gains = [GAINS[config.activation]] * len(hidden) + [output_gain]
        self.layers = nn.ModuleList(
            ConstrainedLinear(generators, a, b, gain, config.relax, config.relaxation)
            for a, b, gain in zip(blocks[:-1], blocks[1:], gains, strict=True)
        )
        self.activation = config.activation
        self._shape = Shape(config.activation, activate_output=False, precision=torch.float32)

    def forward(self, x: Tensor) -> Tensor:
        layers: list[ConstrainedLinear] = [*self.layers]
        return perceptron(self._shape, [x], [made for layer in layers for made in (layer.weight(), layer.bias())])


class Gated(Memoryless):
    """y = (1 - a(x)) E(x) + a(x) F(x) with a(x) = sigmoid(relax g(x) - 3): E commutes with the group, F and g need not.

    g begins at 0, so a begins at 0.05 everywhere and learns where, and in which features, the symmetry is broken. That
    is the idea of PEnGUiN (McClellan et al., 2025), which has such a share in every layer of a graph network.
    """

    def __init__(self, exact: Equivariant, free: SeedMLP, gate: SeedMLP, relax: float) -> None:
        super().__init__()
        self.exact, self.free, self.gate, self.relax = exact, free, gate, relax

    def forward(self, x: Tensor) -> Tensor:
        return torch.lerp(self.exact(x), self.free(x), torch.sigmoid(self.relax * self.gate(x) - _CLOSED))
