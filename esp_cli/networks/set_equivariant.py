"""A network over sets that commutes with every turn and mirror of the plane, with any weights.

Planar vectors enter by what neither turns nor mirrors change: their lengths and inner products, beside distances
between things. A discrete action along a direction is valued by a network that also reads each vector's component along
that direction, the same for all directions. A force is a sum of vectors that came in, weighed by unchanged numbers
(scalars that multiply vectors: Villar et al., 2021).

Shape letters: S seeds, B rows, K things of a family, V vectors, H features, A actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from esp_cli.networks.contract import Generators, IoSpec, Memoryless, Network
from esp_cli.networks.layers import SeedLinear, SeedMLP
from esp_cli.networks.ordering import fields_of_one, items_of
from esp_cli.networks.set_features import Rows, TeamFeatures
from esp_cli.networks.sets import SetConfig, SetNetwork, sets_or_refuse
from esp_envs.errors import UserError
from esp_envs.spec import Discrete, Field, Kind, Layout

_SUMS = 4  # weighted sums of each vector of a family
_SMALLEST_SQUARE = 1e-12  # keeps the slope of a length finite at 0


class SetEquivariantConfig(SetConfig):
    """The settings of the equivariant network over sets."""

    name: Literal["set-equivariant"] = "set-equivariant"  # type: ignore[assignment]

    def build(
        self, generators: Generators, inputs: int, outputs: int, output_gain: float, io: IoSpec | None
    ) -> Network:
        io = sets_or_refuse(self.name, self.io_or_refuse(io))
        if self.memory:
            raise UserError("set-equivariant remembers nothing; use set with network.memory")
        action = io.spaces.action
        kinds = {action.kind} if isinstance(action, Discrete) else {field.kind for field in action.layout.fields}
        if io.num_values is None and kinds != {Kind.VECTOR}:
            raise UserError("set-equivariant acts along directions of the plane; use set for other actions")
        ways = {point for point in action.points if any(point)} if isinstance(action, Discrete) else ()
        io.group(f"d{len(ways)}" if ways and kinds == {Kind.VECTOR} else "d4")  # refused where the task has it not
        if io.num_values is not None:
            return SetNetwork(generators, io, outputs, self, output_gain)
        if isinstance(action, Discrete):
            for k, point in enumerate(action.points):
                if (first := action.points.index(point)) < k:
                    raise UserError(
                        f"set-equivariant tells actions apart by their directions, and '{action.names[first]}' and "
                        f"'{action.names[k]}' have the same; use set"
                    )
            return DirectionActor(generators, io, self, output_gain)
        return ForceActor(generators, io, self, action.layout.width // 2, output_gain)

    @property
    def rows(self) -> type[Rows]:
        return InvariantRows


def _columns(fields: Sequence[Field]) -> tuple[list[int], list[int]]:
    """Return the columns at which vectors begin, and those of scalars, of the items of fields side by side."""
    vectors, scalars = list[int](), list[int]()
    for field, column in items_of(fields):
        if field.kind not in (Kind.VECTOR, Kind.SCALAR):
            raise UserError(f"set-equivariant reads vectors and scalars, but '{field.name}' is a {field.kind.name}")
        (vectors if field.kind == Kind.VECTOR else scalars).append(column)
    return vectors, scalars


class InvariantRows(Rows):
    """Splits rows into numbers that neither turns nor mirrors change; see `Rows`.

    With A directions [S, B, .] become [S, B A, .], with each vector's component along one, and whether it is one.
    """

    def __init__(
        self, layout: Layout, shifts: bool, near: int, compiled: bool, points: Sequence[Sequence[float]] = ()
    ) -> None:
        super().__init__(layout, shifts, near, compiled)
        self.own_columns = _columns([part.field for part in layout.own if part.where in self.own])
        self.columns = [_columns(fields_of_one(family)) for family in self.families]
        count = len(self.own_columns[0])
        self.num_own = len(self.own_columns[1]) + count * (count + 3) // 2
        far = [width - family.width for width, family in zip(self.widths, self.families, strict=True)]
        # of a thing: its inner products with itself and with the own vectors
        self.widths = [
            len(scalars) + further + len(vectors) * (len(vectors) + 3) // 2 + len(vectors) * count
            for (vectors, scalars), further in zip(self.columns, far, strict=True)
        ]
        self.points = torch.tensor(points) if points else None  # directions [A, 2]
        if points:
            self.num_own += count + 1
            self.widths = [width + len(of) for width, (of, _) in zip(self.widths, self.columns, strict=True)]

    def split(self, x: Tensor) -> tuple[Tensor, list[list[Tensor]]]:
        own, things = self.numbers(x)
        vectors = _picked(own, self.own_columns[0])
        invariants = torch.cat([own[..., self.own_columns[1]], *_products(vectors)], -1)
        parts, families = [], []
        for numbers, (of, scalars), far in zip(things, self.columns, self.distances(things), strict=True):
            families.append(_picked(numbers, of))
            across = torch.einsum("sbkvd,sbwd->sbkvw", families[-1], vectors).flatten(3)
            parts.append([numbers[..., scalars], *_products(families[-1]), across, *far])
        if self.points is None:
            return invariants, parts
        points = self.points.to(x.device)
        moves = points.square().sum(-1).expand(*x.shape[:2], -1).unsqueeze(-1)
        own = torch.cat([_each(invariants, len(points)), torch.einsum("sbvd,ad->sbav", vectors, points), moves], -1)
        for part, mine in zip(parts, families, strict=True):
            part[:] = [_each(numbers, len(points)).flatten(1, 2) for numbers in part]
            part.append(torch.einsum("sbkvd,ad->sbakv", mine, points).flatten(1, 2))
        return own.flatten(1, 2), parts


def _each(x: Tensor, count: int) -> Tensor:
    """Return [S, B, ...] once for each direction: [S, B, A, ...]."""
    return x.unsqueeze(2).expand(-1, -1, count, *x.shape[2:])


def _picked(numbers: Tensor, columns: Sequence[int]) -> Tensor:
    """Return the vectors [..., V, 2] that begin at columns of numbers [..., W]."""
    return (
        torch.stack([numbers[..., c : c + 2] for c in columns], -2)
        if columns
        else numbers[..., :0].unflatten(-1, (0, 2))
    )


def _products(vectors: Tensor) -> list[Tensor]:
    """Return inner products [..., V (V + 1) / 2] and lengths [..., V] of vectors [..., V, 2]."""
    count = vectors.shape[-2]
    first, second = torch.triu_indices(count, count, device=vectors.device)
    products = (vectors[..., first, :] * vectors[..., second, :]).sum(-1)
    return [products, (vectors.square().sum(-1) + _SMALLEST_SQUARE).sqrt()]


class DirectionActor(Memoryless):
    """A number for each direction, by one network over sets that reads all vectors along that direction."""

    def __init__(self, generators: Generators, io: IoSpec, config: SetConfig, output_gain: float) -> None:
        super().__init__()
        action = io.spaces.action
        assert isinstance(action, Discrete)
        compiled = config.compiled is True
        rows = InvariantRows(io.layout, io.spaces.shifts, config.near, compiled, action.points)
        self.network = SetNetwork(generators, io, 1, config, output_gain, rows)

    def forward(self, x: Tensor) -> Tensor:
        return self.network(x).unflatten(1, (x.shape[1], -1)).squeeze(-1)


class ForceActor(Memoryless):
    """Planar vectors that are weighed sums of those that are seen."""

    def __init__(self, generators: Generators, io: IoSpec, config: SetConfig, forces: int, output_gain: float) -> None:
        super().__init__()
        self.features = TeamFeatures(generators, io, config)
        rows = self.features.encoder.rows
        assert isinstance(rows, InvariantRows)
        self.rows, counts = rows, [len(vectors) for vectors, _ in rows.columns]
        self.weigh = nn.ModuleList(
            SeedLinear(generators, config.width, _SUMS * count, 1.0) for count in counts if count
        )
        num_vectors = _SUMS * sum(counts) + len(rows.own_columns[0])
        if not num_vectors:
            raise UserError("set-equivariant makes forces of vectors, and none is seen; use set")
        sizes = (self.features.width + num_vectors, *config.hidden, forces * num_vectors)
        self.head = SeedMLP(generators, sizes, config.activation, output_gain, compiled=config.compiled is True)

    def forward(self, x: Tensor) -> Tensor:
        parts, vectors = self._seen(x)
        lengths = (vectors.square().sum(-1) + _SMALLEST_SQUARE).sqrt()
        weights = self.head(*parts, lengths).unflatten(-1, (-1, vectors.shape[2]))
        return (weights @ vectors).flatten(2)

    def _seen(self, x: Tensor) -> tuple[list[Tensor], Tensor]:
        """Return parts of invariant features [S, B, .], and vectors [S, B, V, 2]."""
        parts, embedded = self.features.encoder(x, [*self.features.encoder.embed])
        own, things = self.rows.numbers(x)
        vectors, layers = [_picked(own, self.rows.own_columns[0])], iter(self.weigh)
        for numbers, features, (of, _) in zip(things, embedded, self.rows.columns, strict=True):
            if of:
                mine = _picked(numbers, of)
                scores = next(layers)(features.flatten(1, 2)).view(*mine.shape[:3], _SUMS, len(of))
                vectors.append(torch.einsum("sbkcv,sbkvd->sbcvd", scores.softmax(2), mine).flatten(2, 3))
        return parts, torch.cat(vectors, 2)
