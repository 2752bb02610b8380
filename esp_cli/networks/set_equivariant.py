"""A network over sets that commutes with every turn and mirror of the plane, with any weights.

Planar vectors enter by what neither turns nor mirrors change: their lengths and inner products, beside distances
between things. Vectors leave as sums of vectors that came in, weighed by such numbers (scalars that multiply vectors:
Villar et al., 2021). An action is valued by its direction's inner products with these sums.

Shape letters: S seeds, B rows, K things of a family, V vectors, H features, A actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from esp_cli.networks.contract import Memoryless, Network
from esp_cli.networks.io_spec import IoSpec
from esp_cli.networks.layers import SeedLinear, SeedMLP
from esp_cli.networks.set_features import Rows, SetShape, TeamFeatures
from esp_cli.networks.sets import SetConfig, SetNetwork, sets_or_refuse
from esp_envs.errors import UserError
from esp_envs.spec import Discrete, Field, Kind, Layout

_SUMS = 4  # weighted sums of each vector of a family
_SMALLEST_SQUARE = 1e-12  # keeps the slope of a length finite at 0


class SetEquivariantConfig(SetConfig):
    """The settings of the equivariant network over sets."""

    name: Literal["set-equivariant"] = "set-equivariant"  # type: ignore[assignment]

    def build(
        self, generators: Sequence[torch.Generator], inputs: int, outputs: int, output_gain: float, io: IoSpec | None
    ) -> Network:
        """Build an equivariant network over sets, an invariant one of values; see `NetworkConfig.build`.

        Raises:
            UserError: an actor whose observation shows no like things, or actions that are no planar directions.
        """
        io = sets_or_refuse(self.name, self.io_or_refuse(io))
        if io.num_values is not None:
            return SetNetwork(generators, io, outputs, self, output_gain)
        return EquivariantActor(generators, io, self, output_gain)

    @property
    def rows(self) -> type[Rows]:
        """What splits the rows of such a network."""
        return InvariantRows


def _columns(fields: Sequence[Field]) -> tuple[list[int], list[int]]:
    """Return the columns at which vectors begin, and those of scalars, of the items of fields side by side.

    Raises:
        UserError: another kind.
    """
    vectors, scalars, start = list[int](), list[int](), 0
    for field in fields:
        if field.kind == Kind.RECORD:
            inner = _columns(field.parts)
            vectors += [start + column for column in inner[0]]
            scalars += [start + column for column in inner[1]]
            start += field.item_width
            continue
        if field.kind not in (Kind.VECTOR, Kind.SCALAR):
            raise UserError(f"set-equivariant reads vectors and scalars, but '{field.name}' is a {field.kind.name}")
        for _ in range(field.count):
            (vectors if field.kind == Kind.VECTOR else scalars).append(start)
            start += field.kind.width
    return vectors, scalars


class InvariantRows(Rows):
    """Splits rows into numbers that neither turns nor mirrors change; see `Rows`."""

    def __init__(self, layout: Layout, shifts: bool, near: int, compiled: bool) -> None:
        super().__init__(layout, shifts, near, compiled)
        self.own_columns = _columns([part.field for part in layout.own if part.where in self._own])
        one = [[_one(part.field) for part in family.parts] for family in self.families]
        self.columns = [_columns(fields) for fields in one]
        count = len(self.own_columns[0])
        self.num_own = len(self.own_columns[1]) + count * (count + 3) // 2
        far = [width - family.width for width, family in zip(self.widths, self.families, strict=True)]
        # of a thing: its inner products with itself and with the own vectors
        self.widths = [
            len(scalars) + further + len(vectors) * (len(vectors) + 3) // 2 + len(vectors) * count
            for (vectors, scalars), further in zip(self.columns, far, strict=True)
        ]

    def split(self, x: Tensor) -> tuple[Tensor, list[list[Tensor]]]:
        """Return own invariants [S, B, d] and each family's parts [S, B, K, .] of rows x [S, B, D]."""
        own, things = self.numbers(x)
        vectors = _picked(own, self.own_columns[0])
        invariants = torch.cat([own[..., self.own_columns[1]], *_products(vectors)], -1)
        parts = []
        for numbers, (of, scalars), far in zip(things, self.columns, self.distances(things), strict=True):
            mine = _picked(numbers, of)
            across = torch.einsum("sbkvd,sbwd->sbkvw", mine, vectors).flatten(3)
            parts.append([numbers[..., scalars], *_products(mine), across, *far])
        return invariants, parts


def _one(field: Field) -> Field:
    """Return a field with one item."""
    return Field(field.name, field.kind, 1, field.unit, parts=field.parts)


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


class EquivariantActor(Memoryless):
    """Outputs that turn and mirror with what is seen: a number for each direction, or a vector.

    Raises:
        UserError: actions that are neither planar directions nor planar vectors.
    """

    def __init__(self, generators: Sequence[torch.Generator], io: IoSpec, config: SetShape, output_gain: float) -> None:
        super().__init__()
        action = io.spaces.action
        kinds = {action.kind} if isinstance(action, Discrete) else {f.kind for f in action.layout.fields}
        if kinds != {Kind.VECTOR}:
            raise UserError("set-equivariant acts along directions of the plane; use set for other actions")
        self.features = TeamFeatures(generators, io, config)
        rows = self.features.encoder.rows
        assert isinstance(rows, InvariantRows)
        self.rows, width = rows, config.width
        counts = [len(vectors) for vectors, _ in rows.columns]
        self.weigh = nn.ModuleList(SeedLinear(generators, width, _SUMS * count, 1.0) for count in counts if count)
        num_vectors = _SUMS * sum(counts) + len(rows.own_columns[0])
        inputs = self.features.width + num_vectors
        self.points: Tensor | None
        points = torch.tensor(action.points) if isinstance(action, Discrete) else None
        self.register_buffer("points", points, False)
        if isinstance(action, Discrete):
            inputs, outputs = inputs + num_vectors + 1, 1
        else:
            outputs = action.layout.width // 2 * num_vectors
        sizes = (inputs, *config.hidden, outputs)
        self.head = SeedMLP(generators, sizes, config.activation, output_gain, compiled=config.compiled is True)

    def forward(self, x: Tensor) -> Tensor:
        """Map [S, B, in] to [S, B, out]."""
        parts, vectors = self._seen(x)
        lengths = (vectors.square().sum(-1) + _SMALLEST_SQUARE).sqrt()
        if self.points is None:
            weights = self.head(*parts, lengths).unflatten(-1, (-1, vectors.shape[2]))
            return (weights @ vectors).flatten(2)
        along = torch.matmul(vectors, self.points.t()).transpose(2, 3)  # [S, B, A, V]
        still = (self.points.square().sum(-1, keepdim=True) == 0).to(x.dtype).expand(*along.shape[:3], 1)
        same = [part.unsqueeze(2).expand(-1, -1, len(self.points), -1) for part in (*parts, lengths)]
        return self.head(*same, along, still).squeeze(-1)

    def _seen(self, x: Tensor) -> tuple[list[Tensor], Tensor]:
        """Return parts of invariant features [S, B, .], and vectors [S, B, V, 2]."""
        parts, embedded = self.features.encoder(x)
        own, things = self.rows.numbers(x)
        vectors, layers = [_picked(own, self.rows.own_columns[0])], iter(self.weigh)
        for numbers, features, (of, _) in zip(things, embedded.values(), self.rows.columns, strict=True):
            if of:
                mine = _picked(numbers, of)
                scores = next(layers)(features.flatten(1, 2)).view(*mine.shape[:3], _SUMS, len(of))
                sums = torch.einsum("sbkcv,sbkvd->sbcvd", scores.softmax(2), mine)
                vectors.append(sums.flatten(2, 3))
        return parts, torch.cat(vectors, 2)
