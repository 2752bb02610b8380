"""A learned prey from a policy file: what it does, and every way in which a file can be wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from esp_envs import make
from esp_envs.mpe.frozen_prey import digest
from esp_envs.mpe.predator_prey_spec import PredatorPreySettings

HEADER = {"format": "esp-policy", "version": 1, "task": "predator-prey", "network": "mlp", "activation": "tanh"}
NUM_INPUTS, HIDDEN, NUM_MOVES, SEEDS = 14, 8, 5, 2


def network() -> dict[str, torch.Tensor]:
    """Return two seeds of a two-layer policy: seed 0 always moves up, seed 1 runs right where it is right of x = 0."""
    tensors = {
        "actor.layers.0.weight": torch.zeros(SEEDS, NUM_INPUTS, HIDDEN),
        "actor.layers.0.bias": torch.zeros(SEEDS, 1, HIDDEN),
        "actor.layers.1.weight": torch.zeros(SEEDS, HIDDEN, NUM_MOVES),
        "actor.layers.1.bias": torch.zeros(SEEDS, 1, NUM_MOVES),
    }
    tensors["actor.layers.1.bias"][0, 0, 4] = 1.0
    tensors["actor.layers.0.weight"][1, 2, 0] = 1.0  # input 2 is the own x
    tensors["actor.layers.1.weight"][1, 0, 2] = 1.0  # hidden 0 votes for right
    tensors["actor.layers.1.weight"][1, 0, 1] = -1.0  # and against left
    return tensors


def write(path: Path, tensors: dict[str, torch.Tensor] | None = None, **changes: Any) -> str:
    header = {key: value for key, value in (HEADER | changes).items() if value is not None}
    tensors = network() if tensors is None else tensors
    save_file(tensors, path, {"esp": json.dumps(header | {"sha256": digest(tensors, header)})})
    return str(path)


def prey_velocity_after_a_step(path: str, seed: int, prey_x: float, **settings: object) -> list[float]:
    options = {"prey": "policy", "prey_policy": path, "prey_policy_seed": seed, **settings}
    env = make("predator-prey", 3, [0], options)
    places = torch.tensor([[3.0, 3.0], [-3.0, 3.0], [3.0, -3.0], [prey_x, 0.0], [5.0, 5.0], [-5.0, 5.0]])
    env.set_state(torch.cat([torch.zeros(8), places.flatten()]).expand(1, 3, -1))
    velocity = env.step(env.random_action()).next.state[0, :, 6:8]
    assert torch.equal(velocity[0], velocity[2])
    return velocity[0].tolist()


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_the_policy_drives_the_prey(tmp_path: Path, activation: str) -> None:
    path = write(tmp_path / "prey.safetensors", activation=activation)
    assert prey_velocity_after_a_step(path, 0, 0.3) == pytest.approx([0.0, 0.4])
    assert prey_velocity_after_a_step(path, 1, 0.3) == pytest.approx([0.4, 0.0])
    left = [-0.4, 0.0] if activation == "tanh" else [0.0, 0.0]  # a ReLU swallows the negative x
    assert prey_velocity_after_a_step(path, 1, -0.3) == pytest.approx(left)
    assert prey_velocity_after_a_step(path, 0, 0.3, actions="continuous") == pytest.approx([0.0, 0.4])


def refused(path: str, **settings: object) -> str:
    with pytest.raises(ValueError, match="prey") as caught:
        make("predator-prey", 1, [0], {"prey": "policy", "prey_policy": path, **settings})
    return str(caught.value)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    assert "there is no prey policy file" in refused(str(tmp_path / "none.safetensors"))
    large = tmp_path / "large.safetensors"
    with large.open("wb") as file:
        file.truncate(2**26 + 1)
    assert "has more than 64 MiB" in refused(str(large))


@pytest.mark.parametrize("content", [b"", b"not a policy", b"\xff" * 64, b"\x80\x04K\x01."])
def test_a_file_of_something_else_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "prey.safetensors"
    path.write_bytes(content)
    assert "is not an intact safetensors file" in refused(str(path))
    save_file({"x": torch.zeros(1)}, path)
    assert "no 'esp' entry" in refused(str(path))
    save_file({"x": torch.zeros(1)}, path, {"esp": "{broken"})
    assert "is not an intact safetensors file" in refused(str(path))


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    path = Path(write(tmp_path / "prey.safetensors"))
    content = path.read_bytes()
    path.write_bytes(content[:-50])
    assert "is not an intact safetensors file" in refused(str(path))
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    assert "does not match its checksum" in refused(str(path))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"task": "navigation"}, "task 'navigation'"),
        ({"format": None}, "format None"),
        ({"version": 2}, "version 2"),
        ({"network": "gru"}, "network 'gru'"),
        ({"activation": "sigmoid"}, "activation 'sigmoid'"),
    ],
)
def test_another_header_is_refused(tmp_path: Path, changes: dict[str, Any], told: str) -> None:
    assert told in refused(write(tmp_path / "prey.safetensors", **changes))


def test_tensors_of_another_network_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "prey.safetensors"
    missing = {name: value for name, value in network().items() if name != "actor.layers.1.bias"}
    norms = network() | {"actor.norms.0.weight": torch.ones(SEEDS, 1, NUM_INPUTS)}
    for tensors in (missing, {}, norms):
        assert "other weights than those of a plain mlp" in refused(write(path, tensors))


def test_another_number_of_bodies_or_an_unknown_seed_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "prey.safetensors")
    assert "maps 14 observations" in refused(path, num_predators=2)
    assert "holds 2 seeds" in refused(path, prey_policy_seed=2)


def test_the_file_is_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "prey.safetensors")
    monkeypatch.chdir(tmp_path)
    settings = PredatorPreySettings(prey="policy", prey_policy="prey.safetensors")
    assert settings.prey_policy == str(tmp_path / "prey.safetensors")
    assert PredatorPreySettings(**settings.model_dump()) == settings
