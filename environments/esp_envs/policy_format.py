"""The format of policy files, which the application writes and a task with a frozen learned agent reads.

A policy file is a safetensors file. Its metadata has the key `METADATA_KEY`, whose text is a JSON object with the keys
`format`, `version`, `sha256` and others.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

METADATA_KEY = "esp"
POLICY_FORMAT = "esp-policy"
POLICY_VERSION = 1


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
