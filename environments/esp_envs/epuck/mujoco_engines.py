"""MuJoCo in the plane, in which policies are trained, and in space, to try them.

All worlds are one batch. A robot of the model is one body with its children, some joints and some servos, in the same
order for every robot. Whatever touches another robot, a wall or a pillar is a frictionless sphere. Spheres, planes and
upright cylinders have closed formulas for their contacts, so that a quarter turn of a world keeps its rounding errors
small; cylinders that move do not, and stand here as pillars only.
"""

from __future__ import annotations

from abc import abstractmethod

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch

from esp_envs.epuck.physics import TIMESTEP_S, Physics
from esp_envs.epuck.robot import (
    AXLE_M,
    BODY_HEIGHT_M,
    BODY_RADIUS_M,
    FRICTION,
    GRAVITY_M_S2,
    MASS_KG,
    WHEEL_MASS_KG,
    WHEEL_RADIUS_M,
    Arena,
    Array,
    chord,
)

mujoco.set_mju_user_warning(lambda _: None)  # by default warnings go to a file in the working directory


class MujocoWorlds(Physics):
    """W worlds of a MuJoCo model in one `mujoco.batch.Batch`, stepped by as many threads as PyTorch uses."""

    remembered = ("qpos", "qvel", "pillars", "warmstart", "mass", "friction")

    def __init__(self, arena: Arena, num_worlds: int, control_period_s: float) -> None:
        super().__init__(arena, num_worlds, control_period_s)
        self.model = self._model(arena)
        self._batch = Batch(self.model, nsim=num_worlds, nthread=torch.get_num_threads())
        shape = (num_worlds, arena.num_robots)
        self._qpos = self._batch.bind("qpos").reshape(*shape, -1)
        self._qvel = self._batch.bind("qvel").reshape(*shape, -1)
        self._pose, self._velocity = self._qpos, self._qvel
        self._control = self._batch.bind("ctrl").reshape(*shape, -1)
        self._pillars = self._batch.bind("mocap_pos")
        self._warmstart = self._batch.bind("qacc_warmstart")
        self._mass = self._friction = np.ones(shape)

    @abstractmethod
    def _model(self, arena: Arena) -> mujoco.MjModel:
        """Build one world: walls, robots, pillars."""

    def place(self, pose: Array, velocity: Array, pillars: Array, mass: Array, friction: Array) -> None:
        self._move(pose, velocity)
        self._warmstart[:] = 0.0
        if self.arena.num_pillars:
            self._pillars[..., :2] = pillars
        self._make_of(mass, friction)

    @abstractmethod
    def _move(self, pose: Array, velocity: Array) -> None:
        """Write every robot's planar pose and velocity ([W, N, 3] each) into the joints."""

    def _make_of(self, mass: Array, friction: Array) -> None:
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
        for name in self.remembered[:4]:
            getattr(self, f"_{name}")[:] = arrays[name]
        self._make_of(arrays["mass"], arrays["friction"])


def _compiled(arena: Arena, option: str, floor: str, robots: list[tuple[str, str]]) -> mujoco.MjModel:
    """Build one world of its arena, MuJoCo's options, the floor if any, and the robots' bodies and servos."""
    half, towards = arena.side_m / 2, float(np.sqrt(0.5))
    # The z axis of a plane points out of the wall; each quaternion turns (0, 0, 1) to (x, y, 0).
    walls = [
        f'<geom type="plane" size="{half} {half} .01" pos="{-x * half} {-y * half} 0" '
        f'quat="{towards} {-y * towards} {x * towards} 0"/>'
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    shape = f'<geom type="cylinder" size="{arena.pillar_radius_m} {BODY_RADIUS_M}"/>'
    pillars = [f'<body name="pillar{k}" mocap="true">{shape}</body>' for k in range(arena.num_pillars)]
    return mujoco.MjModel.from_xml_string(f"""<mujoco>
        <option timestep="{TIMESTEP_S}" solver="Newton" {option}/>
        <default><geom condim="1"/></default>
        <worldbody>{"".join([*walls, floor, *(body for body, _ in robots), *pillars])}</worldbody>
        <actuator>{"".join(servos for _, servos in robots)}</actuator>
    </mujoco>""")


SERVO_TIME_S = 0.015  # time constant of the wheel servos in the plane; below the time step they would overshoot


class MujocoPlanar(MujocoWorlds):
    """MuJoCo in the plane: the joints are the pose.

    A robot is a frictionless disc (in MuJoCo a sphere at height 0) on two slides and a hinge. Its wheels are velocity
    servos along the chord of the arc that they would drive; their force is limited by the friction of the wheels on the
    floor. With the Newton solver a quarter turn of a world is exact to the last bits through contacts.
    """

    def _model(self, arena: Arena) -> mujoco.MjModel:
        spin = MASS_KG * BODY_RADIUS_M**2 / 2
        force = FRICTION * MASS_KG * GRAVITY_M_S2
        joints = (
            ("x", "slide", "1 0 0", MASS_KG, force),
            ("y", "slide", "0 1 0", MASS_KG, force),
            ("heading", "hinge", "0 0 1", spin, force * AXLE_M / 2),
        )

        def robot(i: int) -> tuple[str, str]:
            """Return a disc on two slides and a hinge, and a velocity servo on each."""
            moves = "".join(f'<joint name="{name}{i}" type="{kind}" axis="{a}"/>' for name, kind, a, _, _ in joints)
            body = f"""<body name="robot{i}">
                <inertial pos="0 0 0" mass="{MASS_KG}" diaginertia="{spin} {spin} {spin}"/>
                <geom type="sphere" size="{BODY_RADIUS_M}"/>{moves}</body>"""
            servo = '<velocity name="{0}" joint="{0}" kv="{1}" forcerange="{2} {3}"/>'
            servos = [servo.format(f"{name}{i}", m / SERVO_TIME_S, -most, most) for name, _, _, m, most in joints]
            return body, "".join(servos)

        option = 'gravity="0 0 0" integrator="implicitfast" cone="pyramidal"'
        return _compiled(arena, option, "", [robot(i) for i in range(arena.num_robots)])

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
        self._control[:] = chord(wheels, self._qpos[..., 2], self.control_period_s)
        self._batch.step(nstep=self._substeps)


CENTRE_HEIGHT_M = 0.020  # of the mass, ours: at the axle, where the battery and the motors are
CASTER_RADIUS_M = 0.005
CASTER_DISTANCE_M = 0.028  # of each caster from the axle, ahead and behind; ours: just inside the body
MOTOR_INERTIA = MASS_KG / 2 * WHEEL_RADIUS_M**2
"""kg m^2 of each rotor behind its gear, ours: as much as a wheel feels of the robot. Servo and contacts are solved
one after the other, and a light wheel on a firm servo would be torn from the floor at every time step."""
MOTOR_TORQUE_N_M = 0.007
"""Of each motor at its wheel, ours: a little less than the floor holds, wheels and casters sharing the weight. So a
robot that pushes something stalls. Wheels that spin would shake it, and its path would be chaotic."""
_SETTLING_STEPS = 300
_FLOOR = 2  # collision bit of the floor, which holds wheels and casters only; all else meets at MuJoCo's own bit 1


class MujocoSpatial(MujocoWorlds):
    """MuJoCo with gravity: a free joint and two wheel hinges a robot. More mass comes without stronger motors.

    An e-puck stands on two driven wheels and two casters. Wheels are spheres: cylinders on an edge spin the robot 9 to
    24 % too slowly. Contacts with the floor have elliptic friction cones, which look the same from every direction.
    Between robots, walls and pillars a robot is a sphere at half its height: a capsule would touch another at its upper
    or its lower end by the last bit of their tilt, a sphere touches where the middle of a cylinder does.
    """

    def _model(self, arena: Arena) -> mujoco.MjModel:
        """Build one world, with the robots sunk in as deep as they settle.

        A robot that just touches the floor would bounce, or not, by the last bit of its height. And wheels press into
        the floor, so that they roll on a circle smaller by half that depth: they are built larger by as much.
        """
        lone = _spatial(Arena(arena.side_m, 1, 0, arena.pillar_radius_m), depth=0.0)
        data = mujoco.MjData(lone)
        mujoco.mj_step(lone, data, _SETTLING_STEPS)
        model = _spatial(arena, depth=-float(data.qpos[2]))
        self._depth, self._wheels = -model.qpos0[2], np.flatnonzero(model.geom_condim == 3)
        return model

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


def _spatial(arena: Arena, depth: float) -> mujoco.MjModel:
    """Build one world with the robots `depth` in the floor."""
    half, mass = arena.side_m / 2, MASS_KG - 2 * WHEEL_MASS_KG
    tilting = mass * (3 * BODY_RADIUS_M**2 + BODY_HEIGHT_M**2) / 12
    ball, rim = 0.4 * WHEEL_MASS_KG * WHEEL_RADIUS_M**2, WHEEL_RADIUS_M + depth / 2
    # The firmest that does not overshoot: off the floor it would reach its speed in one time step.
    firmness = (MOTOR_INERTIA + ball) / TIMESTEP_S
    holds = f'contype="0" conaffinity="{_FLOOR}"'
    caster = f'<geom type="sphere" size="{CASTER_RADIUS_M}" pos="{{}} 0 {CASTER_RADIUS_M}" {holds}/>'
    # By its priority a wheel's own friction counts, not the larger one of wheel and floor.
    wheel = f"""<body name="{{0}}" pos="0 {{1}} {rim}">
        <inertial pos="0 0 0" mass="{WHEEL_MASS_KG}" diaginertia="{ball} {ball} {ball}"/>
        <joint name="{{0}}" type="hinge" axis="0 1 0" armature="{MOTOR_INERTIA}"/>
        <geom type="sphere" size="{rim}" {holds} condim="3" priority="1" friction="{FRICTION} 0 0"/></body>"""
    servo = (
        f'<velocity name="{{0}}" joint="{{0}}" kv="{firmness}" forcerange="{-MOTOR_TORQUE_N_M} {MOTOR_TORQUE_N_M}"/>'
    )

    def robot(i: int) -> tuple[str, str]:
        """Return a body on two casters and two wheels with servos; its origin is between the wheels on the ground."""
        casters = "".join(caster.format(ahead) for ahead in (CASTER_DISTANCE_M, -CASTER_DISTANCE_M))
        wheels = "".join(wheel.format(f"{side}{i}", y) for side, y in (("left", AXLE_M / 2), ("right", -AXLE_M / 2)))
        inertia = f"{tilting} {tilting} {mass * BODY_RADIUS_M**2 / 2}"
        body = f"""<body name="robot{i}" pos="0 0 {-depth}"><freejoint name="robot{i}"/>
            <inertial pos="0 0 {CENTRE_HEIGHT_M}" mass="{mass}" diaginertia="{inertia}"/>
            <geom type="sphere" size="{BODY_RADIUS_M}" pos="0 0 {BODY_HEIGHT_M / 2}"/>{casters}{wheels}</body>"""
        return body, servo.format(f"left{i}") + servo.format(f"right{i}")

    option = f'gravity="0 0 {-GRAVITY_M_S2}" integrator="Euler" cone="elliptic"'
    floor = f'<geom type="plane" size="{half} {half} .01" contype="{_FLOOR}" conaffinity="0"/>'
    return _compiled(arena, option, floor, [robot(i) for i in range(arena.num_robots)])
