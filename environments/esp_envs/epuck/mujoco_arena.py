"""What the MuJoCo engines share: all worlds in one batch, the walls and pillars, and what robots are made of.

A robot of the model is one body with its children, some joints and some servos, in the same order for every robot;
whatever touches another robot, a wall or a pillar is a frictionless sphere. Spheres, planes and upright cylinders have
closed formulas for their contacts, so that a quarter turn of a world keeps its rounding errors small.
"""

from __future__ import annotations

from abc import abstractmethod

import mujoco
import numpy as np
from mujoco.batch import Batch

from esp_envs.epuck.arena import Arena
from esp_envs.epuck.physics import Bodies, Physics, num_substeps
from esp_envs.epuck.robot import BODY_RADIUS_M, Array

TIMESTEP_S = 0.01
mujoco.set_mju_user_warning(lambda _: None)  # by default warnings go to a file in the working directory


class MujocoWorlds(Physics):
    """W worlds of a MuJoCo model in one `mujoco.batch.Batch`, stepped by its threads."""

    remembered = ("qpos", "qvel", "pillars", "warmstart", "mass", "friction")

    def __init__(
        self, model: mujoco.MjModel, arena: Arena, num_worlds: int, control_period_s: float, num_threads: int
    ) -> None:
        super().__init__(arena, num_worlds, control_period_s, num_threads)
        self._substeps = num_substeps(control_period_s, TIMESTEP_S)
        self.model = model
        self._batch = Batch(model, nsim=num_worlds, nthread=num_threads)
        shape = (num_worlds, arena.num_robots)
        self._qpos = self._batch.bind("qpos").reshape(*shape, -1)
        self._qvel = self._batch.bind("qvel").reshape(*shape, -1)
        self._control = self._batch.bind("ctrl").reshape(*shape, -1)
        self._pillars = self._batch.bind("mocap_pos")
        self._warmstart = self._batch.bind("qacc_warmstart")
        self._mass = self._friction = np.ones(shape)

    def place(self, bodies: Bodies) -> None:
        """Put every world into this state."""
        self._move(bodies.pose, bodies.velocity)
        self._warmstart[:] = 0.0
        if self.arena.num_pillars:
            self._pillars[..., :2] = bodies.pillars
        self._make_of(bodies.mass, bodies.friction)

    @abstractmethod
    def _move(self, pose: Array, velocity: Array) -> None:
        """Write every robot's planar pose and velocity ([W, N, 3] each) into the joints."""

    def _make_of(self, mass: Array, friction: Array) -> None:
        """Give every robot its own mass and grip."""
        if np.array_equal(mass, self._mass) and np.array_equal(friction, self._friction):
            return
        self._mass, self._friction = mass.copy(), friction.copy()
        model, count = self.model, self.arena.num_robots
        parts = (model.nbody - 1 - self.arena.num_pillars) // count
        robots = slice(1, 1 + parts * count)
        of_parts = np.repeat(mass, parts, axis=1)
        self._batch.expand("body_mass")[:, robots] = model.body_mass[robots] * of_parts
        self._batch.expand("body_inertia")[:, robots] = model.body_inertia[robots] * of_parts[:, :, None]
        self._batch.set_const()
        self._adapt_wheels(mass, friction)

    @abstractmethod
    def _adapt_wheels(self, mass: Array, friction: Array) -> None:
        """Fit the wheels to mass and friction [W, N], which are multiples of a robot's own."""

    def load_state_dict(self, arrays: dict[str, Array]) -> None:
        """Write the arrays into the batch."""
        for name in self.remembered[:4]:
            getattr(self, f"_{name}")[:] = arrays[name]
        self._make_of(arrays["mass"], arrays["friction"])


def new_spec(arena: Arena) -> mujoco.MjSpec:
    """Start a model: frictionless contacts and the four walls. Robots come next, `add_pillars` last."""
    spec = mujoco.MjSpec()
    spec.option.timestep = TIMESTEP_S
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    spec.default.geom.condim = 1
    half, towards = arena.side_m / 2, np.sqrt(0.5)
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        # The z axis of a plane points out of the wall; each quaternion turns (0, 0, 1) to (x, y, 0).
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[half, half, 0.01],
            pos=[-x * half, -y * half, 0],
            quat=[towards, -y * towards, x * towards, 0],
        )
    return spec


def add_body(
    parent: mujoco.MjsBody, name: str, mass: float, inertia: list[float], position: list[float], centre: list[float]
) -> mujoco.MjsBody:
    """Add a body with its inertia as given, whatever geoms it gets.

    Args:
        parent: what it hangs on.
        name: of the body.
        mass: in kg.
        inertia: about its principal axes, which are its own, kg m^2.
        position: in the parent's frame, m.
        centre: of mass, in its own frame, m.
    """
    body = parent.add_body(name=name, pos=position, mass=mass, inertia=inertia, ipos=centre)
    body.explicitinertial = True
    return body


def add_pillars(spec: mujoco.MjSpec, arena: Arena) -> None:
    """Add the pillars `pillar0..`, which stand where their mocap positions say."""
    for k in range(arena.num_pillars):
        pillar = spec.worldbody.add_body(name=f"pillar{k}", mocap=True)
        pillar.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[arena.pillar_radius_m, BODY_RADIUS_M, 0])
