"""Transformed copies of TensorDicts, whose keys say what their numbers are."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import count
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from esp_cli.loop.shapes import act, carry, check_state, lead_of
from esp_cli.symmetry import Transform
from esp_envs.errors import UserError
from esp_envs.spec import Spaces

# what the numbers under a key are: rows of a layout, actions (or one number per action), ids of trajectories, of which
# each copy has its own, unchanged, left out
Role = Literal["observation", "state", "action", "trajectory", "same", "drop"]
_COPY_NUMBERS = count(1)
Key = str | tuple[str, ...]

_DROPPED: dict[str, Role] = dict.fromkeys(("action_value", "logits", "loc", "scale", "info"), "drop")
ROLES: Mapping[str, Role] = {
    "observation": "observation",
    "obs": "observation",
    "state": "state",
    "action": "action",
    "action_mask": "action",
    "index": "same",
    "traj_ids": "trajectory",
    **_DROPPED,
}
"""The role of a key by its last part; "drop" applies to whatever lies below it too.

Other keys hold numbers that go with their agents, or one for each row (rewards, dones, advantages).
"""


def with_copies(
    spaces: Spaces, data: Any, choose: Callable[[Tensor], list[Transform]], roles: Mapping[str, Role] | None = None
) -> tuple[list[Any], list[Transform]]:
    """Return the data, less what is dropped, with its copies behind it, and the element of each copy.

    The TensorDict [B, ...] has agents in nested groups or not, also below "next". `choose` returns the elements for a
    device, and `roles` are of keys by their last part, where they differ from `ROLES`.
    """
    named: Mapping[str, Role] = {**ROLES, **(roles or {})}
    if unknown := next((part for part, role in named.items() if role not in get_args(Role)), None):
        raise UserError(f"{unknown} has the role {named[unknown]!r}; the roles are {', '.join(get_args(Role))}")
    leaves = {_path(key): value for key, value in data.items(include_nested=True, leaves_only=True)}
    data = data.exclude(*(path for path in leaves if any(named.get(part) == "drop" for part in path)))
    kept = {_path(key): value for key, value in data.items(include_nested=True, leaves_only=True)}
    seen = [value for path, value in kept.items() if named.get(path[-1]) in ("observation", "state")]
    if not seen:
        names = ", ".join(".".join(path) for path in leaves)
        raise UserError(f"no key of the TensorDict is an observation or a state; name its role, it has {names}")
    transforms, copies = choose(seen[0]), []
    for transform in transforms:
        copy, first_id = data.clone(False), -(next(_COPY_NUMBERS) << 32)
        for path, value in kept.items():
            role = named.get(path[-1])
            if role == "trajectory":
                moved = value.long() + first_id  # below 0, where no trajectory of a collector is
            else:
                moved = _moved(spaces, transform, value, role, data.batch_size, ".".join(path))
            copy.set(path, moved)
        copies.append(copy)
    return [data, *copies], transforms


def _moved(spaces: Spaces, transform: Transform, x: Tensor, role: Role | None, lead: torch.Size, name: str) -> Tensor:
    """Return the numbers of one key in a copy."""
    try:
        if role == "observation":
            lead_of(spaces, x)
            return transform.obs(x)
        if role == "state":
            check_state(spaces, x)
            return transform.state(x)
        if role == "action":
            # a group of one agent has an agent axis all the same
            alone = spaces.num_agents == 1 and x.shape[len(lead) : -1] == (1,)
            return act(spaces, transform, x, torch.Size((*lead, 1)) if alone else lead)
        return x if role == "same" else carry(spaces, transform.per_agent, x, lead, "it")
    except UserError as error:
        advice = "" if role else "; name its role, 'same' or 'drop' for example"
        raise UserError(f"the key {name} of the TensorDict does not fit: {error}{advice}") from None


def _path(key: Key) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else key
