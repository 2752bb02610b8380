"""Checkpoint and policy files: named tensors and a JSON description in one safetensors file, written atomically.

Loading never runs code, and trusts nothing. The header is checked against the size of the file before anything is
parsed or allocated, and a SHA-256 over description and tensors is verified. So a flipped bit, a truncated copy or a
hostile file ends in one `UserError`.

Layout: the safetensors metadata has the key ``esp``, whose text is a JSON object with ``format``, ``version``,
``sha256`` and, beside these three, the writer's own description.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors import torch as safetensors_torch
from torch import Tensor

from esp_cli.defaults import __version__
from esp_cli.files.documents import parse_object
from esp_cli.files.formatting import attempting, shortened
from esp_cli.files.opening import open_regular
from esp_cli.files.writing import replace_file
from esp_cli.training.config import InitialPolicy, RunConfig
from esp_envs.errors import UserError
from esp_envs.spec import TaskSpec

CHECKPOINT_FORMAT, POLICY_FORMAT = "esp-checkpoint", "esp-policy"
METADATA_KEY = "esp"
_VERSION = 1  # of both formats
_RESERVED = {"format", "version", "sha256"}
_MAX_HEADER_BYTES = 4 * 2**20  # parsed JSON takes some 20 times the space of its text
_MAX_FILE_BYTES = 64 * 2**30
_MAX_DIMENSIONS = 16
_LENGTH_BYTES = 8
_DTYPES = {
    *(torch.float64, torch.float32, torch.float16, torch.bfloat16),
    *(torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8, torch.bool),
}


def save_checkpoint(
    path: str | os.PathLike[str],
    tensors: Mapping[str, Tensor],
    meta: Mapping[str, Any],
    format_name: str = CHECKPOINT_FORMAT,
) -> None:
    """Write dense tensors by name, on any device, and a JSON-able description atomically, into a folder that exists."""
    stored = _storable(path, tensors)
    # through JSON and back, so that the digest is of what a reader will see (lists for tuples, text keys)
    described = json.loads(json.dumps({"format": format_name, "version": _VERSION, **meta}, allow_nan=False))
    described["sha256"] = digest(stored, described)
    content = safetensors_torch.save(stored, metadata={METADATA_KEY: json.dumps(described, allow_nan=False)})
    if struct.unpack_from("<Q", content)[0] > _MAX_HEADER_BYTES or len(content) > _MAX_FILE_BYTES:
        raise UserError(f"cannot write {path}: its description or its tensors are larger than a reader accepts")
    with attempting("write", path):
        replace_file(path, content)


def load_checkpoint(
    path: str | os.PathLike[str], format_name: str = CHECKPOINT_FORMAT, sha256: str | None = None
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read and verify what `save_checkpoint` wrote, and a SHA-256 of the whole file where a manifest states one."""
    with _naming(path):
        header, content = _read(Path(path))
        if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
            raise UserError("is not the file that its manifest names: their SHA-256 differ; get both anew")
        description = _description(header, format_name)
        try:
            tensors = safetensors_torch.load(content)  # checks that they fill the data exactly: no gap, no overlap
        except (SafetensorError, ValueError, RuntimeError, AssertionError) as error:
            raise UserError(f"is truncated or damaged: {shortened(str(error))}") from None
        _check_tensors(tensors)
        if digest(tensors, {k: v for k, v in description.items() if k != "sha256"}) != description["sha256"]:
            raise UserError("is damaged: its content does not match its checksum; use another copy of it")
    # Copies, since the loader's tensors are not aligned to 64 bytes as torch's own are; only now, since the copy of a
    # damaged truth value is a sound one.
    aligned = {name: tensor.clone() for name, tensor in tensors.items()}
    return aligned, {key: value for key, value in description.items() if key not in _RESERVED}


def read_description(path: str | os.PathLike[str], format_name: str = CHECKPOINT_FORMAT) -> dict[str, Any]:
    """Read the description alone from the header of a file; its checksum is not verified."""
    with _naming(path):
        return _description(_read(Path(path), whole=False)[0], format_name)


@contextlib.contextmanager
def _naming(path: str | os.PathLike[str]) -> Iterator[None]:
    try:
        yield
    except UserError as error:
        raise UserError(f"{path} {error}") from None
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror or error}") from None


def _storable(path: str | os.PathLike[str], tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    stored: dict[str, Tensor] = {}
    storages: set[int] = set()
    for name, tensor in tensors.items():
        if not isinstance(tensor, Tensor) or tensor.layout != torch.strided or not _is_readable(tensor):
            found = getattr(tensor, "dtype", type(tensor).__name__)
            raise UserError(
                f"cannot write {path}: '{name}' is no dense tensor of a storable dtype and at most {_MAX_DIMENSIONS} "
                f"dimensions ({found})"
            )
        dense = tensor.detach().cpu().contiguous()
        if dense.untyped_storage().data_ptr() in storages:
            dense = dense.clone()
        storages.add(dense.untyped_storage().data_ptr())
        stored[name] = dense
    return stored


def _is_readable(tensor: Tensor) -> bool:
    return tensor.dtype in _DTYPES and tensor.dim() <= _MAX_DIMENSIONS


def _read(path: Path, whole: bool = True) -> tuple[dict[str, Any], bytes]:
    """Return the parsed header of a plain file, and its bytes, after checking that it has the size that it declares."""
    if not path.is_file():
        raise UserError("is a folder, not a file" if path.is_dir() else "does not exist or is no plain file")
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        prefix = file.read(_LENGTH_BYTES)
        if len(prefix) < _LENGTH_BYTES:
            raise UserError(f"is no safetensors file: it has only {len(prefix)} bytes")
        (header_bytes,) = struct.unpack("<Q", prefix)
        if header_bytes > min(size - _LENGTH_BYTES, _MAX_HEADER_BYTES):
            raise UserError("is truncated or no safetensors file: the header that it declares does not fit")
        text = file.read(header_bytes)
        header = parse_object(text, "header")
        if not whole:
            return header, b""
        data_bytes = size - _LENGTH_BYTES - header_bytes
        if size > _MAX_FILE_BYTES or data_bytes != _declared_bytes(header):
            raise UserError(f"is truncated or damaged: its size, {size} bytes, is not what its header declares")
        try:
            return header, prefix + text + file.read(data_bytes)
        except MemoryError:
            raise UserError(f"does not fit into the memory of this machine: it has {size} bytes") from None


def _declared_bytes(header: Mapping[str, Any]) -> int:
    """Return where the data of the last tensor of a header ends; -1 where it does not say so."""
    try:
        return max(
            (int(entry["data_offsets"][1]) for name, entry in header.items() if name != "__metadata__"), default=0
        )
    except (TypeError, KeyError, IndexError, ValueError):
        return -1


def _description(header: Mapping[str, Any], format_name: str) -> dict[str, Any]:
    """Return the JSON object under the key ``esp`` of a file of the wanted format."""
    metadata = header.get("__metadata__")
    if not isinstance(metadata, dict) or not isinstance(metadata.get(METADATA_KEY), str):
        raise UserError(f"was not written by esp: its metadata has no '{METADATA_KEY}'")
    description = parse_object(metadata[METADATA_KEY], "description")
    if description.get("format") != format_name:
        found = shortened(repr(description.get("format")))
        hint = "; give the run's folder" if description.get("format") == CHECKPOINT_FORMAT else ""
        raise UserError(f"is a file of the format {found}, where '{format_name}' is needed{hint}")
    number = description.get("version")
    if type(number) is not int or number < 0 or not isinstance(description.get("sha256"), str):
        raise UserError("is damaged or foreign: it lacks a format version or a checksum")
    if number > _VERSION:
        raise UserError(f"has version {number} of '{format_name}', newer than {_VERSION}; update esp")
    return description


def _check_tensors(tensors: Mapping[str, Tensor]) -> None:
    for name, tensor in tensors.items():
        if not _is_readable(tensor):
            raise UserError(f"is damaged: its tensor {shortened(repr(name))} has another dtype or rank than any")
        # a bool that is neither 0 nor 1 is undefined behaviour in the code that reads it
        if tensor.dtype == torch.bool and tensor.numel() and int(tensor.view(torch.uint8).max()) > 1:
            raise UserError(f"is damaged: its tensor {shortened(repr(name))} has truth values other than 0 and 1")


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


def describe_policy(config: RunConfig, spec: TaskSpec, step: int, returns: Sequence[float]) -> dict[str, Any]:
    """Return the description by which a policy file is used without its run folder."""
    return {
        "task": config.task,
        "task_version": spec.version,
        "network": config.network.name,
        "activation": getattr(config.network, "activation", None),
        "step": step,
        "greedy_returns": [None if math.isnan(x) else x for x in returns],
        "config": config.model_dump(mode="json"),
        "esp_version": __version__,
    }


def read_initial(path: Path, recorded: InitialPolicy) -> dict[str, Tensor]:
    """Read the weights that a run starts from, and check that they are those which its configuration records."""
    tensors, _ = load_checkpoint(path, POLICY_FORMAT)
    if digest(tensors, {}) != recorded.sha256:
        raise UserError(f"{path} does not hold the policy that the run started from; train anew")
    return tensors
