"""MuJoCo in the plane: the physics that policies are trained in.

A robot is a frictionless disc (in MuJoCo a sphere at height 0) on two slides and a hinge. Its wheels are velocity
servos along the chord of the arc that they would drive; their force is limited by the friction of the wheels on the
floor. Spheres, plane walls and the Newton solver keep a quarter turn of a world exact to the last bits through
contacts; MuJoCo's cylinders do not as bodies that move, and stand here as pillars only.
"""

from __future__ import annotations

import mujoco
import numpy as np

from esp_envs.epuck.arena import Arena
from esp_envs.epuck.mujoco_arena import MujocoWorlds, add_body, add_pillars, new_spec
from esp_envs.epuck.robot import AXLE_M, BODY_RADIUS_M, FRICTION, GRAVITY_M_S2, MASS_KG, Array, chord

SERVO_TIME_S = 0.015
"""Time constant of the wheel servos; below the time step they would overshoot."""
_INERTIA = MASS_KG * BODY_RADIUS_M**2 / 2
_MAX_FORCE_N = FRICTION * MASS_KG * GRAVITY_M_S2
_MAX_TORQUE_N_M = _MAX_FORCE_N * AXLE_M / 2


class MujocoPlanar(MujocoWorlds):
    """Planar MuJoCo: the joints are the pose."""

    def __init__(self, arena: Arena, num_worlds: int, control_period_s: float, num_threads: int) -> None:
        super().__init__(model_of(arena), arena, num_worlds, control_period_s, num_threads)

    def _move(self, pose: Array, velocity: Array) -> None:
        self._qpos[:], self._qvel[:] = pose, velocity

    def _adapt_wheels(self, mass: Array, friction: Array) -> None:
        """Keep the servos' time constant, and limit their force to the friction of the robot's weight."""
        gain = self.model.actuator_gainprm[:, 0] * np.repeat(mass, 3, axis=1)
        self._batch.expand("actuator_gainprm")[:, :, 0] = gain
        self._batch.expand("actuator_biasprm")[:, :, 2] = -gain
        grip = np.repeat(mass * friction, 3, axis=1)[:, :, None]
        self._batch.expand("actuator_forcerange")[:] = self.model.actuator_forcerange * grip

    def advance(self, wheels: Array) -> None:
        """Drive for one control period."""
        self._control[:] = chord(wheels, self._qpos[..., 2], self.control_period_s)
        self._batch.step(nstep=self._substeps)

    @property
    def pose(self) -> Array:
        """[W, N, 3] x, y and heading."""
        return self._qpos.copy()

    @property
    def velocity(self) -> Array:
        """[W, N, 3] of x, y and heading."""
        return self._qvel.copy()


def model_of(arena: Arena) -> mujoco.MjModel:
    """Build one world: walls, robots `robot0..`, pillars `pillar0..`."""
    spec = new_spec(arena)
    spec.option.gravity = [0, 0, 0]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    for i in range(arena.num_robots):
        _robot(spec, i)
    add_pillars(spec, arena)
    return spec.compile()


def _robot(spec: mujoco.MjSpec, index: int) -> None:
    """Add a disc on two slides and a hinge, with a velocity servo on each."""
    body = add_body(spec.worldbody, f"robot{index}", MASS_KG, [_INERTIA] * 3, [0, 0, 0], [0, 0, 0])
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[BODY_RADIUS_M, 0, 0])
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    joints = (
        ("x", slide, [1, 0, 0], MASS_KG, _MAX_FORCE_N),
        ("y", slide, [0, 1, 0], MASS_KG, _MAX_FORCE_N),
        ("heading", hinge, [0, 0, 1], _INERTIA, _MAX_TORQUE_N_M),
    )
    for name, kind, axis, inertia, limit in joints:
        body.add_joint(name=f"{name}{index}", type=kind, axis=axis)
        servo = spec.add_actuator(
            name=f"{name}{index}",
            target=f"{name}{index}",
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            forcelimited=True,
            forcerange=[-limit, limit],
        )
        servo.set_to_velocity(kv=inertia / SERVO_TIME_S)
