"""What the particle tasks share: settings, actions, and worlds whose steps and readouts are matrix products.

All random numbers of an episode are drawn at its start, from each seed's own generator.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import torch
from pydantic import Field as Setting
from torch import Tensor

from esp_envs.base import Observation
from esp_envs.batched import BatchedTask, Outcome, World, to_others
from esp_envs.mpe.many import MOST_BODIES, ManyWorlds, ways_to
from esp_envs.mpe.particles import Bodies, ParticleWorlds, exact_matmul
from esp_envs.settings import Breaks, TaskSettings
from esp_envs.spec import DOWN, LEFT, RIGHT, UP, Continuous, Discrete, Field, Items, Kind, layout

STILL = (0.0, 0.0)
MOVES = Discrete(Kind.VECTOR, (STILL, LEFT, RIGHT, DOWN, UP), ("no-op", "left", "right", "down", "up"))
"""The five discrete actions in MPE's order; the meaning of each is the direction of its force."""
FORCE = Continuous(layout(Field("force", Kind.VECTOR, 1, "share of the full force")))
"""The continuous action: one force in the unit disc."""
OWN = (Field("velocity", Kind.VECTOR, 1, "length/s"), Field("position", Kind.VECTOR, 1, "length", is_point=True))
"""With what every observation begins."""


class ParticleSettings(TaskSettings):
    """What all particle tasks let a user change."""

    convention: Literal["esp", "pettingzoo"] = Setting(
        "esp",
        description="whose rules: 'esp' is the original MPE as the paper used it, 'pettingzoo' the later mpe2 package",
    )
    actions: Literal["discrete", "continuous"] = Setting(
        "discrete", description="five moves, or a planar force in the unit disc"
    )
    horizon: int = Setting(25, ge=1, le=100_000, description="steps of an episode (0.1 s each); 25 in MPE")
    wind: Annotated[float, Breaks("flip-x")] = Setting(
        0.0, ge=0, le=10, description="breaks symmetry: a force on every body along x, as a share of its full force"
    )
    mud: Annotated[float, Breaks("flip-x")] = Setting(
        0.0, ge=0, le=1, description="breaks symmetry: share of the velocity that a step costs more where x > 0"
    )
    action_turn_rad: Annotated[float, Breaks("turns")] = Setting(
        0.0, ge=0, le=3, description="breaks mirrors: the learners' forces are turned by this angle, which nobody sees"
    )
    reward_offset: Annotated[float, Breaks("flip-x")] = Setting(
        0.0, ge=0, le=10, description="breaks symmetry: the reward counts places that lie so far to the right, lengths"
    )

    sees: int = Setting(
        0,
        ge=0,
        description="of the others of its team, and of landmarks or obstacles, how many nearest ones one sees; 0: all",
    )
    density: float | None = Setting(
        None,
        ge=1e-6,
        description="agents of the team per 2 x 2 lengths at the start, however many there are; by default all start "
        "in [-1, 1]^2. What else starts in a square grows with it",
    )

    @property
    def turns(self) -> str:
        """The rotations that actions, dynamics and reward carry."""
        return "c4" if self.actions == "discrete" else "so2"

    @property
    def team(self) -> int:
        """Agents, the first of all, that see each other."""
        raise NotImplementedError

    @property
    def half_side(self) -> float:
        """Half the side of the square in which agents start, lengths."""
        return math.sqrt(self.team / self.density) if self.density else 1.0

    def seen_fields(self, things: str, count: int, others: str) -> tuple[Field, ...]:
        """Return the fields of things and of others; those sorted by distance are moved by no order of agents."""
        if not self.sees:
            return (
                Field(things, Kind.VECTOR, count, "length", family=things),
                Field(others, Kind.VECTOR, self.team - 1, "length", Items.OTHERS),
            )
        return (
            Field(f"near_{things}", Kind.VECTOR, min(self.sees, count), "length", family=things),
            Field(f"near_{others}", Kind.VECTOR, min(self.sees, self.team - 1), "length", family="others"),
        )

    @property
    def many(self) -> bool:
        """Whether pairs are too many to be listed, or only the nearest are seen."""
        return self.sees > 0 or self.team > MOST_BODIES


class ParticleTask(BatchedTask):
    """A batch of particle worlds.

    A subclass implements `_describe` and the abstract methods below. Its state is laid out like the rows of
    `ParticleWorlds.physics`, of which the tensors in `world` are views.
    """

    makes_new_tensors = True
    settings: ParticleSettings
    first_learner = 0  # index of the first of the agents that learn; the task drives the others
    solid: ClassVar[bool] = False  # whether landmarks push agents away

    def __init__(self, settings: ParticleSettings, num_envs: int, generators: Sequence[torch.Generator]) -> None:
        super().__init__(settings, num_envs, generators)
        spec, bodies = self.spec, self._bodies()
        num_worlds, velocity_first = self.num_seeds * num_envs, settings.convention == "esp"
        made = bodies, num_worlds, self.device, velocity_first
        self.worlds = (
            ManyWorlds(*made, settings.sees, settings.team, self.solid) if settings.many else ParticleWorlds(*made)
        )
        lanes = self.worlds.num_lanes
        counts = [field.count for field in spec.state.fields]
        rows = self._by_world(self.worlds.physics).split(counts, 2)
        self.world = {field.name: view for field, view in zip(spec.state.fields, rows, strict=True)}
        self._control = torch.zeros(bodies.num_agents, 2, lanes, device=self.device)
        self._learner_control = self._control[self.first_learner : self.first_learner + spec.num_agents]
        self._points = torch.tensor(MOVES.points, device=self.device)
        self._extents = torch.tensor(bodies.extent, device=self.device).view(-1, 1, 1)
        gain = torch.tensor(bodies.gain, device=self.device).view(-1, 1, 1)
        self._push = torch.cat([gain * settings.wind, torch.zeros_like(gain)], 1) if settings.wind else None
        self._shift = torch.tensor([[settings.reward_offset], [0.0]], device=self.device)
        self._readout: Tensor | None = None
        if not settings.many:
            # the matrix of a linear function is what it gives for the basis vectors
            readout = self._observe(self._split(torch.eye(spec.state.width)))
            self._readout = readout.flatten(1).to(self.device)

    @abstractmethod
    def _bodies(self) -> Bodies:
        """Return what the bodies are, with their full gains."""

    @abstractmethod
    def _observe(self, world: World) -> Tensor:
        """Return all observations, written to be read: the fast path is derived from it, so it must be linear."""

    @abstractmethod
    def _outcome(self) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the reward [N, W'] or [W'] of the step just made, and its metrics [W'] where `measures` is on.

        W' counts padded lanes.
        """

    def _chance(self, generator: torch.Generator) -> World:
        """Draw what else chance decides in the episodes of one seed, [E, ...] by name."""
        return {}

    def _drive(self) -> None:
        """Fill the controls of the agents that do not learn."""

    def _start(self, generator: torch.Generator) -> World:
        """Draw every position uniformly from its own square, then what else chance decides."""
        shape = (len(self._extents), 2, self.num_envs)
        unit = torch.rand(shape, generator=generator, device=self.device).mul_(2).sub_(1)
        places = (unit * self._extents).permute(2, 0, 1)
        fields = [field for field in self.spec.state.fields if not field.name.endswith("velocity")]
        parts = places.split([field.count for field in fields], 1)
        return {field.name: part for field, part in zip(fields, parts, strict=True)} | self._chance(generator)

    def _begin_with(self, drawn: World) -> None:
        self.worlds.velocity.zero_()
        for name, values in drawn.items():
            self.world[name].copy_(values)
        self.worlds.measure()

    def _advance(self, world: World, action: Tensor) -> Outcome:
        self._act(action)
        self._drive()
        self.worlds.advance(self._control, self._push, self.settings.mud)
        reward, metrics = self._outcome()
        return self._by_world(reward), {name: self._by_world(value) for name, value in metrics.items()}

    def _seen(self) -> Observation:
        rows = self.worlds.rows.t()
        if self._readout is None:
            obs = self._observe(self.world).flatten(3)
        else:
            obs = exact_matmul(rows, self._readout).view(*self._agents_shape, -1)
        return Observation(obs, rows.contiguous().view(*self._worlds_shape, -1))

    def _put(self, state: Tensor) -> None:
        self.worlds.rows.copy_(state.reshape(-1, self.spec.state.width).t())
        self.worlds.measure()

    def _to_save(self) -> dict[str, Tensor]:
        return {"physics": self.worlds.rows}

    def _take_back(self, saved: dict[str, Tensor]) -> None:
        for name, values in self._to_save().items():
            values.copy_(saved[name])
        self.worlds.measure()

    def _squared_to(self, target: Tensor) -> Tensor:
        """Return the squared distances [N, K, W'] of the first agents to where the reward counts targets [K, 2, W']."""
        square = (self.worlds.position.unsqueeze(1) - (target + self._shift)).square_()
        return square[:, :, 0] + square[:, :, 1]

    def _act(self, action: Tensor) -> None:
        learners, worlds = self.spec.num_agents, self.worlds.num_worlds
        force = self._points.index_select(0, action.reshape(-1)) if self.settings.actions == "discrete" else action
        self._learner_control[:, :, :worlds] = force.reshape(worlds, learners, 2).permute(1, 2, 0)
        if self.settings.action_turn_rad:
            self._learner_control.copy_(_turned(self._learner_control, self.settings.action_turn_rad))

    def _ways(self, position: Tensor, things: Tensor | None) -> list[Tensor]:
        """Return the ways [S, E, N, 2 k] from a team at `position` to the things, and to the others, that each sees."""
        worlds, to = self.worlds, [] if things is None else [things]
        if isinstance(worlds, ManyWorlds) and self.settings.sees:
            ways = [ways_to(worlds.seen_landmarks, places, position) for places in to]
            ways.append(ways_to(worlds.seen_agents, position, position))
        else:
            ways = [*(places.unsqueeze(-3) - position.unsqueeze(-2) for places in to), to_others(position)]
        return [way.flatten(-2) for way in ways]

    def _to_action(self, wish: Tensor) -> Tensor:
        """Turn wishes [N, 2, W'] (1 is a full force) into a joint action of this task's kind."""
        wish = _turned(wish[:, :, : self.worlds.num_worlds], -self.settings.action_turn_rad)
        if self.settings.actions == "discrete":
            return nearest_move(wish).t().reshape(self._agents_shape)
        return unit_disc(wish).permute(2, 0, 1).reshape(*self._agents_shape, 2)

    def _move_control(self, moves: Tensor) -> Tensor:
        """Return the controls [N, 2, W] of discrete moves [N, W]."""
        return self._points[moves].movedim(-1, 1)

    def _by_world(self, values: Tensor) -> Tensor:
        """Return the real worlds' part of [..., W'] as a view [S, E, ...]."""
        worlds = self.worlds
        real = values if worlds.num_worlds == worlds.num_lanes else values[..., : worlds.num_worlds]
        if real.dim() == 1:
            return real.view(self._worlds_shape)
        return real.movedim(-1, 0).unflatten(0, self._worlds_shape)


def _turned(force: Tensor, angle: float) -> Tensor:
    """Return forces [N, 2, W] turned counter-clockwise by an angle, rad."""
    if angle == 0:
        return force
    x, y = force.unbind(1)
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], 1)


MOVE_THRESHOLD = 0.25  # a wish shorter than this along both axes becomes a no-op


def nearest_move(wish: Tensor) -> Tensor:
    """Return the discrete move [N, W] along the longer axis of a wish [N, 2, W]."""
    x, y = wish[:, 0], wish[:, 1]
    sideways = x.abs() > y.abs()
    left, right, down, up = (MOVES.points.index(p) for p in (LEFT, RIGHT, DOWN, UP))
    move = torch.where(sideways, torch.where(x > 0, right, left), torch.where(y > 0, up, down))
    return torch.where(torch.maximum(x.abs(), y.abs()) > MOVE_THRESHOLD, move, MOVES.points.index(STILL))


def unit_disc(wish: Tensor) -> Tensor:
    """Scale wishes [N, 2, W] longer than 1 back to length 1."""
    return wish / wish.norm(dim=1, keepdim=True).clamp_min(1.0)
