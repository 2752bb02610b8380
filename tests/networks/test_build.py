"""Networks are found by their names; a new one is its own file and a line in the table."""

import json
from pathlib import Path

import pytest
import torch
from pydantic import Field

from esp_cli.networks.build import NETWORKS, build_network, perceptron
from esp_cli.networks.contract import Memoryless, NetworkConfig
from esp_cli.networks.layers import SeedLinear
from esp_cli.networks.policy import StochasticPolicy
from esp_cli.training.build import generators
from esp_cli.training.config import resolve_config
from esp_cli.training.settings import parse_config
from esp_envs.registry import make


class Scaled(Memoryless):
    def __init__(self, rngs, inputs, outputs, gain, scale):
        super().__init__()
        self.layer, self.scale = SeedLinear(rngs, inputs, outputs, gain), scale

    def forward(self, x):
        return self.layer(x) * self.scale


class ScaledConfig(NetworkConfig):
    scale: float = Field(2.0, gt=0)

    def build(self, generators, inputs, outputs, output_gain, io):
        return Scaled(generators, inputs, outputs, output_gain, self.scale)


def test_a_network_of_ones_own_is_a_class(monkeypatch):
    monkeypatch.setattr(NETWORKS, "_registered", {})
    own = f"{__name__}:ScaledConfig"
    with pytest.raises(ValueError, match=f"the network '{own}' is not installed; add --network {own}"):
        resolve_config("navigation", overrides={"network.name": own})
    assert NETWORKS.register(ScaledConfig) == own
    config = resolve_config("navigation", overrides={"network.name": own, "network.scale": 3})
    assert parse_config(json.loads(config.model_dump_json()), Path("run")) == config
    spec = make("navigation", 2, [0]).spec
    policy = StochasticPolicy(spec, config.network, generators([0, 1], "policy"))
    obs = torch.randn(2, 1, 4, 3, spec.observation.width)
    whole = policy.unroll(obs)[:, :, -1]
    step, _ = policy.step(obs[:, :, -1], policy.initial_memory(1, obs))
    torch.testing.assert_close(whole, step)
    with pytest.raises(ValueError, match=r"bad value 0 for 'network.scale'"):
        resolve_config("navigation", overrides={"network.name": own, "network.scale": 0})


@pytest.mark.parametrize("name", ["mpn", "empn", "equivariant"])
def test_a_network_with_symmetry_is_refused_where_its_inputs_have_no_meaning(name):
    with pytest.raises(ValueError, match=f"the network {name} needs the meaning of its inputs"):
        build_network(generators([0], "x"), 4, 2, NETWORKS[name](), 1.0)


def test_an_average_over_a_group_is_refused_where_the_inputs_have_no_meaning():
    with pytest.raises(ValueError, match=r"network\.symmetrise averages over images of the observation alone"):
        build_network(generators([0], "x"), 4, 2, NETWORKS["gru"](symmetrise="c4"), 1.0)


@pytest.mark.parametrize("name", NETWORKS)
def test_every_network_lends_its_widths_to_a_perceptron(name):
    plain = perceptron(NETWORKS[name](hidden=(8, 4), symmetrise="c4"), "relu")
    assert (plain.name, plain.hidden, plain.activation, plain.symmetrise) == ("mlp", (8, 4), "relu", None)


def test_a_perceptron_keeps_the_precision_of_a_recurrent_network():
    plain = perceptron(NETWORKS["gru"](precision="bfloat16", layer_norm=True), "tanh")
    assert (plain.precision, plain.layer_norm, plain.activation) == ("bfloat16", True, "tanh")
