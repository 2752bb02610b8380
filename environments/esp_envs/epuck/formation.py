"""Formation change: N e-pucks on a square swap places with their antipodes without bumping into anything."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from esp_envs.batched import BatchedTask, Outcome, World
from esp_envs.epuck import formation_rules as rules
from esp_envs.epuck.engines import make_physics
from esp_envs.epuck.formation_spec import WHEEL_PAIRS, FormationSettings, formation_spec, nearest_pair
from esp_envs.epuck.gl import open_painter
from esp_envs.epuck.robot import BODY_RADIUS_M, DIMENSIONS, MAX_WHEEL_SPEED, Array
from esp_envs.scene import PALE, Body, Painter, Scene, look
from esp_envs.settings import TaskSettings
from esp_envs.spec import TaskSpec

_REMEMBERED = ("goals", "pillars", "wheel_factor", "pending", "arrived", "touching")


class Formation(BatchedTask):
    """Formation change of e-pucks: every robot drives to the antipode of its post, past the others and past pillars.

    N robots (discs of radius 0.037 m, 0.16 kg, at most 0.1256 m/s) stand around the edge of a walled square, eight on
    its corners and edge midpoints. All of them want to cross the middle at once. A control step is 0.1 s.

    Actions:
        continuous: `wheels`, left and right wheel speed in [-1, 1] times 6.28 rad/s; beyond that they are clipped.
        discrete: each wheel in steps of 0.2, 121 pairs; the left wheel is the slow index.

    Observation of one robot, 3 + (nearest robots) planar vectors in the world frame, positions relative to its own
    (no `obstacle` without pillars, no `robots` for a single robot):

        | index | field    | meaning                                     | unit      |
        |-------|----------|---------------------------------------------|-----------|
        | 0..1  | heading  | cosine and sine of the own heading          | direction |
        | 2..3  | obstacle | the nearest pillar's centre minus own       | m         |
        | 4..5  | goal     | own goal minus own position                 | m         |
        | 6..7  | robots   | the nearest robots' centres minus own       | m         |

    In the convention `tight`, `obstacle` and `robots` are seen as nearness instead: a vector in the direction of the
    body, of length exp(-gap / 0.2 m). The setting `sight` chooses either in both conventions. With `goal_sight_m` the
    goal is seen in that unit, and beyond it by its direction alone, so that the last centimetres count in the input.

    State: headings, positions, velocities, turning rates and goals of all robots, positions of the pillars. It says
        everything but what the robots' own differences and delays hide, and in `mujoco-3d` the wheels and tilts.

    Reward of robot i, with p its position and d the distance of centres:
        r_i = progress_weight (|p_before - goal| - |p - goal|) - collision_penalty [some body has d < C];
        convention `paper`: a penalty of 0.35 and C = 0.5 m, convention `tight`: 1.0 and C = 0.15 m. The
        return of an episode is the mean over robots of the sum over time.

    Start: posts missed by up to `start_noise_m` along x and y, headings uniform, everything at rest.

    Terminated: never. Truncated: after `horizon` = 300 steps; bootstrap there.

    Metrics, per episode: `arrival_rate` share of robots that were within `arrival_radius_m` of their goal at some time;
        `time_to_arrival_s` until the step in which it was, the whole episode for a robot that never was; `collisions`
        how often two bodies came to touch (robots with robots or pillars); `risky_rate` share of states in which two
        robots have a gap below 5 cm; `path_length_m` of a robot; `final_distance_m` between a robot and its goal at
        the end.

    Heuristics: `avoid` (default) drives to the goal, gives way to near bodies and passes them on the right; `straight`
        turns to the goal and drives.

    Symmetry: quarter turns and mirrors (`d4`). A rotation turns headings and vectors and leaves wheels alone, a mirror
        swaps the wheels. Pillars and goals stand in the state and turn along. `slope` leaves the mirror `flip-x`.

    Versions: 1, the first.
    """

    Settings: ClassVar[type[TaskSettings]] = FormationSettings
    heuristics = ("avoid", "straight")
    makes_new_tensors = True
    robot: ClassVar[Mapping[str, float]] = {**DIMENSIONS, "fading_m": rules.FADING_M}
    settings: FormationSettings

    def __init__(self, settings: FormationSettings, num_envs: int, generators: Sequence[torch.Generator]) -> None:
        super().__init__(settings, num_envs, generators)
        self.arena = settings.arena
        self.num_worlds = self.num_seeds * num_envs
        self.physics = make_physics(settings.physics, self.arena, self.num_worlds, settings.control_period_s)
        robots = (self.num_worlds, settings.num_agents)
        self._posts = np.broadcast_to(self.arena.posts(), (*robots, 2))
        self._pairs = np.array(WHEEL_PAIRS.points)
        self._furnish()
        self._wheel_factor = np.ones((*robots, 2))
        self._pending = np.zeros((settings.action_delay, *robots, 2))
        self._arrived = np.zeros(robots, bool)
        bodies = settings.num_agents + settings.num_obstacles
        self._own = np.eye(settings.num_agents, bodies, dtype=bool)
        radii = [BODY_RADIUS_M] * settings.num_agents + [settings.obstacle_radius_m] * settings.num_obstacles
        self._reach = np.array(radii) + BODY_RADIUS_M
        self._contact = self._reach + rules.CONTACT_GAP_M
        pose = np.concatenate([self._posts, np.zeros((*robots, 1))], -1)
        self._place(pose, np.zeros_like(pose), np.ones(robots), np.ones(robots))

    def _describe(self) -> TaskSpec:
        return formation_spec(self.settings)

    def _furnish(self) -> None:
        self._goals, self._pillars = -self._posts, np.tile(self.arena.pillars(), (self.num_worlds, 1, 1))

    def _start(self, generator: torch.Generator) -> World:
        """Draw all that chance decides: uniform in [-1, 1], wheel factors normal."""
        robots = (self.num_envs, self.settings.num_agents)

        def uniform(*shape: int) -> Tensor:
            drawn = torch.rand(*robots, *shape, generator=generator, dtype=torch.float64, device=self.device)
            return drawn * 2 - 1

        places, headings = uniform(2), uniform()
        wheels = torch.randn(*robots, 2, generator=generator, dtype=torch.float64, device=self.device)
        return {"place": places, "heading": headings, "wheels": wheels, "mass": uniform(), "friction": uniform()}

    def _begin_with(self, drawn: World) -> None:
        settings = self.settings
        own = {name: value.flatten(0, 1).cpu().numpy() for name, value in drawn.items()}
        self._furnish()
        self._wheel_factor = 1 + settings.wheel_mismatch * own["wheels"]
        mass, friction = 1 + settings.mass_spread * own["mass"], 1 + settings.friction_spread * own["friction"]
        places = self._posts + settings.start_noise_m * own["place"]
        pose = np.concatenate([places, math.pi * own["heading"][..., None]], -1)
        self._place(pose, np.zeros_like(pose), mass, friction)

    def _place(self, pose: Array, velocity: Array, mass: Array, friction: Array) -> None:
        self._pending[:], self._arrived[:] = 0, False
        self.physics.place(pose, velocity, self._pillars, mass, friction)
        self._look()
        self._touching = self._apart < self._contact

    def _advance(self, world: World, action: Tensor) -> Outcome:
        before, distance_before = self._position, self._distance
        self.physics.advance(self._wheel_speeds(action))
        self._look()
        reward = self.settings.progress_weight * (distance_before - self._distance)
        reward -= self.settings.penalty * (self._apart < self.settings.radius).any(-1)
        if not self.measures:
            return self._per_world(reward), {}
        ended = self._time + 1 == self.spec.horizon
        metrics = self._measure(rules.length(self._position - before), ended)
        values = torch.from_numpy(np.array([*metrics.values()], np.float32))
        values = values.view(-1, *self._worlds_shape).to(self.device)
        return self._per_world(reward), dict(zip(metrics, values, strict=True))

    def _wheel_speeds(self, action: Tensor) -> Array:
        """Return what the wheels really do [W, N, 2], rad/s."""
        rows = action.cpu().numpy().reshape(self.num_worlds, self.settings.num_agents, -1)
        chosen = self._pairs[rows[..., 0]] if self.settings.actions == "discrete" else np.clip(rows, -1, 1, dtype=float)
        if self.settings.action_delay:
            waiting = np.concatenate([self._pending, chosen[None]])
            chosen, self._pending = waiting[0], waiting[1:]
        speeds = chosen * self._wheel_factor * MAX_WHEEL_SPEED
        if self.settings.slope:
            speeds *= 1 - self.settings.slope * self._direction[..., :1] * np.sign(speeds)
        return speeds

    def _look(self) -> None:
        """Measure where everything is: distances to goals, ways and distances between bodies."""
        pose = self.physics.pose
        self._position, self._heading = pose[..., :2], pose[..., 2]
        self._direction = _direction(self._heading)
        self._to_goal = self._goals - self._position
        self._distance = rules.length(self._to_goal)
        self._ways = np.concatenate([self._position, self._pillars], 1)[:, None] - self._position[:, :, None]
        self._apart = rules.length(self._ways)
        self._apart[:, self._own] = np.inf

    def _measure(self, way: Array, ended: bool) -> dict[str, Array]:
        """Return the metrics of the step just made, each [W]; `way` [W, N] is what every robot drove in it, m."""
        robots, here = self.settings.num_agents, self._distance < self.settings.arrival_radius_m
        new, self._arrived = here & ~self._arrived, here | self._arrived
        touching = self._apart < self._contact
        begun, self._touching = touching & ~self._touching, touching
        risky = self._apart[..., :robots] < rules.RISKY_GAP_M + 2 * BODY_RADIUS_M
        return {
            "arrival_rate": new.mean(-1),
            "time_to_arrival_s": (~self._arrived).mean(-1) * self.settings.control_period_s,
            "collisions": begun[..., :robots].sum((1, 2)) / 2 + begun[..., robots:].sum((1, 2)),
            "risky_rate": risky.any((1, 2)),
            "path_length_m": way.mean(-1),
            "final_distance_m": (self._distance * ended).mean(-1),
        }

    def _observe(self, world: World) -> Tensor:
        robots, pillars = self.settings.num_agents, self.settings.num_obstacles
        offsets = [self._to_goal[:, :, None]]
        if pillars:
            offsets.append(rules.nearest(self._apart[..., robots:], self._ways[:, :, robots:], 1))
        if self.settings.seen_robots:
            apart, ways = self._apart[..., :robots], self._ways[:, :, :robots]
            offsets.append(rules.nearest(apart, ways, self.settings.seen_robots))
        seen, heading = np.concatenate(offsets, 2), self._heading
        if self.settings.sensor_noise_m or self.settings.heading_noise_rad:
            heading, seen = self._disturbed(seen)
        direction = self._direction if heading is self._heading else _direction(heading)
        goal, pillar, others = np.split(seen, [1, 1 + min(pillars, 1)], 2)
        if self.settings.goal_sight_m is not None:
            goal = rules.within(goal, self.settings.goal_sight_m)
        if self.settings.seen_as == "nearness":
            pillar = rules.nearness(pillar, self.settings.obstacle_radius_m + BODY_RADIUS_M)
            others = rules.nearness(others, 2 * BODY_RADIUS_M)
        obs = np.concatenate([direction[:, :, None], pillar, goal, others], 2)
        return self._per_world(obs)

    def _state(self) -> Tensor:
        velocity = self.physics.velocity
        rows = (self._direction, self._position, velocity[..., :2], velocity[..., 2], self._goals, self._pillars)
        return self._per_world(np.concatenate([part.reshape(self.num_worlds, -1) for part in rows], 1))

    def _disturbed(self, seen: Array) -> tuple[Array, Array]:
        """Return the heading [W, N] and the offsets [W, N, B, 2] with the sensors' noise."""
        shape = (self.num_envs, self.settings.num_agents, 1 + 2 * seen.shape[2])
        draws = (torch.randn(shape, generator=g, dtype=torch.float64, device=self.device) for g in self.generators)
        noise = np.concatenate([drawn.cpu().numpy() for drawn in draws])
        offsets = noise[..., 1:].reshape(seen.shape) * self.settings.sensor_noise_m
        return self._heading + self.settings.heading_noise_rad * noise[..., 0], seen + offsets

    def _per_world(self, values: Array) -> Tensor:
        return torch.from_numpy(values.astype(np.float32)).view(*self._worlds_shape, *values.shape[1:]).to(self.device)

    def _put(self, state: Tensor) -> None:
        rows = state.double().cpu().numpy().reshape(self.num_worlds, -1)
        where = self.spec.state.slices()

        def items(name: str) -> Array:
            return rows[:, where[name]].reshape(self.num_worlds, -1, 2).copy()

        heading = items("heading")
        pose = np.concatenate([items("position"), np.arctan2(heading[..., 1:], heading[..., :1])], -1)
        velocity = np.concatenate([items("velocity"), rows[:, where["spin"], None]], -1)
        self._goals = items("goals")
        if self.settings.num_obstacles:
            self._pillars = items("obstacles")
        self._wheel_factor = np.ones_like(self._wheel_factor)
        self._place(pose, velocity, np.ones(pose.shape[:2]), np.ones(pose.shape[:2]))

    def _to_save(self) -> dict[str, Tensor]:
        arrays = {name: getattr(self, f"_{name}") for name in _REMEMBERED}
        physics = self.physics.state_dict()
        arrays |= {name: physics[name] for name in ("mass", "friction")}  # as runs that were begun before have them
        arrays |= {f"physics.{name}": array for name, array in physics.items()}
        return {name: torch.from_numpy(array) for name, array in arrays.items()}

    def _take_back(self, saved: dict[str, Tensor]) -> None:
        arrays = {name: tensor.cpu().numpy() for name, tensor in saved.items()}
        for name in _REMEMBERED:
            setattr(self, f"_{name}", arrays[name].copy())
        self.physics.load_state_dict({k.removeprefix("physics."): v for k, v in arrays.items() if "." in k})
        self._look()

    def heuristic(self, name: str | None = None) -> Tensor:
        """Return the joint action of `avoid` (default) or `straight`."""
        name = self.named_heuristic(name)
        wish = self._to_goal
        if name == "avoid":
            wish = rules.give_way(wish, self._ways, self._apart - self._reach)
        wheels = rules.towards(wish, self._heading, self.settings.control_period_s)
        if self.settings.actions == "discrete":
            return nearest_pair(torch.from_numpy(wheels)).view(self._agents_shape).to(self.device)
        return self._per_world(wheels)

    def scene(self, world: tuple[int, int] = (0, 0)) -> Scene:
        w = world[0] * self.num_envs + world[1]
        goals, pillars, places = (of[w].tolist() for of in (self._goals, self._pillars, self._position))
        radius, half = self.settings.obstacle_radius_m, self.arena.side_m / 2
        goal = partial(Body, radius=BODY_RADIUS_M, shape="ring", model="goal", label="goal")
        robot = partial(Body, radius=BODY_RADIUS_M, trail=True, model="robot", label="robot")
        bodies = [
            *(goal((x, y), **look(i)) for i, (x, y) in enumerate(goals)),
            *(Body((x, y), radius, PALE, model="pillar", label="pillar") for x, y in pillars),
            *(robot((x, y), heading=float(self._heading[w, i]), **look(i)) for i, (x, y) in enumerate(places)),
        ]
        return Scene(tuple(bodies), (-half, half, -half, half), unit="m")

    def painter(self, size: int) -> AbstractContextManager[Painter]:
        return open_painter(size)


def _direction(heading: Array) -> Array:
    """Return unit vectors [..., 2] in the direction of headings [...]."""
    return np.stack([np.cos(heading), np.sin(heading)], -1)
