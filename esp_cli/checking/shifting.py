"""Shifts of all places alike, which leave a task with `Spaces.shifts` as it is, and what moves nothing at all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from esp_cli.symmetry import Element
from esp_envs.errors import UserError
from esp_envs.spec import Field, Kind, Spaces

SHIFT = "shift"  # its name as a check takes it; no prior needs it, as networks over sets see no place of such a task
_BY = [1.2361, -0.7639]  # in the unit of a place: no multiple of what floors are tiled in


class Unmoved:
    """Leaves everything as it is, where a `Transform` moves it."""

    elements = (Element(),)

    def obs(self, x: Tensor) -> Tensor:
        return x

    state = action = push_outputs = per_agent = obs


class Shift(Unmoved):
    """Moves every place (`Field.is_point`) of a task by (1.2361, -0.7639); actions, vectors and agents stay."""

    name, orders = SHIFT, ()

    def __init__(self, spaces: Spaces) -> None:
        self._seen, self._held = (torch.tensor(_ways(part.fields)) for part in (spaces.observation, spaces.state))
        if not self._held.any():
            raise UserError(
                f"no shift can be tried on {spaces.label}: no field of its state is a place; say which are "
                "(Field.is_point)"
            )

    def state(self, x: Tensor) -> Tensor:
        return x + self._held.to(x.device)

    def obs(self, x: Tensor) -> Tensor:
        return x + self._seen.to(x.device)


def _ways(fields: Sequence[Field]) -> list[float]:
    """Return how far each number of a row is moved."""
    moved = ((_BY if part.is_point else [0.0, 0.0], where.stop - where.start) for part, where in leaves(fields))
    return [way[k % 2] for way, width in moved for k in range(width)]


def leaves(fields: Sequence[Field], start: int = 0) -> Iterator[tuple[Field, slice]]:
    """Yield the fields that a row consists of, and where; records fall into their parts, item by item."""
    for field in fields:
        if field.kind == Kind.RECORD:
            for item in range(start, start + field.width, field.item_width):
                yield from leaves(field.parts, item)
        else:
            yield field, slice(start, start + field.width)
        start += field.width
