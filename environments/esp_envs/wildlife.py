"""Wildlife monitoring (van der Pol et al., 2022): drones on a torus of cells trap a poacher together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import torch
from pydantic import Field as Setting
from pydantic import model_validator
from torch import Tensor

from esp_envs.batched import BatchedTask, Outcome, World, to_others
from esp_envs.errors import UserError
from esp_envs.scene import DARK, Body, Scene, look
from esp_envs.settings import Breaks, TaskSettings
from esp_envs.spec import DOWN, LEFT, RIGHT, UP, Discrete, Field, Items, Kind, TaskSpec, layout

REST = (0.0, 0.0)
MOVES = Discrete(Kind.VECTOR, (REST, UP, RIGHT, DOWN, LEFT), ("rest", "up", "right", "down", "left"))
"""In the order of van der Pol's code; the meaning of each is the way to the next cell."""
STEP_COST = 0.05  # what a step costs the whole team
PIXELS = 3  # along a side of a cell in a drone's picture
_FEW = 16  # drones up to which one matrix product is the fastest way to the places of others


class WildlifeSettings(TaskSettings):
    """What a user may change of `wildlife`."""

    convention: Literal["esp", "corrected"] = Setting(
        "esp",
        description="whose rules: 'esp' is van der Pol's code, which the paper used, 'corrected' has its quirks mended",
    )
    num_agents: int = Setting(3, ge=2, description="N, drones; van der Pol: 3")
    width: int = Setting(7, ge=3, description="columns of the grid, an odd number; van der Pol: 7")
    height: int = Setting(7, ge=3, description="rows of the grid, an odd number")
    horizon: int = Setting(100, ge=1, le=100_000, description="steps of an episode, at most")
    poacher_moves: float = Setting(0.8, ge=0, le=1, description="probability that the poacher moves in a step")
    wind: Annotated[float, Breaks("flip-x")] = Setting(
        0.0, ge=0, le=1, description="breaks symmetry: probability that a moving poacher is carried to the right"
    )

    def without_effect(self) -> frozenset[str]:
        return frozenset({"wind"} if self.poacher_moves == 0 else ())

    @model_validator(mode="after")
    def _fits(self) -> WildlifeSettings:
        if self.width % 2 == 0 or self.height % 2 == 0:
            raise UserError(
                f"a grid of {self.width} x {self.height} cells has no cell in its middle; use odd numbers, so that a "
                "drone can be in the middle of its picture"
            )
        if self.num_agents >= self.width * self.height:
            raise UserError(f"{self.num_agents} drones and a poacher do not fit on {self.width * self.height} cells")
        return self


_DRONE = ((0.0, 1.0, 0.0), (1.0, 1.0, 1.0), (0.0, 1.0, 0.0))
_POACHER = ((1.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 1.0))  # plus and cross: the same in all images of the square


class Wildlife(BatchedTask):
    """Wildlife monitoring, the drones' game of van der Pol et al. (2022).

    N drones and a poacher move on a grid of cells whose opposite edges are joined. One drone has to hover above the
    poacher while others stand beside it.

    Actions: 0 rest, 1 up, 2 right, 3 down, 4 left: to the next cell. Drones that would share a cell all stay, though
    another may have moved to where one was. The poacher moves at random with probability 0.8, else it rests.

    Observation of one drone, a picture of 9 numbers a cell and N - 1 planar vectors (7 x 7 cells, N = 3: 445 numbers):

        | index (7 x 7, N = 3) | field   | meaning                                           | unit  |
        |----------------------|---------|---------------------------------------------------|-------|
        | 0..440               | picture | 21 x 21 pixels: the torus, itself in the middle   | shade |
        | 441..444             | others  | each other drone, in index order, minus own cell  | cell  |

    The picture has 3 x 3 pixels of 0 or 1 a cell: a plus is the drone itself, an x the poacher, which hides the plus
    below it. It does not show the other drones. Rows of pixels from the top (largest y), in each from the left.

    State: cells of the drones, cell of the poacher, as (x, y) from the middle cell.

    Reward, the same for every drone: -0.05 in each step; in the last one, if the poacher is trapped, 1 for the drone
    above it and 1 for each drone beside it. It is trapped if exactly one drone is in its cell and at least one that did
    not just bump into another is at a Manhattan distance of 1 from it.
        convention `esp` (van der Pol's code): the poacher's cell BEFORE its move counts; distances between cells,
            and the relative positions that are seen, do not go round the torus.
        convention `corrected`: the cell after its move counts, and distances go round the torus.

    Start: drones and poacher on different cells, uniformly.

    Terminated: when the poacher is trapped; each world for itself. Truncated: after `horizon` = 100 steps; bootstrap
    there.

    Metrics, added up over an episode: `captures` (1 if it ends with the poacher trapped), `lone_landings` (steps with
    a drone alone above the poacher), `collisions` (drones sent back to their cells), `steps` (its length).

    Symmetry: all turns and mirrors of the square (`d4`) where the grid is one, else half turns and mirrors in the axes
    (`d2`); in both conventions. A `wind`, which carries the poacher to the right, leaves the mirror `flip-x`.

    Heuristics: `surround` (all fly to the poacher; the nearest lands when another is beside it in the same step).

    Anchors, convention `esp`, 7 x 7 cells, N = 3, return of an episode: random -2.8, surround 2.0.

    Versions:
        1: first.
    """

    Settings: ClassVar[type[WildlifeSettings]] = WildlifeSettings
    heuristics = ("surround",)
    ending = "captured"
    makes_new_tensors = True
    settings: WildlifeSettings

    def __init__(self, settings: WildlifeSettings, num_envs: int, generators: Sequence[torch.Generator]) -> None:
        super().__init__(settings, num_envs, generators)
        agents, device = settings.num_agents, self.device
        self._size = torch.tensor([settings.width, settings.height], device=device)
        self._half = self._size // 2
        self._points = torch.tensor(MOVES.points, device=device).long()
        self._step = torch.tensor([1, settings.width], device=device)  # from one cell's number to the next one's
        self._busy = self._step.new_zeros(*self._worlds_shape, settings.width * settings.height)
        pictures = all_pictures(settings.width, settings.height)
        # as wide as an observation, so that one copy of rows makes the observations
        self._rows = torch.nn.functional.pad(pictures, (0, 2 * (agents - 1))).to(device)
        basis = torch.eye(2 * min(agents, _FEW), dtype=torch.float64, device=device)
        self._others = to_others(basis.view(len(basis), -1, 2)).flatten(1)  # turns cells of drones into ways to others
        self.plan = torch.zeros(settings.horizon, *self._worlds_shape, agents + 2, 2, dtype=torch.int16, device=device)
        """[horizon, S, E, N + 2, 2], all that chance decides, drawn in advance: in each step the poacher's move, then
        the cells of drones and poacher with which an episode would begin. A new plan follows when it is used up."""
        self._put(torch.zeros(self.state_shape, device=device))

    def _describe(self) -> TaskSpec:
        settings = self.settings
        agents, width, height = settings.num_agents, settings.width, settings.height
        before = "before its move, no way round the torus" if settings.convention == "esp" else "after its move"
        whole = "d4*agents" if width == height else "d2*agents"
        return TaskSpec(
            name="wildlife",
            version=1,
            convention=f"{settings.convention}: 1 a drone at the trap, -{STEP_COST:g} a step; poacher's cell {before}"
            + settings.broken_in_words(),
            num_agents=agents,
            horizon=settings.horizon,
            observation=layout(
                Field("picture", Kind.PICTURE, 1, "shade", pixels=(PIXELS * height, PIXELS * width)),
                Field("others", Kind.VECTOR, agents - 1, "cell", Items.OTHERS),
            ),
            state=layout(
                Field("drones", Kind.VECTOR, agents, "cell", Items.AGENTS, is_point=True),
                Field("poacher", Kind.VECTOR, 1, "cell", is_point=True),
            ),
            action=MOVES,
            symmetry=settings.left_of(whole),
            nearly=whole,
            control_period_s=0.25,
            totals=("captures", "lone_landings", "collisions", "steps"),
            terminates=True,
            settings=settings.model_dump(),
        )

    def _start(self, generator: torch.Generator) -> World:
        settings, agents = self.settings, self.settings.num_agents
        shape = (settings.horizon + 1, self.num_envs, agents + 3)
        drawn = torch.rand(shape, generator=generator, device=self.device)
        way = drawn[:-1, ..., 1]
        direction = 1 + (4 * (way - settings.wind) / max(1 - settings.wind, 1e-9)).long().clamp_(max=3)
        move = self._points[torch.where(way < settings.wind, MOVES.points.index(RIGHT), direction)]
        move = torch.where(drawn[:-1, ..., :1] < settings.poacher_moves, move, 0)
        starts = self._different_cells(drawn[..., 2:])
        return {"cells": starts[-1], "plan": torch.cat([move.unsqueeze(2), starts[:-1]], 2)}

    def _episodes(self) -> World:
        drawn = [self._start(generator) for generator in self.generators]
        self.plan.copy_(torch.stack([one["plan"] for one in drawn], 1))
        return {"cells": torch.stack([one["cells"] for one in drawn])}

    def _next_episodes(self) -> World:
        if self._time + 1 == self.settings.horizon:
            self._episodes()
        return {"cells": self._chance[:, :, 1:]}

    def _begin_with(self, drawn: World) -> None:
        self.world = drawn

    def _advance(self, world: World, action: Tensor) -> Outcome:
        settings, agents = self.settings, self.settings.num_agents
        before = world["cells"]
        self._chance = self.plan[self._time].long()
        moves = self._points.index_select(0, action.flatten()).view(*action.shape, 2)
        after = self._wrap(before + torch.cat([moves, self._chance[:, :, :1]], 2))
        drones = after[:, :, :agents]
        cell = ((drones + self._half) * self._step).sum(-1)
        bumped = self._busy.zero_().scatter_add_(-1, cell, torch.ones_like(cell)).gather(-1, cell) > 1
        drones = torch.where(bumped.unsqueeze(-1), before[:, :, :agents], drones)
        cells = world["cells"] = torch.cat([drones, after[:, :, agents:]], 2)
        poacher = (before if settings.convention == "esp" else cells)[:, :, agents:]
        landed, helpers = self._trap(drones, poacher, bumped)
        self._captured = landed & (helpers > 0)
        reward = torch.where(self._captured, 1.0 + helpers, 0.0) - STEP_COST
        if not self.measures:
            return reward, {}
        return reward, {
            "captures": self._captured,
            "lone_landings": landed & (helpers == 0),
            "collisions": bumped.sum(-1),
            "steps": torch.ones_like(reward),
        }

    def _ended(self, world: World) -> Tensor:
        return self._captured

    def _observe(self, world: World) -> Tensor:
        drones, poacher = world["cells"][:, :, :-1], world["cells"][:, :, -1:]
        settings = self.settings
        x, y = self._wrap(poacher - drones).unbind(-1)
        picture = (settings.height // 2 - y) * settings.width + x + settings.width // 2
        obs = self._rows.index_select(0, picture.flatten()).view(*picture.shape, -1)
        if settings.num_agents <= _FEW:
            others = (drones.flatten(2).double() @ self._others).view(*picture.shape, -1, 2)
        else:
            others = to_others(drones)
        if settings.convention == "corrected":
            others = self._wrap(others)
        obs[..., -2 * (settings.num_agents - 1) :] = others.flatten(-2)
        return obs

    def _state(self) -> Tensor:
        return self.world["cells"].flatten(-2).float()

    def _put(self, state: Tensor) -> None:
        self.world = {"cells": state.round().long().unflatten(-1, (-1, 2))}

    def _to_save(self) -> dict[str, Tensor]:
        return {"cells": self.world["cells"].to(torch.int16), "plan": self.plan}

    def _take_back(self, saved: dict[str, Tensor]) -> None:
        self.world = {"cells": saved["cells"].long()}
        self.plan.copy_(saved["plan"])

    def heuristic(self, name: str | None = None) -> Tensor:
        self.named_heuristic(name)
        drones, poacher = self.world["cells"].split((self.settings.num_agents, 1), 2)
        way = self._wrap(poacher - drones)
        distance = way.abs().sum(-1)
        nearest, second = distance.topk(2, dim=-1, largest=False, sorted=True).values.unbind(-1)
        # of several nearest drones the first
        lands = torch.zeros_like(distance).scatter_(-1, distance.argmin(-1, keepdim=True), 1).bool()
        trap = ((nearest <= 1) & (second <= 2)).unsqueeze(-1)
        moves = (distance > 1) | (lands & trap & (distance == 1))
        sideways = way[..., 0].abs() > way[..., 1].abs()
        up, right, down, left = (MOVES.points.index(p) for p in (UP, RIGHT, DOWN, LEFT))
        along_x, along_y = torch.where(way[..., 0] > 0, right, left), torch.where(way[..., 1] > 0, up, down)
        return torch.where(moves, torch.where(sideways, along_x, along_y), MOVES.points.index(REST))

    def scene(self, world: tuple[int, int] = (0, 0)) -> Scene:
        *drones, poacher = [(float(x), float(y)) for x, y in self.world["cells"][world].tolist()]
        bodies = [Body(place, 0.4, label="drone", **look(i)) for i, place in enumerate(drones)]
        bodies.append(Body(poacher, 0.25, DARK, shape="cross", label="poacher"))
        right, top = self.settings.width / 2, self.settings.height / 2
        return Scene(tuple(bodies), (-right, right, -top, top), grid=(1.0, 0.5), unit="cells")

    def _wrap(self, cells: Tensor) -> Tensor:
        """Return coordinates [..., 2] brought round the torus into the grid, whose middle cell is (0, 0)."""
        return torch.remainder(cells + self._half, self._size) - self._half

    def _trap(self, drones: Tensor, poacher: Tensor, bumped: Tensor) -> tuple[Tensor, Tensor]:
        """Return whether just one drone is above the poacher [S, E], and how many stand beside it [S, E]."""
        offset = drones - poacher
        if self.settings.convention == "corrected":
            offset = self._wrap(offset)
        distance = offset.abs().sum(-1)
        return (distance == 0).sum(-1) == 1, ((distance == 1) & ~bumped).sum(-1)

    def _different_cells(self, uniform: Tensor) -> Tensor:
        """Turn numbers in [0, 1), [..., K], into K different cells [..., K, 2], all choices equally likely."""
        width, count = self.settings.width, self.settings.width * self.settings.height
        chosen: list[Tensor] = []
        for k in range(uniform.shape[-1]):
            cell = (uniform[..., k] * (count - k)).long().clamp_(max=count - k - 1)
            # the cell-th of those that are free: each taken one that is not above it moves it up
            if chosen:
                for taken in torch.stack(chosen, -1).sort(-1).values.unbind(-1):
                    cell = cell + (cell >= taken)
            chosen.append(cell)
        index = torch.stack(chosen, -1)
        return torch.stack([index % width, index // width], -1) - self._half


def all_pictures(width: int, height: int) -> Tensor:
    """Return every picture that a drone can see, by the cell of the poacher: [cells, 9 * cells], rows from the top.

    It shows the whole torus with the drone in the middle. A poacher below the drone hides it.
    """
    cells = torch.eye(width * height).view(-1, height, width)
    pictures, middle = torch.kron(cells, torch.tensor([_POACHER])), len(cells) // 2
    pictures[torch.arange(len(cells)) != middle] += torch.kron(cells[middle], torch.tensor(_DRONE))
    return pictures.flatten(1)
