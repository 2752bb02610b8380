"""Features of rows that show sets of like things; see `sets`.

Shape letters: S seeds, B rows, N agents, K things of a family, W numbers and H features of one, P features of a row.
"""

from __future__ import annotations

from abc import ABC
from collections.abc import Sequence
from functools import partial
from typing import Annotated, ClassVar

import torch
from pydantic import Field as Setting
from torch import Tensor, nn

from esp_cli.networks.contract import ActivationName, Generators, IoSpec
from esp_cli.networks.kernels.library import begin, computes
from esp_cli.networks.kernels.sets import PooledPass, compiled_distances
from esp_cli.networks.layers import GAINS, SeedMLP
from esp_cli.networks.ordering import joined, place_of, reader_of, ways_to
from esp_cli.networks.perceptron import passed
from esp_cli.networks.plain import CompiledConfig
from esp_envs.errors import UserError
from esp_envs.spec import Items, Layout


class SetShape(CompiledConfig, ABC):
    """The settings of networks over sets."""

    free_of_counts: ClassVar[bool] = True

    activation: ActivationName = Setting("relu", description="of the actor")
    hidden: tuple[Annotated[int, Setting(ge=1, le=4096)], ...] = Setting(
        (64,), min_length=1, max_length=16, description="hidden widths behind the sets"
    )
    width: int = Setting(32, ge=1, le=4096, description="features of each thing of a set")
    near: int = Setting(
        0, ge=0, le=4096, description="how many of each set an agent looks at, the nearest ones; 0: all of them"
    )

    @property
    def rows(self) -> type[Rows]:
        return Rows


class Rows:
    """Splits rows into the own numbers and the numbers of the things of each family, in parts that stand side by side.

    Where a task does not change when it is shifted, `places` are taken from the middle of all places of a row. `near`
    things of each family are read, the nearest to the reader, to its own place where they are points; 0 for all. `own`
    says where the own numbers lie, of which `num_own` are read; `offsets` for each family the number at which a thing's
    place begins, `readers` where the reader's does, None where it is the origin, and `widths` W.
    """

    def __init__(self, layout: Layout, shifts: bool, near: int, compiled: bool) -> None:
        parts = [*layout.own, *(part for family in layout.families for part in family.parts)]
        places = [part.where for part in parts if shifts and part.field.is_point]
        alone = places if sum(where.stop - where.start for where in places) == 2 else []
        self.places = [] if alone else places  # a single one, taken from itself, says nothing
        self.own = [part.where for part in layout.own if part.where not in alone]
        self.num_own = sum(where.stop - where.start for where in self.own)
        self.layout, self.near, self.compiled = layout, near, compiled
        self.families = layout.families
        self.offsets = [place_of(family) for family in layout.families]
        self.readers = [reader_of(layout, family) for family in layout.families]
        located = sum(at is not None for at in self.offsets)
        each = zip(self.families, self.offsets, strict=True)
        self.widths = [family.width + (0 if at is None else 1 + located) for family, at in each]

    def split(self, x: Tensor) -> tuple[Tensor, list[list[Tensor]]]:
        """Return the own numbers [S, B, d] and each family's parts [S, B, K, .] of rows x [S, B, D]."""
        own, things = self.numbers(x)
        return own, [[numbers, *far] for numbers, far in zip(things, self.distances(things), strict=True)]

    def numbers(self, x: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Return the own numbers [S, B, d] and those of the things of each family [S, B, K, .], undescribed."""
        x = self._from_the_middle(x) if self.places else x
        own = torch.cat([x[..., where] for where in self.own], -1) if self.own else x[..., :0]
        things = []
        for family, at, reader in zip(self.families, self.offsets, self.readers, strict=True):
            numbers = joined(x, family)
            if at is not None and 0 < self.near < family.count:
                numbers = nearest_things(numbers, ways_to(numbers, x, at, reader), self.near)
            things.append(numbers)
        return own, things

    def distances(self, things: Sequence[Tensor]) -> list[list[Tensor]]:
        """Return for each family the distances of its things, [S, B, K, .], or nothing where they have no place."""
        each = zip(things, self.offsets, strict=True)
        places = [numbers[..., at : at + 2] for numbers, at in each if at is not None]
        compiled = bool(places) and computes(self.compiled, places[0])
        found = iter((compiled_distances if compiled else distances_among)(places) if places else [])
        return [[] if at is None else [next(found)] for at in self.offsets]

    def _from_the_middle(self, x: Tensor) -> Tensor:
        places = torch.cat([x[..., where] for where in self.places], -1)
        middle, x = places.unflatten(-1, (-1, 2)).mean(-2), x.clone()
        for where in self.places:
            x[..., where] -= middle.repeat(1, 1, (where.stop - where.start) // 2)
        return x


def nearest_things(things: Tensor, ways: Tensor, count: int) -> Tensor:
    """Return the things [S, B, K, W] with the shortest ways [S, B, K, 2] to them."""
    which = ways.square().sum(-1).topk(count, -1, largest=False, sorted=False).indices
    return things.gather(2, which.unsqueeze(-1).expand(-1, -1, -1, things.shape[-1]))


def distances_among(places: Sequence[Tensor]) -> list[Tensor]:
    """Describe the places [S, B, K, 2] of things of F families by distances, which neither turns nor mirrors change.

    For each family these are [S, B, K, 1 + F]: the distance of a thing, and that between it and the nearest other thing
    of each family; where there is no other, twice the largest distance of any thing.
    """
    described, farthest = [], 4 * torch.cat([*places], 2).square().sum(-1).amax(2, keepdim=True)
    for i, first in enumerate(places):
        columns = [first.square().sum(-1).sqrt()]
        for j, second in enumerate(places):
            square = (first.unsqueeze(3) - second.unsqueeze(2)).square().sum(-1)
            if i == j:
                itself = torch.eye(first.shape[2], dtype=torch.bool, device=first.device)
                square = square.masked_fill(itself, torch.inf)
            least = square.amin(3)
            columns.append(torch.where(least.isinf(), farthest, least).sqrt())
        described.append(torch.stack(columns, -1))
    return described


class Embedding(SeedMLP):
    """A perceptron that ends with an activation, shared by like things."""

    def __init__(self, generators: Generators, sizes: Sequence[int], config: SetShape) -> None:
        name = config.activation
        super().__init__(generators, sizes, name, GAINS[name], activate_output=True, compiled=config.compiled is True)

    def pooled(self, *parts: Tensor, each: bool = False) -> tuple[Tensor, Tensor | None]:
        """Return mean and maximum over the embedded things [S, B, K, .] of sets: [S, B, 2H], and where asked each."""
        if computes(self.compiled, parts[0]):
            found = passed(partial(PooledPass, self.activation, each), parts, self._from(0))
            return found if each else (found, None)
        things = self(*parts)
        return torch.cat([things.mean(2), things.amax(2)], -1), things


class SetEncoder(nn.Module):
    """Features [S, B, width] of rows that show sets."""

    def __init__(self, generators: Generators, rows: Rows, config: SetShape) -> None:
        super().__init__()
        self.rows, features = rows, config.width
        self.own = Embedding(generators, (rows.num_own, features), config) if rows.num_own > features else None
        self.num_own = features if self.own else rows.num_own
        self.embed = nn.ModuleDict()
        for family, width in zip(rows.families, rows.widths, strict=True):
            embedding = Embedding(generators, (width + self.num_own, features, features), config)
            try:
                self.embed[family.name] = embedding
            except KeyError:  # it cannot be part of a weight's name
                raise UserError(
                    f"a network over sets cannot have things named '{family.name}'; give this field another name"
                ) from None
        self.width = self.num_own + 2 * features * len(rows.families)

    def forward(self, x: Tensor, each: Sequence[str] = ()) -> tuple[list[Tensor], list[Tensor]]:
        """Map rows x [S, B, D] to parts of their features [S, B, P], and to features [S, B, K, H] of some families."""
        own, things = self.rows.split(x)
        own = own if self.own is None else self.own(own)
        features, embedded = [own], []
        for (name, embed), parts in zip(self.embed.items(), things, strict=True):
            assert isinstance(embed, Embedding)
            beside = own.unsqueeze(2).expand(-1, -1, parts[0].shape[2], -1)
            pooled, found = embed.pooled(*parts, beside, each=name in each)
            features.append(pooled)
            if found is not None and name in each:
                embedded.append(found)
        return features, embedded


class TeamFeatures(nn.Module):
    """Features, `width` a row, of what a network reads, and of each agent in it.

    What reads all observations in a row embeds each as an agent's, and takes the agents as a set.
    """

    def __init__(
        self, generators: Generators, io: IoSpec, config: SetShape, beside: int = 0, rows: Rows | None = None
    ) -> None:
        super().__init__()
        spaces, compiled, joint = io.spaces, config.compiled is True, io.reads == "observations"
        if compiled:
            begin("sets")
        layout = io.layout if io.reads == "state" else spaces.observation
        rows = rows or config.rows(layout, spaces.shifts, 0 if io.reads == "state" else config.near, compiled)
        self.encoder = SetEncoder(generators, rows, config)
        self.num_agents = spaces.num_agents if joint else 0
        of_agents = (f.name for f in layout.families if any(part.field.items is Items.AGENTS for part in f.parts))
        self.each = next(of_agents, "") if io.reads == "state" else ""
        inputs = self.encoder.width if joint else config.width * (beside > 0)
        self.agents = Embedding(generators, (inputs + beside, config.width), config) if inputs else None
        self.width = self.encoder.width * (not joint) + 2 * config.width * (self.agents is not None)

    def forward(self, x: Tensor, *beside: Tensor, each: bool = False) -> tuple[list[Tensor], Tensor | None]:
        """Map rows x [S, B, in] and numbers beside agents to features [S, B, .], and where asked each agent's."""
        if not self.num_agents:
            own = [self.each] if self.each and (each or self.agents is not None) else []
            parts, found = self.encoder(x, own)
            if self.agents is None:
                return parts, found[0] if own else None
            pooled, agents = self.agents.pooled(*found, *beside, each=each)
            return [*parts, pooled], agents
        seen, _ = self.encoder(x.unflatten(-1, (self.num_agents, -1)).flatten(1, 2))
        assert self.agents is not None
        along_agents = (part.unflatten(1, (-1, self.num_agents)) for part in seen)
        pooled, agents = self.agents.pooled(*along_agents, *beside, each=each)
        return [pooled], agents

    def each_or_refuse(self, io: IoSpec) -> None:
        if not (self.num_agents or self.each):
            raise UserError(
                f"set looks at each agent by itself, but the state of {io.spaces.label} does not say which numbers are "
                "whose; set the critic's input to observations"
            )


def along(parts: Sequence[Tensor], agents: Tensor) -> list[Tensor]:
    """Return features of rows [S, B, .] beside each agent [S, B, N, H]: [S, B, N, .]."""
    return [part.unsqueeze(2).expand(-1, -1, agents.shape[2], -1) for part in parts]
