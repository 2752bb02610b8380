"""MuJoCo in the plane: the physics that policies are trained in.

A robot is a frictionless disc (in MuJoCo a sphere at height 0) on two slides and a hinge. Its wheels are velocity
servos along the chord of the arc that they would drive; their force is limited by the friction of the wheels on the
floor. Spheres, plane walls and the Newton solver keep a quarter turn of a world exact to the last bits through
contacts; MuJoCo's cylinders do not as bodies that move, and stand here as pillars only.
"""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco.batch import Batch

from esp_envs.epuck.arena import Arena
from esp_envs.epuck.physics import Bodies, Physics, num_substeps
from esp_envs.epuck.robot import AXLE_M, BODY_RADIUS_M, FRICTION, GRAVITY_M_S2, MASS_KG, Array, chord

TIMESTEP_S = 0.01
SERVO_TIME_S = 0.015
"""Time constant of the wheel servos; below the time step they would overshoot."""
_INERTIA = MASS_KG * BODY_RADIUS_M**2 / 2
_MAX_FORCE_N = FRICTION * MASS_KG * GRAVITY_M_S2
_MAX_TORQUE_N_M = _MAX_FORCE_N * AXLE_M / 2


class MujocoPlanar(Physics):
    """Planar MuJoCo, all worlds in one `mujoco.batch.Batch`."""

    def __init__(self, arena: Arena, num_worlds: int, control_period_s: float, num_threads: int) -> None:
        super().__init__(arena, num_worlds, control_period_s, num_threads)
        self._substeps = num_substeps(control_period_s, TIMESTEP_S)
        self.model = model_of(arena)
        self._batch = Batch(self.model, nsim=num_worlds, nthread=num_threads)
        shape = (num_worlds, arena.num_robots, 3)
        self._qpos = self._batch.bind("qpos").reshape(shape)
        self._qvel = self._batch.bind("qvel").reshape(shape)
        self._control = self._batch.bind("ctrl").reshape(shape)
        self._pillars = self._batch.bind("mocap_pos")
        self._warmstart = self._batch.bind("qacc_warmstart")
        self._mass = self._friction = np.ones(shape[:2])

    def place(self, bodies: Bodies) -> None:
        """Put every world into this state."""
        self._qpos[:], self._qvel[:], self._warmstart[:] = bodies.pose, bodies.velocity, 0.0
        if self.arena.num_pillars:
            self._pillars[..., :2] = bodies.pillars
        if not (np.array_equal(bodies.mass, self._mass) and np.array_equal(bodies.friction, self._friction)):
            self._set_material(bodies.mass.copy(), bodies.friction.copy())

    def _set_material(self, mass: Array, friction: Array) -> None:
        """Give every robot its own mass and grip; its servos keep their time constant."""
        self._mass, self._friction = mass, friction
        robots = slice(1, 1 + self.arena.num_robots)
        scale = np.repeat(mass, 3, axis=1)
        self._batch.expand("body_mass")[:, robots] = MASS_KG * mass
        self._batch.expand("body_inertia")[:, robots] = _INERTIA * mass[:, :, None]
        self._batch.set_const()
        gain = self.model.actuator_gainprm[:, 0] * scale
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

    def state_dict(self) -> dict[str, Array]:
        """Return everything a world's future depends on."""
        names = ("qpos", "qvel", "pillars", "warmstart", "mass", "friction")
        return {name: getattr(self, f"_{name}").copy() for name in names}

    def load_state_dict(self, arrays: dict[str, Array]) -> None:
        """Restore what `state_dict` returned."""
        self.place(Bodies(arrays["qpos"], arrays["qvel"], arrays["pillars"][..., :2], arrays["mass"], arrays["friction"]))
        self._warmstart[:] = arrays["warmstart"]


def model_of(arena: Arena) -> mujoco.MjModel:
    """Build one world: walls, robots `robot0..`, pillars `pillar0..`."""
    spec = mujoco.MjSpec()
    spec.option.timestep = TIMESTEP_S
    spec.option.gravity = [0, 0, 0]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    spec.default.geom.condim = 1
    half = arena.side_m / 2
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        _wall(spec, x, y, half)
    for i in range(arena.num_robots):
        _robot(spec, i)
    for k in range(arena.num_pillars):
        pillar = spec.worldbody.add_body(name=f"pillar{k}", mocap=True)
        pillar.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[arena.pillar_radius_m, BODY_RADIUS_M, 0])
    return spec.compile()


def _wall(spec: mujoco.MjSpec, x: int, y: int, half: float) -> None:
    """Add the wall whose inner side faces (x, y)."""
    towards = np.sqrt(0.5)
    # The z axis of a plane points out of the wall; each quaternion turns (0, 0, 1) to (x, y, 0).
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[half, half, 0.01],
        pos=[-x * half, -y * half, 0],
        quat=[towards, -y * towards, x * towards, 0],
    )


def _robot(spec: mujoco.MjSpec, index: int) -> None:
    """Add a disc on two slides and a hinge, with a velocity servo on each."""
    body = spec.worldbody.add_body(name=f"robot{index}", mass=MASS_KG, inertia=[_INERTIA] * 3, ipos=[0, 0, 0])
    body.explicitinertial = True
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
