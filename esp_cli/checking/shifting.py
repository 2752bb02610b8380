"""Shifts of all places alike, which leave a task with `Spaces.shifts` as it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from esp_envs.errors import UserError
from esp_envs.spec import Field, Layout, Spaces

SHIFT = "shift"  # its name as a check takes it; no prior needs it, as networks over sets see no place of such a task
_BY = (1.2361, -0.7639)  # in the unit of a place: no multiple of what floors are tiled in


@dataclass(frozen=True, eq=False)
class Shift:
    """Moves every place (`Field.is_point`) of a task by (1.2361, -0.7639); actions, vectors and agents stay."""

    spaces: Spaces
    name: str = SHIFT
    orders: tuple[tuple[str, tuple[int, ...]], ...] = ()

    def __post_init__(self) -> None:
        if not _points(self.spaces.state.fields):
            raise UserError(
                f"no shift can be tried on {self.spaces.label}: no field of its state is a place; say which are "
                "(Field.is_point)"
            )

    def state(self, state: Tensor) -> Tensor:
        return _shifted(state, self.spaces.state)

    def obs(self, obs: Tensor) -> Tensor:
        return _shifted(obs, self.spaces.observation)

    def action(self, action: Tensor) -> Tensor:
        return action

    push_outputs = per_agent = action


def _shifted(rows: Tensor, layout: Layout) -> Tensor:
    out = rows.clone()
    for column in _points(layout.fields):
        out[..., column : column + 2] += torch.tensor(_BY, device=rows.device)
    return out


def _points(fields: Sequence[Field]) -> list[int]:
    """Return the columns of rows at which places begin."""
    found, start = list[int](), 0
    for field in fields:
        for item in range(field.count):
            begin = start + item * field.item_width
            within = _points(field.parts) if field.parts else [0] * field.is_point
            found += [begin + column for column in within]
        start += field.width
    return found
