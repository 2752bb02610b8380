"""Transformed copies of TensorDicts, whose keys say what their numbers are."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import count
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from esp_cli.loop.shapes import CheckedTransform, check_state, lead_of
from esp_envs.errors import UserError

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
    data: Any,
    choose: Callable[[Tensor, torch.Size], list[CheckedTransform]],
    roles: Mapping[str, Role] | None = None,
) -> tuple[list[Any], list[CheckedTransform]]:
    """Return the data, less what is dropped, with its copies behind it, and the element of each copy.

    The TensorDict [B, ...] has agents in nested groups or not, also below "next". `choose` returns the elements for
    a tensor's device and leading axes, and `roles` are of keys by their last part, where they differ from `ROLES`.
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
    transforms, copies = choose(seen[0], data.batch_size), []
    for transform in transforms:
        copy, first_id = data.clone(False), -(next(_COPY_NUMBERS) << 32)
        for path, value in kept.items():
            role = named.get(path[-1])
            own = role == "trajectory"  # below 0, where no trajectory of a collector is
            copy.set(path, value.long() + first_id if own else _moved(transform, value, role, ".".join(path)))
        copies.append(copy)
    return [data, *copies], transforms


def _moved(transform: CheckedTransform, x: Tensor, role: Role | None, name: str) -> Tensor:
    """Return the numbers of one key in a copy."""
    spaces, lead = transform.spaces, transform.lead
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
            return (replace(transform, lead=torch.Size((*lead, 1))) if alone else transform).action(x)
        return x if role == "same" else transform.per_agent(x, "it")
    except UserError as error:
        advice = "" if role else "; name its role, 'same' or 'drop' for example"
        raise UserError(f"the key {name} of the TensorDict does not fit: {error}{advice}") from None


def _path(key: Key) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else key
