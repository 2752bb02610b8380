"""Predator-prey (MPE `simple_tag`): slow predators hunt a faster prey among obstacles."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from esp_envs.base import BLIND, joined
from esp_envs.batched import World
from esp_envs.mpe.many import ManyWorlds
from esp_envs.mpe.particles import Bodies
from esp_envs.mpe.predator_prey_spec import PredatorPreySettings, predator_prey_spec
from esp_envs.mpe.task import MOVES, ParticleTask, nearest_move, unit_disc
from esp_envs.scene import COLORS, PALE, Body, Scene, look
from esp_envs.spec import TaskSpec

PREDATOR_RADIUS, PREY_RADIUS, OBSTACLE_RADIUS = 0.075, 0.05, 0.2
PREDATOR_GAIN, PREY_GAIN = 3.0, 4.0  # acceleration of a full force, length / s^2
PREDATOR_MAX_SPEED, PREY_MAX_SPEED = 1.0, 1.3  # length / s
OBSTACLE_EXTENT = 0.9
TOUCH_REWARD = 10.0
PREY_LEAD_S, OWN_LEAD_S = 0.25, 0.15
"""A predator aims from where it will be in OWN_LEAD_S at where the prey will be in PREY_LEAD_S; found by search."""
URGENCY = 10.0  # full force beyond 1 / URGENCY lengths of aiming error
BOUND = 0.9  # the fleeing prey heads for the origin when farther from it than this (lengths)
_FAR = 1e3
_TINY = 1e-12
BLIND_RADIUS = 0.3  # of the circle of `blind`, in halves of the square; the best of 0, 0.3, 0.5 and 0.7


class PredatorPrey(ParticleTask):
    """Predator-prey, MPE's `simple_tag`.

    Predators (radius 0.075, acceleration 3 length/s^2, at most 1.0 length/s) hunt one prey (0.05, 4, 1.3) among
    obstacles (0.2). All bodies push each other apart. The plane is unbounded; lengths have no physical unit, a step is
    0.1 s.

    With `control="both"` predators and prey learn, as roles of these names: each sees and gets what it does alone.

    Actions, of each predator (of the prey with `control="prey"`):
        discrete: 0 no-op, 1 left, 2 right, 3 down, 4 up: full acceleration in that direction.
        continuous: `force`, a vector in the unit disc times the full acceleration; longer vectors are scaled to 1.

    Observation of a predator, 2 + L + (N - 1) + 2 planar vectors (N = 3, L = 2: 16 numbers):

        | index (N = 3, L = 2) | field         | meaning                                            | unit     |
        |----------------------|---------------|----------------------------------------------------|----------|
        | 0..1                 | velocity      | own velocity                                       | length/s |
        | 2..3                 | position      | own position                                       | length   |
        | 4..7                 | obstacles     | each obstacle minus own position                   | length   |
        | 8..11                | predators     | each other predator, in index order, minus own pos.| length   |
        | 12..13               | prey          | prey minus own position                            | length   |
        | 14..15               | prey_velocity | velocity of the prey                               | length/s |

    Observation of the prey: own velocity, own position, obstacles and predators relative to it; no other velocities.

    State: velocities of predators and of the prey, positions of predators and of the prey, positions of the obstacles.

    Reward, after the move, a touch being a predator whose centre is nearer than 0.125 to the prey's:
        predators: each gets 10 x (number of touches).
        prey (`control="prey"`): -10 x touches - bound(|x|) - bound(|y|), with bound(u) = 0 below 0.9, 10 (u - 0.9)
            below 1, then min(exp(2u - 2), 10).

    Prey, when the predators learn:
        random: one of the five moves, drawn at each step; with continuous actions no-op with probability 1/5, else
            full force in a uniform direction. All are drawn at the start of an episode: `prey_moves`.
        fleeing: runs from the nearest predator, and back to the origin when farther than 0.9 from it.
        still: exerts no force (it can be pushed).

    Start: velocities zero, all agents uniform in [-1, 1]^2, obstacles uniform in [-0.9, 0.9]^2. Conventions differ in
    the order of integration only: `esp` updates the velocity first (original MPE), `pettingzoo` the position (mpe2).

    Terminated: never. Truncated: after `horizon` = 25 steps; bootstrap there.

    Many predators: with `sees` = k a predator sees the k nearest obstacles and other predators, sorted by distance;
    `density` makes the square at the start, and the prey's bounds, grow with them. A learning prey sees all.

    Metrics a step: `contact` (1 where any predator touches the prey), `touches` (their number), `prey_distance` (from
    the prey to its nearest predator, length).

    Symmetry: dynamics and reward are invariant under all rotations and reflections; discrete moves carry `d4`, forces
    `o2`. The prey's own bounds are a square, so `control="prey"` has `d4` only. Settings that break the
    symmetry leave: `wind` and `mud` the mirror `flip-x`, `action_turn_rad` the rotations, `reward_offset` (who touches
    a place right of the prey is rewarded) the mirror `flip-x`.

    Heuristics: `chase` (predators run at the prey; with `control="prey"`: the fleeing prey), `blind` (learning
    predators that see no prey circle around the middle).

    Anchors, `esp` convention, return of one predator per episode against the random prey: random 3.1, blind 6, chase 88
    (against the fleeing prey 63, against a still one 167).

    Versions:
        1: first.
    """

    Settings: ClassVar[type[PredatorPreySettings]] = PredatorPreySettings
    heuristics: tuple[str, ...] = ("chase", BLIND)
    settings: PredatorPreySettings
    solid = True

    def __init__(self, settings: PredatorPreySettings, num_envs: int, generators: Sequence[torch.Generator]) -> None:
        self._prey_learns = settings.control != "predators"
        self.first_learner = settings.num_predators if settings.control == "prey" else 0
        super().__init__(settings, num_envs, generators)
        if settings.control != "predators":
            self.heuristics = ("chase",)
        lanes, horizon = self.worlds.num_lanes, settings.horizon
        self._prey_plan = torch.zeros(horizon, 2, lanes, device=self.device)
        self.world["prey_moves"] = self._by_world(self._prey_plan)

    def _describe(self) -> TaskSpec:
        return predator_prey_spec(self.settings)

    def _bodies(self) -> Bodies:
        predators, obstacles = self.settings.num_predators, self.settings.num_obstacles
        agents, half = predators + 1, self.settings.half_side
        pairs: list[tuple[int, int]] = []
        if not self.settings.many:
            pairs += [(a, predators) for a in range(predators)]  # first, where `_outcome` finds their distances
            pairs += itertools.combinations(range(predators), 2)
            pairs += itertools.product(range(agents), range(agents, agents + obstacles))
        return Bodies(
            radius=(PREDATOR_RADIUS,) * predators + (PREY_RADIUS,) + (OBSTACLE_RADIUS,) * obstacles,
            gain=(PREDATOR_GAIN,) * predators + (PREY_GAIN,),
            max_speed=(PREDATOR_MAX_SPEED,) * predators + (PREY_MAX_SPEED,),
            contacts=tuple(pairs),
            extent=(half,) * agents + (half * OBSTACLE_EXTENT,) * obstacles,
        )

    @property
    def prey_moves(self) -> Tensor:
        """The random prey's controls of this episode, a view [horizon, S, E, 2] that may be written to."""
        return self.world["prey_moves"].permute(2, 0, 1, 3)

    def _observe(self, world: World) -> Tensor:
        prey_sees = self._prey_sees(world).unsqueeze(-2)
        if self.settings.control == "prey":
            return prey_sees
        here, prey = world["position"], world["prey_position"]
        parts = [world["velocity"], here, *self._ways(here, world.get("obstacles"))]
        rows = torch.cat([*parts, prey - here, world["prey_velocity"].expand_as(here)], -1)
        return joined([rows, prey_sees]) if self._prey_learns else rows

    def _prey_sees(self, world: World) -> Tensor:
        prey = world["prey_position"]
        ways = [(world[name] - prey).flatten(-2).unsqueeze(-2) for name in ("obstacles", "position") if name in world]
        return torch.cat([world["prey_velocity"], prey, *ways], -1).squeeze(-2)

    def heuristic(self, name: str | None = None) -> Tensor:
        """Return the joint action of `chase`: that of predators that learn, a fleeing prey's; or of `blind`."""
        if self.named_heuristic(name) == BLIND:
            position = self.worlds.position[: self.settings.num_predators]
            return self._to_action(circle(position, BLIND_RADIUS * self.settings.half_side))
        sides = {"predators": self._chase, "prey": self._flight}
        learning = [wish() for side, wish in sides.items() if self.settings.control in (side, "both")]
        return self._to_action(torch.cat(learning))

    def scene(self, world: tuple[int, int] = (0, 0)) -> Scene:
        lane = world[0] * self.num_envs + world[1]
        places = self.worlds.entity[:, :, lane].tolist()
        predators = self.settings.num_predators
        bodies = [Body((x, y), OBSTACLE_RADIUS, PALE, label="obstacle") for x, y in places[predators + 1 :]]
        for k, (x, y) in enumerate(places[:predators]):
            own = look(k) | {"color": COLORS[0]}
            bodies.append(Body((x, y), PREDATOR_RADIUS, trail=True, label="predator", **own))
        (x, y), touching = places[predators], PREDATOR_RADIUS + PREY_RADIUS
        prey = Body((x, y), PREY_RADIUS, COLORS[1], trail=True, label="prey", reach=touching, held="caught")
        bodies.append(prey)
        half = 1.4 * self.settings.half_side
        return Scene(tuple(bodies), (-half, half, -half, half), unit="length units")

    def _to_save(self) -> dict[str, Tensor]:
        return super()._to_save() | {"prey_moves": self.prey_moves}

    def _chance(self, generator: torch.Generator) -> World:
        if self._prey_learns or self.settings.prey != "random":
            return {}
        shape, device = (self.settings.horizon, self.num_envs), self.device
        move = torch.randint(MOVES.count, shape, generator=generator, device=device)
        if self.settings.actions == "discrete":
            plan = self._move_control(move)
        else:
            angle = torch.rand(shape, generator=generator, device=device) * (2 * math.pi)
            plan = torch.stack([angle.cos(), angle.sin()], dim=1) * (move != 0).unsqueeze(1)
        return {"prey_moves": plan.movedim(-1, 0)}

    def _drive(self) -> None:
        predators = self.settings.num_predators
        if self.settings.control == "prey":
            self._control[:predators] = self._as_control(self._chase())
        elif self.settings.prey == "fleeing":
            self._control[predators:] = self._as_control(self._flight())
        elif self.settings.prey == "random" and not self._prey_learns:
            self._control[predators] = self._prey_plan[self._time]

    def _as_control(self, wish: Tensor) -> Tensor:
        return self._move_control(nearest_move(wish)) if self.settings.actions == "discrete" else unit_disc(wish)

    def _chase(self) -> Tensor:
        predators, worlds = self.settings.num_predators, self.worlds
        position, velocity = worlds.position, worlds.velocity
        aim = position[predators] + self._shift
        return chase(position[:predators], velocity[:predators], aim, velocity[predators])

    def _flight(self) -> Tensor:
        predators, position = self.settings.num_predators, self.worlds.position
        return flee(position[:predators], position[predators], BOUND * self.settings.half_side).unsqueeze(0)

    def _outcome(self) -> tuple[Tensor, dict[str, Tensor]]:
        predators, worlds = self.settings.num_predators, self.worlds
        position = worlds.position
        if isinstance(worlds, ManyWorlds):
            square = (position[:predators] - position[predators]).square_().sum(1)
        else:
            square = worlds.squared_contact_distance[:predators]
        touches = paid = _touches(square)
        if self.settings.reward_offset:
            paid = _touches(self._squared_to(position[predators:])[:predators, 0])
        reward = paid * TOUCH_REWARD
        if self._prey_learns:
            hunted = -reward - out_of_bounds(position[predators] / self.settings.half_side).sum(0)
            both = torch.cat([reward.expand(predators, -1), hunted.unsqueeze(0)])
            reward = hunted if self.settings.control == "prey" else both
        if not self.measures:
            return reward, {}
        return reward, {"contact": touches.clamp_max(1.0), "touches": touches, "prey_distance": square.amin(0).sqrt()}


def _touches(squared_distance: Tensor) -> Tensor:
    """Return how many predators touch a prey [W], given squared distances of the centres [P, W]."""
    return (squared_distance < (PREDATOR_RADIUS + PREY_RADIUS) ** 2).float().sum(0)


def out_of_bounds(position: Tensor) -> Tensor:
    """Return MPE's penalty per coordinate: 0 below 0.9, 10 (u - 0.9) below 1, then min(exp(2u - 2), 10), u = |x|."""
    u = position.abs()
    return torch.where(u < 1.0, (u - 0.9).clamp_min(0.0) * 10, (2 * u - 2).exp().clamp_max(10.0))


def chase(predator: Tensor, predator_velocity: Tensor, prey: Tensor, prey_velocity: Tensor) -> Tensor:
    """Return the wishes [N, 2, W] of predators [N, 2, W] that run at the prey [2, W]."""
    return URGENCY * (prey + PREY_LEAD_S * prey_velocity - predator - OWN_LEAD_S * predator_velocity)


def circle(predator: Tensor, radius: float) -> Tensor:
    """Return the wishes of predators [N, 2, W] that go around the origin, counter-clockwise, at this radius."""
    distance = predator.norm(dim=1, keepdim=True).clamp_min(_TINY)
    out = predator / distance
    return torch.stack([-out[:, 1], out[:, 0]], 1) + URGENCY * (radius - distance) * out


def flee(predator: Tensor, prey: Tensor, bound: float = BOUND) -> Tensor:
    """Return the wish [2, W] of a prey: from the nearest of predators [N, 2, W], or back when out of bounds."""
    away = prey - predator
    squared = away.square().sum(1, keepdim=True)
    nearest = squared.argmin(0, keepdim=True).expand(1, 2, -1)
    direction = away.gather(0, nearest)[0] / squared.amin(0).clamp_min(_TINY).sqrt()
    outside = prey.square().sum(0) > bound**2
    return _FAR * torch.where(outside, -prey, direction)
