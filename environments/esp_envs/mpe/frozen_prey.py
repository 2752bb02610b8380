"""A frozen learned prey: an MLP read from a safetensors policy file.

The file is a policy as trained with `control="prey"`: tensors `actor.layers.{k}.weight` [S, in, out] and
`actor.layers.{k}.bias` [S, 1, out], one policy per seed along the first axis, and a metadata entry `esp` with JSON that
says what the file is: an object with the keys `format`, `version`, `sha256` and others. The application writes these
files. Reading one never runs code.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from esp_envs.errors import UserError

METADATA_KEY = "esp"
POLICY_FORMAT = "esp-policy"
POLICY_VERSION = 1
_ACTIVATIONS = {"relu": torch.relu, "tanh": torch.tanh}
_TASK, _NETWORK = "predator-prey", "mlp"
_MOST_BYTES = 1 << 26


class FrozenPrey:
    """Greedy moves of a learned prey; a file that is missing, damaged or of another task is refused."""

    def __init__(self, path: str, seed: int, num_inputs: int, num_actions: int, device: torch.device) -> None:
        activation, tensors = _read(path)
        self._activation = _ACTIVATIONS[activation]
        layers = [(f"actor.layers.{k}.weight", f"actor.layers.{k}.bias") for k in range(len(tensors) // 2)]
        if not layers or {name for pair in layers for name in pair} != set(tensors):
            raise UserError(
                f"the prey policy {path} has other weights than those of a plain mlp; train one without "
                "network.layer_norm, network.symmetrise and network.separate_parts"
            )
        seeds = len(tensors[layers[0][0]])
        if not 0 <= seed < seeds:
            raise UserError(f"the prey policy {path} holds {seeds} seeds; there is no prey_policy_seed {seed}")
        self.layers = [tuple(tensors[name][seed].float().to(device) for name in pair) for pair in layers]
        widths = [self.layers[0][0].shape[0], self.layers[-1][0].shape[1]]
        if widths != [num_inputs, num_actions]:
            raise UserError(
                f"the prey policy {path} maps {widths[0]} observations to {widths[1]} actions, this task's prey has "
                f"{num_inputs} and {num_actions}; train a prey with the same predators, obstacles and discrete actions"
            )

    def moves(self, observation: Tensor) -> Tensor:
        """Return the move with the largest logit [W] int64 at observations [W, D]."""
        hidden = observation
        for index, (weight, bias) in enumerate(self.layers):
            if index:
                hidden = self._activation(hidden)
            hidden = torch.addmm(bias, hidden, weight)
        return hidden.argmax(-1)


def _read(path: str) -> tuple[str, dict[str, Tensor]]:
    """Return the activation and the tensors of the actor; what is intact was written by the application."""
    if not Path(path).is_file():
        raise UserError(f"there is no prey policy file at {path}; give the path of an exported prey policy")
    if Path(path).stat().st_size > _MOST_BYTES:
        raise UserError(f"{path} has more than {_MOST_BYTES >> 20} MiB, so it is no prey policy; export a prey")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no iterator
        header = json.loads(metadata.get(METADATA_KEY, "null"))
    except (SafetensorError, OSError, ValueError, RecursionError, RuntimeError) as error:
        raise UserError(
            f"the prey policy {path} is not an intact safetensors file ({_short(error)}); export it again"
        ) from error
    if not isinstance(header, dict):
        raise UserError(f"the file {path} has no 'esp' entry, so it is not a policy of this project; export a prey")
    description = {key: value for key, value in header.items() if key != "sha256"}
    try:
        intact = header.get("sha256") == digest(tensors, description)
    except (ValueError, TypeError, RecursionError):  # what no digest was ever made of
        intact = False
    if not intact:
        raise UserError(f"the prey policy {path} does not match its checksum; export it again")
    wanted = {"format": POLICY_FORMAT, "version": POLICY_VERSION, "task": _TASK, "network": _NETWORK}
    for key, value in wanted.items():
        if header.get(key) != value:
            found = _short(repr(header.get(key)))
            raise UserError(f"the prey policy {path} has {key} {found}, but a prey needs {value!r}")
    activation = header.get("activation")
    if activation not in _ACTIVATIONS:
        raise UserError(f"the prey policy {path} has activation {activation!r}; known are {', '.join(_ACTIVATIONS)}")
    return activation, {name: tensor for name, tensor in tensors.items() if name.startswith("actor.")}


def digest(tensors: Mapping[str, Tensor], description: Mapping[str, Any]) -> str:
    """Return the SHA-256, as hex, of the description and of each tensor's name, dtype, shape and bytes by name."""
    found = hashlib.sha256(_canonical(description))
    for name in sorted(tensors):
        tensor = tensors[name]
        found.update(_canonical([name, str(tensor.dtype), list(tensor.shape)]))
        if tensor.numel():
            found.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return found.hexdigest()


def _canonical(value: Any) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode("ascii")


def _short(value: object) -> str:
    text = next(iter(str(value).splitlines()), "")
    return text if len(text) <= 80 else f"{text[:77]}..."
