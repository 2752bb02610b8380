"""MuJoCo in space: an e-puck that stands on two driven wheels and two casters, to try policies that were trained flat.

Wheels are spheres: cylinders on an edge spin the robot 9 to 24 % too slowly. Contacts with the floor have elliptic
friction cones, which look the same from every direction. Between robots, walls and pillars a robot is a frictionless
sphere at half its height: a capsule would touch another at its upper or its lower end depending on the last bit of
their tilt, and a sphere touches where the middle of an upright cylinder does.
"""

from __future__ import annotations

import mujoco
import numpy as np

from esp_envs.epuck.arena import Arena
from esp_envs.epuck.mujoco_arena import TIMESTEP_S, MujocoWorlds, add_body, add_pillars, new_spec
from esp_envs.epuck.robot import (
    AXLE_M,
    BODY_HEIGHT_M,
    BODY_RADIUS_M,
    FRICTION,
    GRAVITY_M_S2,
    MASS_KG,
    WHEEL_MASS_KG,
    WHEEL_RADIUS_M,
    Array,
)

CENTRE_HEIGHT_M = 0.020
"""Of the mass, ours: at the axle, where the battery and the motors are."""
CASTER_RADIUS_M = 0.005
CASTER_DISTANCE_M = 0.028
"""Of each caster from the axle, ahead and behind; ours: just inside the body."""
MOTOR_INERTIA = MASS_KG / 2 * WHEEL_RADIUS_M**2
"""kg m^2 of each rotor behind its gear, ours: as much as a wheel feels of the robot. Servo and contacts are solved
one after the other, and a light wheel on a firm servo would be torn from the floor at every time step."""
MOTOR_TORQUE_N_M = 0.007
"""Of each motor at its wheel, ours: a little less than the floor holds, wheels and casters sharing the weight. So a
robot that pushes something stalls. Wheels that spin would shake it, and its path would be chaotic."""
_SETTLING_STEPS = 300
_FLOOR = 2
"""Collision bit of the floor, which holds wheels and casters only; everything else meets at MuJoCo's own bit 1."""


class MujocoSpatial(MujocoWorlds):
    """MuJoCo with gravity: a free joint and two wheel hinges a robot. More mass comes without stronger motors."""

    def __init__(self, arena: Arena, num_worlds: int, control_period_s: float, num_threads: int) -> None:
        super().__init__(model_of(arena), arena, num_worlds, control_period_s, num_threads)
        self._depth = -self.model.qpos0[2]
        self._wheels = np.flatnonzero(self.model.geom_condim == 3)

    def _move(self, pose: Array, velocity: Array) -> None:
        """Stand every robot upright on the floor, its wheels rolling without slip."""
        heading, spin = pose[..., 2], velocity[..., 2]
        self._qpos[:], self._qvel[:] = 0.0, 0.0
        self._qpos[..., :2], self._qpos[..., 2] = pose[..., :2], -self._depth
        self._qpos[..., 3], self._qpos[..., 6] = np.cos(heading / 2), np.sin(heading / 2)
        self._qvel[..., :2], self._qvel[..., 5] = velocity[..., :2], spin
        forward = velocity[..., 0] * np.cos(heading) + velocity[..., 1] * np.sin(heading)
        self._qvel[..., 6] = (forward - spin * AXLE_M / 2) / WHEEL_RADIUS_M
        self._qvel[..., 7] = (forward + spin * AXLE_M / 2) / WHEEL_RADIUS_M

    def _adapt_wheels(self, mass: Array, friction: Array) -> None:
        """Give both wheels of every robot its friction; the weight on them knows the mass already."""
        self._batch.expand("geom_friction")[:, self._wheels, 0] = FRICTION * np.repeat(friction, 2, axis=1)

    def advance(self, wheels: Array) -> None:
        """Drive for one control period."""
        self._control[:] = wheels
        self._batch.step(nstep=self._substeps)

    @property
    def pose(self) -> Array:
        """[W, N, 3] x, y and heading in (-pi, pi]."""
        w, x, y, z = np.moveaxis(self._qpos[..., 3:7], -1, 0)
        heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return np.concatenate([self._qpos[..., :2], heading[..., None]], -1)

    @property
    def velocity(self) -> Array:
        """[W, N, 3] of x, y and heading, where tilting is too little to matter."""
        return self._qvel[..., [0, 1, 5]]


def model_of(arena: Arena) -> mujoco.MjModel:
    """Build one world: walls, floor, robots `robot0..` sunk in as deep as they settle, pillars `pillar0..`.

    A robot that just touches the floor would bounce, or not, by the last bit of its height. And wheels press into the
    floor, so that they roll on a circle smaller by half that depth: they are built larger by as much.
    """
    lone = Arena(arena.side_m, 1, 0, arena.pillar_radius_m)
    model = _compile(lone, depth=0.0)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, _SETTLING_STEPS)
    return _compile(arena, depth=-data.qpos[2])


def _compile(arena: Arena, depth: float) -> mujoco.MjModel:
    """Build one world with the robots `depth` in the floor."""
    spec = new_spec(arena)
    spec.option.gravity = [0, 0, -GRAVITY_M_S2]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[arena.side_m / 2] * 2 + [0.01], contype=_FLOOR, conaffinity=0
    )
    for i in range(arena.num_robots):
        _robot(spec, i, depth)
    add_pillars(spec, arena)
    return spec.compile()


def _robot(spec: mujoco.MjSpec, index: int, depth: float) -> None:
    """Add a body on two casters and two wheels with velocity servos; its origin is between the wheels on the ground."""
    sphere, mass = mujoco.mjtGeom.mjGEOM_SPHERE, MASS_KG - 2 * WHEEL_MASS_KG
    tilting = mass * (3 * BODY_RADIUS_M**2 + BODY_HEIGHT_M**2) / 12
    inertia = [tilting, tilting, mass * BODY_RADIUS_M**2 / 2]
    body = add_body(spec.worldbody, f"robot{index}", mass, inertia, [0, 0, -depth], [0, 0, CENTRE_HEIGHT_M])
    body.add_freejoint(name=f"robot{index}")
    body.add_geom(type=sphere, size=[BODY_RADIUS_M, 0, 0], pos=[0, 0, BODY_HEIGHT_M / 2])
    for ahead in (CASTER_DISTANCE_M, -CASTER_DISTANCE_M):
        place = [ahead, 0, CASTER_RADIUS_M]
        body.add_geom(type=sphere, size=[CASTER_RADIUS_M, 0, 0], pos=place, contype=0, conaffinity=_FLOOR)
    rim = WHEEL_RADIUS_M + depth / 2
    for side, beside in (("left", AXLE_M / 2), ("right", -AXLE_M / 2)):
        name = f"{side}{index}"
        ball = [0.4 * WHEEL_MASS_KG * WHEEL_RADIUS_M**2] * 3
        wheel = add_body(body, name, WHEEL_MASS_KG, ball, [0, beside, rim], [0, 0, 0])
        wheel.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0], armature=MOTOR_INERTIA)
        # By its priority a wheel's own friction counts, not the larger one of wheel and floor.
        wheel.add_geom(
            type=sphere,
            size=[rim, 0, 0],
            contype=0,
            conaffinity=_FLOOR,
            condim=3,
            priority=1,
            friction=[FRICTION, 0, 0],
        )
        servo = spec.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            forcelimited=True,
            forcerange=[-MOTOR_TORQUE_N_M, MOTOR_TORQUE_N_M],
        )
        # The firmest that does not overshoot: off the floor it would reach its speed in one time step.
        servo.set_to_velocity(kv=(MOTOR_INERTIA + ball[0]) / TIMESTEP_S)
