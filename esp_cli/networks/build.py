"""The networks by name, and how a network is built from its settings.

A network is one file, with its class and its `NetworkConfig`. The settings are built in, installed as entry points of
`esp.networks`, or named as module and class.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Annotated

from pydantic import BeforeValidator, SerializeAsAny

from esp_cli.networks.contract import ActivationName, Generators, IoSpec, Network, NetworkConfig
from esp_cli.networks.plain import MlpConfig, PlainConfig
from esp_cli.networks.symmetrised import LOCAL, LocalFrame, Symmetrised
from esp_envs.errors import UserError
from esp_envs.installed import Registry

__all__ = ["NETWORKS", "AnyNetworkConfig", "Network", "NetworkConfig", "build_network", "network_class", "perceptron"]

NETWORKS: Registry[NetworkConfig] = Registry(
    "network",
    {
        "mlp": "esp_cli.networks.plain:MlpConfig",
        "gru": "esp_cli.networks.plain:GruConfig",
        "mpn": "esp_cli.networks.message_passing:MpnConfig",
        "empn": "esp_cli.networks.message_passing:EmpnConfig",
        "set": "esp_cli.networks.sets:SetConfig",
        "set-equivariant": "esp_cli.networks.set_equivariant:SetEquivariantConfig",
        "equivariant": "esp_cli.networks.constrained:EquivariantConfig",
    },
    base="esp_cli.networks.contract:NetworkConfig",
    option="--network",
    example="skip:SkipConfig",
)
"""The settings of every network, by its name."""

# stored configurations of version 0.1.0 hold these fields for every network, also for one that does not read them
_FLAT_FIELDS = {"activation", "precision", "layer_norm", "group", "separate_parts"}


def network_class(name: object) -> type[NetworkConfig]:
    """Return the settings class of a network."""
    return NETWORKS[str(name)]


def _stored(data: object) -> object:
    """Read stored settings by the class of the network that they name; ignore what version 0.1.0 stored in excess."""
    if not isinstance(data, Mapping):
        return data
    cls = network_class(data.get("name", "mlp"))
    excess = _FLAT_FIELDS - set(cls.model_fields)
    kept = {name: value for name, value in data.items() if name not in excess}
    if "compiled" in cls.model_fields:  # a run of before there was a choice computed without kernels
        kept.setdefault("compiled", False)
    return cls.model_validate_json(json.dumps(kept), strict=True)


# A field of a pydantic model that holds the settings of any registered network
AnyNetworkConfig = Annotated[SerializeAsAny[NetworkConfig], BeforeValidator(_stored)]


def perceptron(config: NetworkConfig, activation: ActivationName) -> MlpConfig:
    """Return the settings of a perceptron with the widths of another network, and its products if it is plain."""
    shared = {"precision", "compiled", "layer_norm"} if isinstance(config, PlainConfig) else set()
    return MlpConfig(activation=activation, **config.model_dump(include={"hidden"} | shared))


def build_network(
    generators: Generators,
    inputs: int,
    outputs: int,
    config: NetworkConfig,
    output_gain: float,
    io: IoSpec | None = None,
) -> Network:
    """Build the network of the settings; `io` says what rows mean, but for further numbers that may stand behind."""
    network = config.build(generators, inputs, outputs, output_gain, io)
    if config.symmetrise is None:
        return network
    if io is None or inputs != io.layout.width:
        raise UserError(
            f"network.symmetrise averages over images of the observation alone, but this {config.name} reads more; "
            "leave it off, or choose a network without memory"
        )
    local, group = config.symmetrise.startswith(LOCAL), config.symmetrise.removeprefix(LOCAL)
    return (LocalFrame if local else Symmetrised)(network, io, group)
