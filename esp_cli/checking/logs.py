"""Read transitions of others: an .npz file with obs, action, reward and next_obs, which `check_transitions` checks."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from esp_cli.checking.recorded import Transitions
from esp_envs.errors import UserError
from esp_envs.spec import Discrete, Spaces

_MOST_BYTES = 2**31
_NEEDED, _OPTIONAL = ("obs", "action", "reward", "next_obs"), ("action_mask",)


def read_transitions(path: Path, spaces: Spaces) -> Transitions:
    """Read the transitions of a file; reading never runs code.

    Args:
        path: of an .npz file with obs and next_obs [M, T, N, D], action [M, T, N] of integers or [M, T, N, width],
            reward [M, T, N], and action_mask [M, T, N, A] where the task has masks; the axis T may be left out.
        spaces: what the numbers are.

    Raises:
        UserError: it is missing, damaged or too large, or does not fit the spaces.
    """
    arrays = _arrays(path)
    missing = [name for name in _NEEDED if name not in arrays]
    if missing:
        raise UserError(f"{path} has no array {', '.join(missing)}; save {', '.join(_NEEDED)} with np.savez")
    action, agents, seen = spaces.action, spaces.num_agents, (spaces.num_agents, spaces.observation.width)
    shapes: dict[str, tuple[int, ...]] = {"obs": seen, "next_obs": seen, "reward": (agents,), "action": (agents,)}
    if not isinstance(action, Discrete):
        shapes["action"] = (agents, action.width)
    elif "action_mask" in arrays:
        shapes["action_mask"] = (agents, action.count)
    tensors = {
        name: _tensor(path, name, arrays[name], shape, integer=name == "action" and isinstance(action, Discrete))
        for name, shape in shapes.items()
    }
    lengths = {tuple(tensor.shape[:2]) for tensor in tensors.values()}
    if len(lengths) != 1:
        raise UserError(f"the arrays of {path} hold different numbers of transitions; give each the same")
    empty = [name for name, tensor in tensors.items() if not tensor.numel()]
    if empty:
        raise UserError(f"'{empty[0]}' of {path} holds no number; record at least one step of one agent")
    mask = tensors.get("action_mask")
    return Transitions(
        tensors["obs"], tensors["action"], tensors["reward"], tensors["next_obs"], None if mask is None else mask > 0
    )


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays that are looked for."""
    if not path.is_file():
        raise UserError(f"there is no file {path}; give the path of an .npz file")
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(item.file_size for item in archive.infolist())
        if size > _MOST_BYTES:
            raise UserError(f"it unpacks to {size / 1e9:.1f} GB, and at most {_MOST_BYTES / 1e9:.1f} GB are read")
        with np.load(path, allow_pickle=False) as file:
            found = [name for name in (*_NEEDED, *_OPTIONAL) if name in file.files]
            return {name: file[name] for name in found}
    except Exception as error:  # whatever a damaged archive or header makes zipfile and NumPy raise
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise UserError(f"{path} is not an intact .npz file ({reason}); save it again with np.savez") from None


def _tensor(path: Path, name: str, array: np.ndarray, shape: tuple[int, ...], integer: bool) -> Tensor:
    """Return one array as [M, T, *shape]."""
    found = tuple(array.shape)
    if found[-len(shape) :] != shape or array.ndim - len(shape) not in (1, 2):
        wanted = ", ".join(map(str, ("episodes", "steps", *shape)))
        raise UserError(f"'{name}' of {path} has shape {found}, expected ({wanted}) or the same without steps")
    if array.dtype.kind not in ("iu" if integer else "fiub"):
        raise UserError(f"'{name}' of {path} holds {array.dtype}; save {'integers' if integer else 'numbers'}")
    tensor = torch.from_numpy(array.astype(np.int64 if integer else np.float32))
    return tensor if array.ndim - len(shape) == 2 else tensor.unsqueeze(1)
