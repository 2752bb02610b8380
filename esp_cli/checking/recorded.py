"""Transitions of anybody: collected from a task or read from a file, what they say of each agent, and their images."""

from __future__ import annotations

import math
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from esp_cli.checking.verdicts import Watch
from esp_cli.symmetry import Transform
from esp_envs.base import Environment
from esp_envs.errors import UserError
from esp_envs.spec import Discrete, Spaces

FEWEST = 64  # episodes (or single transitions) below which nothing can be told
EPISODES = 2048
STEPS = 8  # steps of each episode that are looked at
_MOST_BYTES = 2**31
_NEEDED, _OPTIONAL = ("obs", "action", "reward", "next_obs"), ("action_mask", "terminated", "alive")


@dataclass(frozen=True)
class Transitions:
    """Steps of a policy that prefers no direction, such as the uniformly random one.

    A vector whose numbers are uniform in [-1, 1] prefers the diagonals. Only quarter turns, and mirrors in the axes or
    diagonals, keep that preference as it is.

    Shape:
        obs, next_obs: [M, T, N, D], M episodes from their starts, T steps of each.
        action: [M, T, N] int64, or [M, T, N, width] float32.
        reward: [M, T, N].
        action_mask: [M, T, N, A] bool, the actions that were allowed; None where all always are.
        terminated: [M, T, N] bool, whether the step ended the episode for good; None where none does.
        alive: [M, T, N] bool, which agents still act after the step; None where they end with the episode alone.
    """

    obs: Tensor
    action: Tensor
    reward: Tensor
    next_obs: Tensor
    action_mask: Tensor | None = None
    terminated: Tensor | None = None
    alive: Tensor | None = None

    def map(self, function: Callable[[Tensor], Tensor]) -> Transitions:
        """Return transitions with every tensor put through a function."""
        return Transitions(**{name: function(part) for name, part in vars(self).items() if part is not None})

    def episodes(self, where: slice) -> Transitions:
        """Return some of the episodes."""
        return self.map(lambda x: x[where])


def collect(
    env: Environment,
    episodes: int = EPISODES,
    steps: int = STEPS,
    until: float = math.inf,
    watch: Watch = lambda *_: None,
) -> Transitions:
    """Return the first steps of random episodes, of which one that ends earlier repeats its last transition.

    After `until` no step is begun: episodes under way are left out, of the first ones only the missing steps.
    """
    worlds = env.num_envs * env.num_seeds
    rounds, count = -(-episodes // worlds), min(steps, env.spec.horizon)
    found: list[list[dict[str, Tensor]]] = []
    for k in range(rounds):
        observation = env.reset()
        over = torch.zeros(env.num_seeds, env.num_envs, dtype=torch.bool, device=env.device)
        rows: list[dict[str, Tensor]] = []
        for t in range(count):
            if (found or rows) and time.monotonic() > until:
                break
            action = env.random_action()
            step = env.step(action)
            row = {"obs": observation.obs, "action": action, "reward": step.reward, "next_obs": step.reached.obs}
            if observation.action_mask is not None:
                row["action_mask"] = observation.action_mask
            if env.spec.terminates:
                row["terminated"] = step.terminated.unsqueeze(-1).expand_as(step.reward)
            if step.reached.alive is not None:
                row["alive"] = step.reached.alive
            rows.append({name: picked(over, rows[-1][name], new) for name, new in row.items()} if rows else row)
            over = over | step.ended
            observation = step.next
            watch((k * count + t + 1) * worlds, rounds * count * worlds, "steps")
        if found and len(rows) < len(found[0]):
            break
        found.append(rows)
    parts = {
        name: torch.cat([torch.stack([row[name] for row in rows], 2).flatten(0, 1) for rows in found]).cpu()
        for name in found[0][0]
    }
    return Transitions(**parts)


def picked(flags: Tensor, there: Tensor, elsewhere: Tensor) -> Tensor:
    """Return of two tensors [S, E, ...] the first in worlds whose flags [S, E] are on, the second elsewhere."""
    return torch.where(flags.view(*flags.shape, *(1,) * (there.dim() - 2)), there, elsewhere)


def outputs_of(data: Transitions) -> dict[str, Tensor]:
    """Return what a regression predicts of each agent, [M, T, N, numbers] each: change, reward, any mask and ends."""
    flags = {"action mask": data.action_mask, "end": data.terminated, "alive": data.alive}
    found = {"obs": data.next_obs - data.obs, "reward": data.reward}
    found |= {name: flag.float() for name, flag in flags.items() if flag is not None}
    return {name: part if part.dim() == data.obs.dim() else part.unsqueeze(-1) for name, part in found.items()}


def turned(data: Transitions, transform: Transform) -> Transitions:
    """Return transformed transitions."""
    moves = {"obs": transform.obs, "next_obs": transform.obs, "action": transform.action}
    moves |= {"action_mask": transform.push_outputs}
    parts = {name: part.unsqueeze(0) for name, part in vars(data).items() if part is not None}
    return Transitions(**{name: moves.get(name, transform.per_agent)(part)[0] for name, part in parts.items()})


def require_told(spaces: Spaces, data: Transitions) -> None:
    """Raise a UserError for transitions that are too few, of other shapes than the spaces, or not finite."""
    lead = (*data.obs.shape[:2], spaces.num_agents)
    width = () if isinstance(spaces.action, Discrete) else (spaces.action.width,)
    seen = (*lead, spaces.observation.width)
    shapes = {"obs": seen, "action": (*lead, *width), "reward": lead, "next_obs": seen}
    if data.action_mask is not None and isinstance(spaces.action, Discrete):
        shapes["action_mask"] = (*lead, spaces.action.count)
    shapes |= {name: lead for name in ("terminated", "alive") if getattr(data, name) is not None}
    for name, shape in shapes.items():
        found = tuple(getattr(data, name).shape)
        if found != shape or len(lead) != 3 or 0 in found[1:]:
            axes = "[episodes, steps, agents]" + (" and the width" if len(shape) > 3 else "")
            raise UserError(f"'{name}' of the transitions has shape {list(found)}; give {axes}: {list(shape)}")
    if len(data.obs) < FEWEST:
        raise UserError(f"there are {len(data.obs)} episodes of transitions; record at least {FEWEST}")
    for name in ("obs", "action", "reward", "next_obs"):
        if not bool(getattr(data, name).isfinite().all()):
            raise UserError(f"'{name}' of the transitions holds numbers that are not finite; leave those episodes out")
    if isinstance(spaces.action, Discrete) and not spaces.action.holds(data.action):
        last = spaces.action.count - 1
        raise UserError(f"'action' of the transitions holds other than the indices 0 to {last}; give indices")


def read_transitions(path: Path, spaces: Spaces) -> Transitions:
    """Read the transitions of a file; reading never runs code.

    Args:
        path: of an .npz file with obs and next_obs [M, T, N, D], action [M, T, N] of integers or [M, T, N, width],
            reward [M, T, N], and where the task has them action_mask [M, T, N, A], terminated and alive [M, T, N]; the
            axis T may be left out.
        spaces: what the numbers are.

    Raises:
        UserError: it is missing, damaged or too large, or holds no numbers. `check_transitions` refuses other shapes.
    """
    arrays = _arrays(path)
    missing = [name for name in _NEEDED if name not in arrays]
    if missing:
        raise UserError(f"{path} has no array {', '.join(missing)}; save {', '.join(_NEEDED)} with np.savez")
    whole = isinstance(spaces.action, Discrete)
    tensors = {}
    for name, array in arrays.items():
        integer = whole and name == "action"
        if array.dtype.kind not in ("iu" if integer else "fiub"):
            raise UserError(f"'{name}' of {path} holds {array.dtype}; save {'integers' if integer else 'numbers'}")
        tensor = torch.from_numpy(array.astype(np.int64 if integer else np.float32))
        per_agent = name in ("reward", "terminated", "alive") or integer
        tensors[name] = tensor.unsqueeze(1) if tensor.ndim == (2 if per_agent else 3) else tensor
    tensors |= {name: tensors[name] > 0 for name in _OPTIONAL if name in tensors}
    if not whole:
        tensors.pop("action_mask", None)
    return Transitions(**tensors)


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
