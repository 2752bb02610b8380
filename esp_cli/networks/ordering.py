"""Things of a row in the order of their distance, so that a network that knows no sets sees alike things alike."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from esp_cli.networks.contract import IoSpec, Network, WithVJP
from esp_cli.networks.kernels.library import begin, computes
from esp_cli.networks.kernels.sets import sort_things
from esp_envs.errors import UserError
from esp_envs.spec import Family, Field, Kind, Layout


def items_of(fields: Iterable[Field]) -> Iterator[tuple[Field, int]]:
    """Give the field of each item of fields side by side, and its first column; of a record, those of its parts."""
    start = 0
    for field in fields:
        for _ in range(field.count):
            parts = items_of(field.parts) if field.kind == Kind.RECORD else [(field, 0)]
            yield from ((part, start + column) for part, column in parts)
            start += field.item_width


def fields_of_one(family: Family) -> list[Field]:
    """Return the fields of one thing."""
    return [replace(field, count=1) for field, _ in family.parts]


def place_of(family: Family) -> int | None:
    """Return the column of a thing's numbers at which its place begins: a point, else its first planar vector."""
    items = items_of(fields_of_one(family))
    columns = [(not field.is_point, column) for field, column in items if field.kind == Kind.VECTOR]
    return min(columns)[1] if columns else None


def reader_of(layout: Layout, family: Family) -> int | None:
    """Return the column of the reader's own place, where things are points; None where it is the origin."""
    own = [part.where.start for part in layout.own if part.field.is_point]
    points = any(field.is_point for field, _ in items_of(fields_of_one(family)))
    return own[0] if own and points else None


def joined(x: Tensor, family: Family) -> Tensor:
    """Return the numbers of a family's things [..., K, W] in rows x [..., D]."""
    parts = [x[..., where].unflatten(-1, (family.count, -1)) for _, where in family.parts]
    return parts[0] if len(parts) == 1 else torch.cat(parts, -1)


def ways_to(things: Tensor, x: Tensor, at: int, reader: int | None) -> Tensor:
    """Return the ways [..., K, 2] from the reader of rows x to things whose places begin at number `at`."""
    return things[..., at : at + 2] - (0 if reader is None else x[..., None, reader : reader + 2])


class NearestFirst(Network):
    """A network that reads observations with the things of each family sorted by distance, which no turn changes.

    With landmarks [3, 4] and [0, 1] it reads [0, 1] first. Numbers behind an observation, and a global state, stay.
    """

    def __init__(self, network: Network, io: IoSpec, compiled: bool) -> None:
        super().__init__()
        self.network, self.memory_width, self.team = network, network.memory_width, network.team
        self.layout, self.joint, self.compiled = io.spaces.observation, io.reads == "observations", compiled
        self.families = [
            (joined(torch.arange(self.layout.width), family), at, reader_of(self.layout, family))
            for family in self.layout.families
            if io.reads != "state" and (at := place_of(family)) is not None
        ]
        if not self.families and io.num_values is None:
            raise UserError(
                f"network.order=nearest sorts like things by distance, but {io.spaces.label} shows none with a place; "
                "say which fields are some (Field.family), or leave it off"
            )
        if compiled:
            begin("sets")

    def step(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        return self.network.step(self.sorted(x), memory)

    def unroll(self, x: Tensor, truncation: int = 0) -> Tensor:
        return self.network.unroll(self.sorted(x), truncation)

    def unroll_agents(self, x: Tensor, truncation: int = 0) -> Tensor:
        return self.network.unroll_agents(self.sorted(x), truncation)

    def with_vjp(self, x: Tensor, shape: Sequence[int], truncation: int = 0, defer: bool = True) -> WithVJP:
        return self.network.with_vjp(self.sorted(x), shape, truncation, defer=False)

    @torch.no_grad()
    def sorted(self, x: Tensor) -> Tensor:
        """Return rows [..., D], of several observations side by side each by itself, with their things sorted."""
        if not self.families:
            return x
        y = x.clone(memory_format=torch.contiguous_format)
        rows = y.view(-1, self.layout.width if self.joint else x.shape[-1])
        for columns, at, reader in self.families:
            if computes(self.compiled, x):
                sort_things(rows, columns, at, reader)
                continue
            where = columns.to(x.device)
            things = rows[:, where]
            order = ways_to(things, rows, at, reader).square().sum(-1).argsort(stable=True, dim=-1)
            rows[:, where] = things.gather(1, order.unsqueeze(-1).expand_as(things))
        return y
