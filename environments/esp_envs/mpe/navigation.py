"""Cooperative navigation (MPE `simple_spread`): N agents cover L landmarks without bumping into each other."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from pydantic import Field as Setting
from torch import Tensor

from esp_envs.base import BLIND
from esp_envs.batched import World
from esp_envs.mpe import covering
from esp_envs.mpe.many import ManyWorlds
from esp_envs.mpe.particles import Bodies
from esp_envs.mpe.task import FORCE, MOVES, OWN, ParticleSettings, ParticleTask
from esp_envs.scene import DARK, Body, Scene, look
from esp_envs.spec import Field, Items, Kind, TaskSpec, filled_layout, layout

AGENT_RADIUS = 0.15
_LANDMARK_RADIUS = 0.05  # for drawing only: landmarks touch nothing
SENSITIVITY = 5.0  # acceleration of a full force, length / s^2
OCCUPIED_WITHIN = 0.1  # a landmark counts as covered when an agent's centre is nearer than this (mpe2's capture radius)
LOOKAHEAD_S = 0.2  # for which the present velocity carries an agent on; found by search, it brakes in time
FULL_FORCE_DISTANCE = 0.2  # that a step of full force makes in all (0.5 length/s, less by a quarter a step, 0.1 s)
LANDMARK_EXTENT = {"esp": 0.8, "pettingzoo": 1.0}


class NavigationSettings(ParticleSettings):
    """What a user may change of `navigation`."""

    num_agents: int = Setting(3, ge=1, le=100_000, description="N, learning agents; the paper has 2, 3 and 4")
    num_landmarks: int | None = Setting(
        None,
        ge=1,
        le=100_000,
        description="L, landmarks; by default as many as agents, but 3 for 2 agents, which the paper's row fits",
    )
    landmark_extent: float | None = Setting(
        None,
        gt=0,
        le=1e6,
        description="landmarks start in the square [-extent, extent]^2 (lengths); 0.8 by default, 1.0 for pettingzoo",
    )
    local_ratio: float = Setting(
        0.5, ge=0, le=1, description="pettingzoo convention only: weight of the own collisions against the team's term"
    )

    @property
    def landmarks(self) -> int:
        return self.num_landmarks or (3 if self.num_agents == 2 else self.num_agents)

    @property
    def extent(self) -> float:
        return self.landmark_extent or (self.half_side if self.density else LANDMARK_EXTENT[self.convention])

    @property
    def team(self) -> int:
        return self.num_agents

    def without_effect(self) -> frozenset[str]:
        return frozenset({"local_ratio"} if self.convention == "esp" else ())


class Navigation(ParticleTask):
    """Cooperative navigation, MPE's `simple_spread`.

    N agents (discs of radius 0.15, mass 1) cover L landmarks together and avoid contact. The plane
    is unbounded; lengths have no physical unit, a step is 0.1 s. The physics stands in `esp_envs.mpe.particles`.

    Actions:
        discrete: 0 no-op, 1 left, 2 right, 3 down, 4 up: a force of acceleration 5.0 length/s^2 in that direction.
        continuous: `force`, a vector in the unit disc times 5.0 length/s^2; longer vectors are scaled back to 1.

    Observation of one agent, 2 + L + (N - 1) planar vectors (N = L = 3: 14 numbers):

        | index (N = L = 3) | field          | meaning                                          | unit     |
        |-------------------|----------------|--------------------------------------------------|----------|
        | 0..1              | velocity       | own velocity                                     | length/s |
        | 2..3              | position       | own position                                     | length   |
        | 4..9              | landmarks      | each landmark minus own position                 | length   |
        | 10..13            | others         | each other agent, in index order, minus own pos. | length   |

    State: velocities of all agents, positions of all agents, positions of the landmarks, in the world frame.

    Reward, after the move, with d(j, l) the distance between agent j and landmark l, c_i the agents whose centres are
    nearer than 0.3 to agent i:
        convention `esp` (paper; original MPE): every agent gets sum_i [ -sum_l min_j d(j, l) - c_i - 1 ]
            = -N sum_l min_j d(j, l) - 2 (colliding pairs) - N; the -1 is the original's "collision with itself".
        convention `pettingzoo` (mpe2): agent i gets
            -(1 - local_ratio) sum_l min_j d(j, l) - local_ratio c_i.

    Start: velocities zero, agents uniform in [-1, 1]^2, landmarks uniform in [-0.8, 0.8]^2 (`esp`) or [-1, 1]^2
    (`pettingzoo`). In the `esp` convention the velocity is updated before the position, as in the original MPE; in the
    `pettingzoo` convention after it, as in mpe2.

    Terminated: never. Truncated: after `horizon` = 25 steps; bootstrap there.

    Many agents: with `sees` = k an agent sees the k nearest landmarks and others, sorted by distance, so that its row
    does not grow with N; `density` makes the square at the start grow with N.

    Metrics a step: `collisions` (touching pairs of agents), `collisions_per_agent` (other agents that touch one),
    `landmark_distance` (mean over landmarks of the distance to the nearest agent, length), `coverage` (share of
    landmarks with an agent within 0.1).

    Symmetry: dynamics and reward are invariant under all rotations and reflections of the plane; five discrete moves
    carry those of the square (`d4`), a planar force carries all (`o2`). Settings that break it leave: `wind` and `mud`
    the mirror `flip-x`, `action_turn_rad` the rotations, `reward_offset` (d is measured to places right of the
    landmarks) `flip-x`.

    Heuristics: `nearest` (each agent takes a landmark of its own, above 8 agents by the Hungarian method), `cover`
    (agents share out all landmarks between them, for L > N; where there are at most 4096 ways, N^L, to do so), `blind`
    (sees no landmark: up to 64 agents share out the places from which the nearest is least far in the mean).

    Anchors, `esp` convention, N = L = 3, return of one agent per episode: random -218, blind -166, nearest -112,
    cover -109.

    Versions:
        1: first.
    """

    Settings: ClassVar[type[NavigationSettings]] = NavigationSettings
    heuristics: tuple[str, ...] = ("nearest", "cover", BLIND)
    settings: NavigationSettings

    def __init__(self, settings: NavigationSettings, num_envs: int, generators: Sequence[torch.Generator]) -> None:
        super().__init__(settings, num_envs, generators)
        agents, landmarks = settings.num_agents, settings.landmarks
        shared = () if landmarks * math.log(agents) > math.log(covering.MAX_SHARINGS) else ("cover",)
        self.heuristics = ("nearest", *shared, *((BLIND,) if agents <= covering.MOST_PLACES else ()))

    def _describe(self) -> TaskSpec:
        settings = self.settings
        agents, landmarks = settings.num_agents, settings.landmarks
        discrete = settings.actions == "discrete"
        whole = "d4*agents" if discrete else "o2*agents"
        esp = settings.convention == "esp"
        reward = "team sum, self-collision counted" if esp else f"local_ratio {settings.local_ratio:g}"
        return TaskSpec(
            name="navigation",
            version=1,
            convention=f"{settings.convention}: {reward}{settings.broken_in_words()}",
            num_agents=agents,
            horizon=settings.horizon,
            observation=filled_layout(*OWN, *settings.seen_fields("landmarks", landmarks, "others")),
            state=layout(
                Field("velocity", Kind.VECTOR, agents, "length/s", Items.AGENTS),
                Field("position", Kind.VECTOR, agents, "length", Items.AGENTS, is_point=True),
                Field("landmarks", Kind.VECTOR, landmarks, "length", family="landmarks", is_point=True),
            ),
            action=MOVES if discrete else FORCE,
            symmetry=settings.left_of(whole),
            nearly=whole,
            shifts=not settings.mud,
            shared_reward=esp,
            settings=settings.model_dump() | {"num_landmarks": landmarks, "landmark_extent": settings.extent},
        )

    def _bodies(self) -> Bodies:
        agents, landmarks = self.settings.num_agents, self.settings.landmarks
        listed = range(0 if self.settings.many else agents)  # agents whose pairs are listed
        return Bodies(
            radius=(AGENT_RADIUS,) * agents + (_LANDMARK_RADIUS,) * landmarks,
            gain=(SENSITIVITY,) * agents,
            max_speed=None,
            contacts=tuple(itertools.combinations(listed, 2)),
            watched=tuple(itertools.product(listed, range(agents, agents + landmarks))),
            extent=(self.settings.half_side,) * agents + (self.settings.extent,) * landmarks,
        )

    def _observe(self, world: World) -> Tensor:
        position = world["position"]
        return torch.cat([world["velocity"], position, *self._ways(position, world["landmarks"])], -1)

    def heuristic(self, name: str | None = None) -> Tensor:
        """Return the joint action of `nearest` (default), `cover` or `blind`."""
        worlds, agents, name = self.worlds, self.settings.num_agents, self.named_heuristic(name)
        position, landmark = worlds.position, worlds.entity[agents:] + self._shift
        if name == BLIND:
            places = covering.places(agents).to(self.device) * self.settings.extent
            landmark = places.unsqueeze(-1).expand(-1, -1, position.shape[-1]) + self._shift
        one_each = covering.assigned if self.settings.many else covering.one_each
        assign = covering.shared_out if name == "cover" else one_each
        goal = assign(position, landmark)
        return self._to_action((goal - position - LOOKAHEAD_S * worlds.velocity) / FULL_FORCE_DISTANCE)

    def scene(self, world: tuple[int, int] = (0, 0)) -> Scene:
        lane = world[0] * self.num_envs + world[1]
        places = self.worlds.entity[:, :, lane].tolist()
        agents = self.settings.num_agents
        bodies = [
            Body((x, y), AGENT_RADIUS, trail=True, label="agent", **look(k)) for k, (x, y) in enumerate(places[:agents])
        ]
        bodies += [
            Body((x, y), _LANDMARK_RADIUS, DARK, "cross", label="landmark", reach=OCCUPIED_WITHIN)
            for x, y in places[agents:]
        ]
        half = 1.4 * self.settings.half_side
        return Scene(tuple(bodies), (-half, half, -half, half), unit="length units")

    def _outcome(self) -> tuple[Tensor, dict[str, Tensor]]:
        agents, landmarks = self.settings.num_agents, self.settings.landmarks
        worlds, esp = self.worlds, self.settings.convention == "esp"
        if isinstance(worlds, ManyWorlds):
            touching, nearest = worlds.touching, worlds.squared_to_landmarks.sqrt()
            collisions = 0.5 * touching.sum(0)
        else:
            bumps = (worlds.squared_contact_distance < (2 * AGENT_RADIUS) ** 2).float()
            touching, collisions = bumps, bumps.sum(0)
            nearest = worlds.squared_watched_distance.view(agents, landmarks, -1).amin(0).sqrt_()
        distance = paid = nearest.sum(0)
        if self.settings.reward_offset:
            paid = self._squared_to(worlds.entity[agents:]).amin(0).sqrt_().sum(0)
        ratio = self.settings.local_ratio
        if esp:
            reward = (paid * -agents).sub_(collisions, alpha=2).sub_(agents)
        elif self.settings.many:
            reward = paid * (ratio - 1) - ratio * touching
        else:
            reward = torch.addmm(paid.expand(agents, -1), worlds.pushes.abs(), touching, beta=ratio - 1, alpha=-ratio)
        if not self.measures:
            return reward, {}
        return reward, {
            "collisions": collisions,
            "collisions_per_agent": collisions * (2 / agents),
            "landmark_distance": distance / landmarks,
            "coverage": (nearest < OCCUPIED_WITHIN).sum(0) / landmarks,
        }
