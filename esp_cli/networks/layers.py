"""Layers with a leading seed axis: parameters are [S, in, out], data [S, B, in], one matrix product for all seeds.

Seed k's parameters come from seed k's generator and its outputs and gradients depend on nothing else, so a seed
learns the same alone and among ten.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from esp_cli.networks.kernels.library import library
from esp_cli.networks.perceptron import Shape, activate_, affine, perceptron

# orthogonal gain of a hidden layer, as in the MAPPO paper's code (torch.nn.init.calculate_gain)
GAINS = {"relu": math.sqrt(2.0), "tanh": 5.0 / 3.0}


def orthogonal(generators: Sequence[torch.Generator], rows: int, columns: int, gain: float) -> Tensor:
    """Draw one orthogonal matrix per seed (Saxe et al., 2014): [S, rows, columns] on the CPU, whatever the device."""
    stack = [nn.init.orthogonal_(torch.empty(columns, rows), gain, generator=g).T for g in generators]
    return torch.stack([matrix.contiguous() for matrix in stack])


class SeedLinear(nn.Module):
    """y = x W + b for S seeds: [S, B, in] -> [S, B, out]."""

    def __init__(self, generators: Sequence[torch.Generator], inputs: int, outputs: int, gain: float) -> None:
        super().__init__()
        self.weight = nn.Parameter(orthogonal(generators, inputs, outputs, gain))
        self.bias = nn.Parameter(torch.zeros(len(generators), 1, outputs))

    def forward(self, x: Tensor) -> Tensor:
        return affine(self.bias, x, self.weight)


class SeedLayerNorm(nn.Module):
    """Layer normalisation with one gain and bias vector per seed (Ba et al., 2016)."""

    def __init__(self, num_seeds: int, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(num_seeds, 1, width))
        self.bias = nn.Parameter(torch.zeros(num_seeds, 1, width))

    def forward(self, x: Tensor) -> Tensor:
        """Normalise the last axis of x: [S, B, width]."""
        return torch.addcmul(self.bias, nn.functional.layer_norm(x, x.shape[-1:]), self.weight)


class SeedMLP(nn.Module):
    """A multi-layer perceptron for S seeds of input, hidden and output `sizes`; generators draw the initial weights.

    Without layer normalisation forward and backward run through one hand-written function (`perceptron`) that keeps
    only the activations and works in place; with it, through torch's own layers. It normalises the input and every
    hidden activation, as the MAPPO paper's code does. `output_gain` is the orthogonal gain of the last layer (0.01 for
    a policy head, 1 for a value). `precision` is of matrix products; all that goes in and out stays float32.
    """

    def __init__(
        self,
        generators: Sequence[torch.Generator],
        sizes: Sequence[int],
        activation: str,
        output_gain: float,
        layer_norm: bool = False,
        activate_output: bool = False,
        precision: torch.dtype = torch.float32,
        compiled: bool = False,
    ) -> None:
        super().__init__()
        gains = [GAINS[activation]] * (len(sizes) - 2) + [output_gain]
        self.layers = nn.ModuleList(
            SeedLinear(generators, a, b, gain) for a, b, gain in zip(sizes[:-1], sizes[1:], gains, strict=True)
        )
        self.activation = activation
        self.activate_output = activate_output
        self.precision = precision
        self.compiled = compiled
        if self.compiled:
            library("perceptron")
        normed = sizes if activate_output else sizes[:-1]
        self.norms = nn.ModuleList(SeedLayerNorm(len(generators), w) for w in normed) if layer_norm else None

    def forward(self, *parts: Tensor, rows_innermost: bool = False) -> Tensor:
        """Map rows whose numbers, side by side, are parts [S, ..., d], to [S, ..., out]; see `Shape`."""
        if self.norms is not None:
            return self._forward_normed(parts[0] if len(parts) == 1 else torch.cat(parts, -1))
        return self._from_layer(0, parts, rows_innermost)

    def from_first_sums(self, sums: Tensor) -> Tensor:
        """Map the first layer's sums x W_1 + b_1 [S, B, H] to [S, B, out], in place; not normed, nor activated last."""
        if len(self.layers) == 1:
            return sums.float()
        return self._from_layer(1, [activate_(sums, self.activation)])

    def _from_layer(self, first: int, parts: Sequence[Tensor], rows_innermost: bool = False) -> Tensor:
        return perceptron(self._shape(rows_innermost), parts, self._from(first))

    def _shape(self, rows_innermost: bool = False) -> Shape:
        return Shape(self.activation, self.activate_output, self.precision, rows_innermost, self.compiled)

    def _from(self, first: int) -> list[Tensor]:
        layers: list[SeedLinear] = [*self.layers][first:]
        return [p for layer in layers for p in (layer.weight, layer.bias)]

    def _forward_normed(self, x: Tensor) -> Tensor:
        assert self.norms is not None
        lead, x = x.shape[1:-1], self.norms[0](x.flatten(1, -2))
        last = len(self.layers) - 1
        for k, layer in enumerate(self.layers):
            x = layer(x)
            if k < last or self.activate_output:
                x = self.norms[k + 1](torch.relu(x) if self.activation == "relu" else torch.tanh(x))
        return x.unflatten(1, lead)
