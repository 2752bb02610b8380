"""Whole networks behind one contract, whether they remember or not.

Adding a network is one class and one line in `PLAIN` or `STRUCTURED`.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from esp_cli.networks.constrained import Equivariant
from esp_cli.networks.contract import Network, NetworkConfig
from esp_cli.networks.layers import GAINS, SeedGRU, SeedLayerNorm, SeedLinear, SeedMLP
from esp_cli.networks.message_passing import MessagePassing
from esp_cli.networks.ports import Ports
from esp_cli.networks.symmetrised import Symmetrised

__all__ = ["Network", "NetworkConfig", "build_network"]


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


PLAIN: dict[str, type[MLP] | type[GRU]] = {"mlp": MLP, "gru": GRU}
"""Networks that know the widths of what they read and write alone."""
STRUCTURED: dict[str, type[MessagePassing] | type[Equivariant]] = {
    "mpn": MessagePassing,
    "empn": MessagePassing,
    "equivariant": Equivariant,
}
"""Networks that have to know what the numbers mean."""


def build_network(
    generators: Sequence[torch.Generator],
    inputs: int,
    outputs: int,
    config: NetworkConfig,
    output_gain: float,
    ports: Ports | None = None,
) -> Network:
    """Build the network that `config.name` names.

    Args:
        generators: one CPU generator per seed, which draw the initial weights.
        inputs: width of a row.
        outputs: width of an output row.
        config: shape.
        output_gain: orthogonal gain of the last layer.
        ports: what the numbers mean, where the network or its average over a group is to follow them.

    Raises:
        ValueError: the network does not fit what is read and written there.
    """
    structured = STRUCTURED.get(config.name)
    if ports is None and (structured or config.symmetrise):
        raise ValueError(f"the network {config.name} has to know what it reads, but here it would get numbers alone")
    network: Network
    if structured is None or ports is None:
        network = PLAIN[config.name](generators, inputs, outputs, config, output_gain)
    else:
        network = structured(generators, ports, config, output_gain)
    return network if ports is None or config.symmetrise is None else Symmetrised(network, ports, config.symmetrise)
