"""Pymunk (Chipmunk2D): a second opinion on planar contacts, from a solver of another kind.

A robot is a frictionless disc. Its wheels change its velocity to that of the chord of the arc that they would drive, by
one impulse at the beginning of a control period, in which contacts have their say: an impulse that would push a robot
into another is taken back in the same time step.

The state of a world is an array; a Chipmunk space is only what turns it into the next one. Chipmunk remembers contact
impulses and corrections of the step before, and searches trees whose shape is history; so that nothing but the array
counts, each control period begins with one step with everything far apart, which drops both, and shapes are found on a
grid that is filled again at every step.
"""

from __future__ import annotations

import numpy as np
import pymunk
from pymunk.batch import BodyFields, Buffer, get_space_bodies, set_space_bodies

from esp_envs.epuck.physics import TIMESTEP_S, Physics
from esp_envs.epuck.robot import AXLE_M, BODY_RADIUS_M, FRICTION, GRAVITY_M_S2, MASS_KG, Arena, Array, chord

ITERATIONS = 100  # iterations of the solver, which treats contacts in turn; with these many their order does not matter
CONTACT_SLOP_M = 1e-4  # overlap that is left alone
WALL_THICKNESS_M = 1.0
_INERTIA = MASS_KG * BODY_RADIUS_M**2 / 2
_FIELDS = (
    BodyFields.POSITION
    | BodyFields.ANGLE
    | BodyFields.VELOCITY
    | BodyFields.ANGULAR_VELOCITY
    | BodyFields.FORCE
    | BodyFields.TORQUE
)
_NUM_FIELDS = 9


class PymunkPlanar(Physics):
    """Pymunk, one space a world, on one thread: Python's lock is taken and given back at every short step."""

    remembered = ("pose", "velocity", "pillars", "mass", "friction")

    def __init__(self, arena: Arena, num_worlds: int, control_period_s: float) -> None:
        super().__init__(arena, num_worlds, control_period_s)
        self._robots: list[list[pymunk.Body]] = []
        self._spaces = [self._space() for _ in range(num_worlds)]
        # The space's own static body, which bears the walls, comes last in all that is read and written.
        rows = arena.num_robots + arena.num_pillars + 1
        # One number more than is read: Chipmunk's arrays grow, into memory that is not ours, as soon as they are full.
        memory = np.zeros((num_worlds, rows * _NUM_FIELDS + 1))
        self._buffers = [_buffer(row) for row in memory]
        state = memory[:, :-1].reshape(num_worlds, rows, _NUM_FIELDS)
        self._pose, self._velocity = state[:, : arena.num_robots, 0:3], state[:, : arena.num_robots, 3:6]
        self._force = state[:, : arena.num_robots, 6:9]
        self._pillars = state[:, arena.num_robots : -1, 0:2]
        far = np.arange(1, rows + 1) * [[10.0], [10.0]] * arena.side_m
        far[:, -1] = 0.0
        self._far = _buffer(far.T.ravel())
        self._mass = self._friction = np.ones((num_worlds, arena.num_robots))

    def _space(self) -> pymunk.Space:
        space, side = pymunk.Space(), self.arena.side_m
        space.iterations, space.collision_slop, space.collision_persistence = ITERATIONS, CONTACT_SLOP_M, 1
        # In cells as large as the arena every shape is compared with every other, which for a dozen is fastest.
        space.use_spatial_hash(2 * side, 1)
        robots = [pymunk.Body(MASS_KG, _INERTIA) for _ in range(self.arena.num_robots)]
        for robot in robots:
            space.add(robot, pymunk.Circle(robot, BODY_RADIUS_M))
        for _ in range(self.arena.num_pillars):
            pillar = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
            space.add(pillar, pymunk.Circle(pillar, self.arena.pillar_radius_m))
        far = side / 2 + WALL_THICKNESS_M
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            ends = (far * (x - y), far * (y + x)), (far * (x + y), far * (y - x))
            space.add(pymunk.Segment(space.static_body, *ends, WALL_THICKNESS_M))
        self._robots.append(robots)
        return space

    def place(self, pose: Array, velocity: Array, pillars: Array, mass: Array, friction: Array) -> None:
        self._pose[:], self._velocity[:], self._pillars[:] = pose, velocity, pillars
        for world, index in np.argwhere(mass != self._mass):
            robot, own = self._robots[world][index], float(mass[world, index])
            robot.mass, robot.moment = MASS_KG * own, _INERTIA * own
        self._mass, self._friction = mass.copy(), friction.copy()

    def advance(self, wheels: Array) -> None:
        self._force[:] = self._push(wheels)
        steps = range(self._substeps)
        for space, buffer in zip(self._spaces, self._buffers, strict=True):
            set_space_bodies(space, BodyFields.POSITION, self._far)
            space.step(TIMESTEP_S)
            set_space_bodies(space, _FIELDS, buffer)
            for _ in steps:
                space.step(TIMESTEP_S)
            buffer.clear()
            get_space_bodies(space, _FIELDS, buffer)

    def _push(self, wheels: Array) -> Array:
        """Return forces and torques [W, N, 3] that change the velocities to those of the wheels in one time step."""
        # Chipmunk moves bodies first and changes their velocities then: what is asked for acts one time step later.
        heading = self._pose[..., 2] + self._velocity[..., 2] * TIMESTEP_S
        change = chord(wheels, heading, self.control_period_s) - self._velocity
        grip = FRICTION * self._friction * GRAVITY_M_S2 * self.control_period_s
        length = np.hypot(change[..., 0], change[..., 1])
        change[..., :2] *= np.minimum(1.0, grip / np.maximum(length, 1e-12))[..., None]
        most = grip * MASS_KG * (AXLE_M / 2) / _INERTIA
        change[..., 2] = np.clip(change[..., 2], -most, most)
        return change * self._mass[..., None] * [MASS_KG, MASS_KG, _INERTIA] / TIMESTEP_S

    def load_state_dict(self, arrays: dict[str, Array]) -> None:
        self.place(**arrays)


def _buffer(numbers: Array) -> Buffer:
    """Return a buffer that pymunk reads from, and writes to, these contiguous numbers."""
    buffer = Buffer()
    buffer.set_float_buf(numbers)
    return buffer
