"""A network over sets: like things enter by shared weights, so that neither their order nor their number matters.

A row is the own numbers and families of like things (`Layout.families`). Each thing is described by its numbers, its
distance, and that between it and the nearest thing of each family; a perceptron that its family shares embeds it beside
the own numbers. Mean and maximum over each family, and the own numbers, enter a perceptron (deep sets, Zaheer et al.,
2017). The distances between things take the place of attention among them: a landmark that another agent is nearer to
is worth less, and to know that costs a subtraction a pair.

Shape letters: S seeds, B rows, N agents, K things of a family, W numbers of one, H features of one, P pooled features.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import torch
from pydantic import Field as Setting
from torch import Tensor, nn

from esp_cli.networks.contract import ActivationName, Memoryless, Network
from esp_cli.networks.io_spec import IoSpec
from esp_cli.networks.kernels.library import begin, computes
from esp_cli.networks.kernels.sets import compiled_distances, compiled_pool
from esp_cli.networks.layers import GAINS, SeedMLP
from esp_cli.networks.plain import CompiledConfig
from esp_envs.errors import UserError
from esp_envs.spec import Family, Kind, Layout


class SetConfig(CompiledConfig):
    """The settings of the network over sets."""

    free_of_counts: ClassVar[bool] = True

    name: Literal["set"] = "set"
    activation: ActivationName = Setting("relu", description="of the actor")
    hidden: tuple[Annotated[int, Setting(ge=1, le=4096)], ...] = Setting(
        (64,), min_length=1, max_length=16, description="hidden widths behind the sets"
    )
    width: int = Setting(32, ge=1, le=4096, description="features of each thing of a set")
    near: int = Setting(
        0, ge=0, le=4096, description="how many of each set an agent looks at, the nearest ones; 0: all of them"
    )

    def build(
        self, generators: Sequence[torch.Generator], inputs: int, outputs: int, output_gain: float, io: IoSpec | None
    ) -> Network:
        """Build a network over sets; see `NetworkConfig.build`.

        Raises:
            UserError: an actor whose observation shows no like things.
        """
        io = self.io_or_refuse(io)
        if io.num_values is None and not io.spaces.observation.families:
            raise UserError(
                f"{self.name} reads sets of like things, but {io.spaces.label} shows none; say which fields are some "
                "(Field.family), or use mlp"
            )
        return SetNetwork(generators, io, outputs, self, output_gain)

    def least_parameters(self, inputs: int) -> int:
        """Return a lower bound of the number of weights; see `NetworkConfig.least_parameters`."""
        return self.width + self.hidden[0]


class Rows:
    """Splits rows into the own numbers and the numbers of the things of each family, in parts that stand side by side.

    Where a task does not change when it is shifted, places are taken from the middle of all places of a row.

    Args:
        layout: of a row.
        shifts: whether the task does not change when it is shifted.
        near: of each family the things that are nearest to the reader; 0 for all.
        compiled: whether distances are computed by the kernel.

    Attributes:
        num_own: own numbers.
        families: sets of like things.
        widths: W of each family.
    """

    def __init__(self, layout: Layout, shifts: bool, near: int, compiled: bool) -> None:
        parts = [*layout.own, *(part for family in layout.families for part in family.parts)]
        places = [part.where for part in parts if shifts and part.field.is_point]
        alone = places if sum(where.stop - where.start for where in places) == 2 else []
        self._places = [] if alone else places  # a single one, taken from itself, says nothing
        self._own = [part.where for part in layout.own if part.where not in alone]
        self.num_own = sum(where.stop - where.start for where in self._own)
        self.families, self._near, self.compiled = layout.families, near, compiled
        self._offsets = [_place(family) for family in layout.families]
        located = sum(at is not None for at in self._offsets)
        each = zip(self.families, self._offsets, strict=True)
        self.widths = [family.width + (0 if at is None else 1 + located) for family, at in each]

    def split(self, x: Tensor) -> tuple[Tensor, list[list[Tensor]]]:
        """Return the own numbers [S, B, d] and each family's parts [S, B, K, .] of rows x [S, B, D]."""
        x = self._from_the_middle(x) if self._places else x
        own = torch.cat([x[..., where] for where in self._own], -1) if self._own else x[..., :0]
        things, places = [], []
        for family, at in zip(self.families, self._offsets, strict=True):
            numbers = [x[..., where].unflatten(-1, (family.count, -1)) for _, where in family.parts]
            if at is not None:
                joined = numbers[0] if len(numbers) == 1 else torch.cat(numbers, -1)
                numbers = [_nearest(joined, at, self._near)]
                places.append(numbers[0][..., at : at + 2])
            things.append(numbers)
        compiled = bool(places) and computes(self.compiled, x)
        distances = iter((compiled_distances if compiled else distances_among)(places))
        for numbers, at in zip(things, self._offsets, strict=True):
            if at is not None:
                numbers.append(next(distances))
        return own, things

    def _from_the_middle(self, x: Tensor) -> Tensor:
        places = torch.cat([x[..., where] for where in self._places], -1)
        middle, x = places.unflatten(-1, (-1, 2)).mean(-2), x.clone()
        for where in self._places:
            x[..., where] -= middle.repeat(1, 1, (where.stop - where.start) // 2)
        return x


def _place(family: Family) -> int | None:
    """Return the column of a thing's numbers at which its place begins: a point, else its first planar vector."""
    columns, start = [], 0
    for field, _ in family.parts:
        for part in field.parts or (field,):
            if part.kind == Kind.VECTOR:
                columns.append((not part.is_point, start))
            start += part.item_width if part is field else part.width
    return min(columns)[1] if columns else None


def _nearest(things: Tensor, at: int, count: int) -> Tensor:
    """Return the nearest of the things [S, B, K, W], whose places begin at a column; all of them for 0."""
    if not 0 < count < things.shape[2]:
        return things
    square = things[..., at : at + 2].square().sum(-1)
    which = square.topk(count, -1, largest=False, sorted=False).indices
    return things.gather(2, which.unsqueeze(-1).expand(-1, -1, -1, things.shape[-1]))


def distances_among(places: Sequence[Tensor]) -> list[Tensor]:
    """Describe things by distances, which neither turns nor mirrors change.

    Args:
        places: of the things of F families, [S, B, K, 2] each.

    Returns:
        For each family [S, B, K, 1 + F]: the distance of a thing, and that between it and the nearest other thing of
        each family; where there is no other, twice the largest distance of any thing.
    """
    described, farthest = [], 4 * torch.cat([*places], 2).square().sum(-1, keepdim=True).amax(2, keepdim=True)
    for i, first in enumerate(places):
        columns = [first.square().sum(-1).sqrt()]
        for j, second in enumerate(places):
            square = (first.unsqueeze(3) - second.unsqueeze(2)).square().sum(-1)
            if i == j:
                itself = torch.eye(first.shape[2], dtype=torch.bool, device=first.device)
                square = torch.where(itself, farthest if len(itself) == 1 else torch.inf, square)
            columns.append(square.amin(3).sqrt())
        described.append(torch.stack(columns, -1))
    return described


class SetEncoder(nn.Module):
    """Features of rows that show sets.

    Args:
        generators: one CPU generator per seed, which draw the initial weights.
        rows: splits rows.
        config: shape.

    Attributes:
        width: P, features of a row.
    """

    def __init__(self, generators: Sequence[torch.Generator], rows: Rows, config: SetConfig) -> None:
        super().__init__()
        self.rows, features = rows, config.width
        self.own = _layers(generators, (rows.num_own, features), config) if rows.num_own > features else None
        self.num_own = features if self.own else rows.num_own
        self.embed = nn.ModuleDict(
            {
                family.name: _layers(generators, (width + self.num_own, features, features), config)
                for family, width in zip(rows.families, rows.widths, strict=True)
            }
        )
        self.width = self.num_own + 2 * features * len(rows.families)

    def forward(self, x: Tensor) -> tuple[list[Tensor], dict[str, Tensor]]:
        """Map rows x [S, B, D] to parts of their features [S, B, P], and to features of each family [S, B, K, H]."""
        own, things = self.rows.split(x)
        own = own if self.own is None else self.own(own)
        embedded = {}
        for (name, embed), parts in zip(self.embed.items(), things, strict=True):
            beside = own.unsqueeze(2).expand(-1, -1, parts[0].shape[2], -1)
            embedded[name] = embed(*parts, beside)
        return [own, *map(self.pool, embedded.values())], embedded

    def pool(self, things: Tensor) -> Tensor:
        """Return mean and maximum over things [S, B, K, H]: [S, B, 2H]."""
        if computes(self.rows.compiled, things):
            return compiled_pool(things)
        return torch.cat([things.mean(2), things.amax(2)], -1)


def _layers(generators: Sequence[torch.Generator], sizes: Sequence[int], config: SetConfig) -> SeedMLP:
    """Return a perceptron that ends with an activation."""
    name = config.activation
    return SeedMLP(generators, sizes, name, GAINS[name], activate_output=True, compiled=config.compiled is True)


class SetNetwork(Memoryless):
    """Sets in, outputs of an agent, of a team or of each agent of a team out; see the module.

    What reads all observations in a row embeds each as an agent's, and takes the agents as a set. One value of each
    agent is read off that agent's features beside those of all.
    """

    def __init__(
        self, generators: Sequence[torch.Generator], io: IoSpec, outputs: int, config: SetConfig, output_gain: float
    ) -> None:
        super().__init__()
        spaces, compiled = io.spaces, config.compiled is True
        if compiled:
            begin("sets")
        self.team = 1
        self.num_agents = spaces.num_agents if io.reads == "observations" else 0
        layout = io.layout if io.reads == "state" else spaces.observation
        rows = Rows(layout, spaces.shifts, 0 if io.reads == "state" else config.near, compiled)
        self.encoder = SetEncoder(generators, rows, config)
        width = self.encoder.width
        self.agents = _layers(generators, (width, config.width), config) if self.num_agents else None
        if self.agents is not None:
            width = 2 * config.width
        self.each = ""
        if io.num_values is not None and outputs > 1:
            self.each, outputs, width = self._each_agent(io, layout), 1, width + config.width
        sizes = (width, *config.hidden, outputs)
        self.head = SeedMLP(generators, sizes, config.activation, output_gain, compiled=compiled)

    def _each_agent(self, io: IoSpec, layout: Layout) -> str:
        """Return the family whose things have a value each.

        Raises:
            UserError: no family of the layout has a thing for each value.
        """
        if self.num_agents:
            return "agents"
        found = [family.name for family in layout.families if family.count == io.num_values]
        if "agents" in found or len(found) == 1:
            return "agents" if "agents" in found else found[0]
        raise UserError(
            f"set gives each agent a value, but the state of {io.spaces.label} does not say which numbers are whose; "
            "set the critic's input to observations"
        )

    def forward(self, x: Tensor) -> Tensor:
        """Map [S, B, in] to [S, B, out]."""
        if self.agents is None:
            parts, sets = self.encoder(x)
        else:
            seen, _ = self.encoder(x.unflatten(-1, (self.num_agents, -1)).flatten(1, 2))
            agents = self.agents(*seen).unflatten(1, (-1, self.num_agents))
            parts, sets = [self.encoder.pool(agents)], {"agents": agents}
        if not self.each:
            return self.head(*parts)
        own = sets[self.each]
        return self.head(*(p.unsqueeze(2).expand(-1, -1, own.shape[2], -1) for p in parts), own).squeeze(-1)
