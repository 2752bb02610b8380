"""A legged robot that follows commands: a quadruped in plain MuJoCo, with layouts that are derived from its model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from pydantic import Field as Setting
from torch import Tensor

from esp_cli.bodies.body import Body
from esp_cli.bodies.gymnasium import painter_of
from esp_envs.batched import BatchedTask, Outcome, World
from esp_envs.scene import Scene
from esp_envs.settings import TaskSettings
from esp_envs.spec import Continuous, Field, Kind, TaskSpec, layout

TIMESTEP_S, SUBSTEPS = 0.005, 4
SWING_RAD = 0.4  # how far an action of 1 moves the target of a joint from where it stands
HEIGHT_M = 0.302  # of the trunk, where the robot stands
HIP_AHEAD_M, HIP_ASIDE_M, THIGH_ASIDE_M = 0.2, 0.09, 0.15  # where hips and thighs hang, from the middle of the trunk
LEGS = ("left_front", "right_front", "left_hind", "right_hind")
AHEAD, LEFT = (1, 1, -1, -1), (1, -1, 1, -1)  # where each leg stands
STEPS_OF_A_STRIDE = 16
CLOCK = Field("clock", Kind.PSEUDOSCALAR, 2)
"""Cosine and sine of the stride's phase. Opposite corners step together, so a mirror shifts it by half a stride, which
changes both signs, and a half turn does not."""


class QuadrupedSettings(TaskSettings):
    """Settings of the quadruped."""

    horizon: int = Setting(400, ge=1, le=100_000, description="steps of an episode, 0.02 s each")
    speed: float = Setting(1.0, ge=0, le=3, description="largest commanded speed ahead and back, m/s; half aside")
    turning: float = Setting(1.0, ge=0, le=3, description="largest commanded turning rate, rad/s")


class Quadruped(BatchedTask):
    """A quadruped of 9 kg with twelve joints that walks as it is told: how fast, whereto and how fast it turns.

    Its knees bend towards its middle, so that its model is its own image under left-right, front-back and their
    product. Commands are drawn for each episode, alike for both sides and both ways, so all three are symmetries of
    the task. Targets of joints are set 50 times a second. A clock of 0.32 s tells which legs may step; nothing but
    `trot`, a hand-written walk without feedback, has to follow it.

    The reward of a step is 1.5 - e - f / 2, less the costs of bouncing and rolling, torques and changes of targets: e
    is the error of the velocity (m/s), f that of the turning rate (rad/s). An episode ends early where the robot falls.
    """

    Settings = QuadrupedSettings
    settings: QuadrupedSettings
    heuristics = ("trot", "stand")
    makes_new_tensors = True

    def __init__(self, settings: TaskSettings, num_envs: int, generators: Sequence[torch.Generator]) -> None:
        super().__init__(settings, num_envs, generators)
        self.model = _body()[1]
        self.data = mujoco.MjData(self.model)  # of the world that is drawn
        self._paint = painter_of(self)
        self._batch = Batch(self.model, nsim=num_envs * len(generators), nthread=torch.get_num_threads())
        names = ("qpos", "qvel", "qacc_warmstart", "ctrl", "actuator_force")
        self._rows = {name: self._batch.bind(name) for name in names}  # outputs are filled from the next step on

    def _describe(self) -> TaskSpec:
        body = _body()[0]
        before = body.controls(name="before")
        seen = (body.velocity(), body.spin(), body.gravity(), body.command(), body.positions(), body.velocities())
        return TaskSpec(
            name="quadruped",
            version=1,
            convention="velocity",
            horizon=self.settings.horizon,
            num_agents=1,
            observation=layout(*seen, before, CLOCK),
            action=Continuous(layout(body.controls())),
            state=layout(*body.state().fields, before, body.command(), CLOCK),
            symmetry=body.group,
            terminates=True,
            control_period_s=TIMESTEP_S * SUBSTEPS,
        )

    def _start(self, generator: torch.Generator) -> World:
        drawn = self.draw(19, generator=generator)
        phase, still = math.pi * drawn[:, 18:], torch.zeros(self.num_envs, 27, device=self.device)
        most = torch.tensor([self.settings.speed, self.settings.speed / 2, self.settings.turning], device=self.device)
        upright = torch.tensor([0, 0, HEIGHT_M, 1, 0, 0, 0], device=self.device).expand(self.num_envs, 7)
        # as the state has them: place and attitude, positions, velocity, all that is still, command and clock
        angles, velocity = 0.1 * drawn[:, :12], 0.2 * drawn[:, 12:15]
        parts = [upright, angles, velocity, still, most * drawn[:, 15:18], phase.cos(), phase.sin()]
        return self._split(torch.cat(parts, -1))

    def _advance(self, world: World, action: Tensor) -> Outcome:
        action = action.flatten(2)
        change = action - world["before"].flatten(2)
        qpos, qvel, rest = self._parts(self._state())
        sent = {"qpos": qpos, "qvel": qvel, "ctrl": SWING_RAD * action}
        for name, rows in sent.items():
            self._rows[name][:] = rows.flatten(0, 1).cpu().numpy()
        self._rows["qacc_warmstart"][:] = 0  # so that the state alone decides what follows
        self._batch.step(nstep=SUBSTEPS)
        world |= self._split(torch.cat([self._numbers("qpos"), self._numbers("qvel"), rest], -1))
        torque = self._numbers("actuator_force")
        velocity, spin, _, command = self._felt(world)
        error = (velocity[..., :2] - command[..., :2]).norm(dim=-1)
        turning = spin[..., 2] - command[..., 2]
        shaken = 0.2 * velocity[..., 2] ** 2 + 0.01 * (spin[..., :2] ** 2).sum(-1)
        cost = shaken + 1e-4 * (torque**2).sum(-1) + 2e-3 * (change**2).sum(-1)
        reward = 1.5 - error - turning.abs() / 2 - cost
        world["before"], angle = action.unsqueeze(-2), 2 * math.pi / STEPS_OF_A_STRIDE
        cos, sin = world["clock"].unbind(-2)
        turned = cos * math.cos(angle) - sin * math.sin(angle), sin * math.cos(angle) + cos * math.sin(angle)
        world["clock"] = torch.stack(turned, -2)
        effort = (torque**2).unflatten(-1, (4, 3)).sum(-1)
        left, front = effort[..., 0::2].sum(-1), effort[..., :2].sum(-1)
        whole = effort.sum(-1) + 1e-6
        return reward, {
            "speed_error": error,
            "turning_error": turning.abs(),
            "left_effort": left / whole,
            "front_effort": front / whole,
        }

    def _observe(self, world: World) -> Tensor:
        angles, rates = world["positions"].flatten(2), 0.1 * world["velocities"].flatten(2)
        further = world["before"].flatten(2), world["clock"].flatten(2)
        self._now = self._felt(world)
        return torch.cat([*self._now, angles, rates, *further], -1).unsqueeze(-2)

    def _ended(self, world: World) -> Tensor:
        low = world["place"][..., 0, 2] < HEIGHT_M / 2
        return low | (self._now[2][..., 2] > -0.5)  # or tilted by more than 60 degrees

    def heuristic(self, name: str | None = None) -> Tensor:
        if self.named_heuristic(name) == "stand":
            return torch.zeros(self.action_shape, device=self.device)
        ahead, left = (torch.tensor(x, device=self.device, dtype=torch.float32) for x in (AHEAD, LEFT))
        vx, vy, turning = self.world["command"][..., 0, :].unsqueeze(-2).unbind(-1)  # [S, E, 1] each
        cos, sin = ((ahead * left) * part for part in self.world["clock"].unbind(-2))  # [S, E, legs]
        # rad for each m/s of a foot, a fifth more than without slip
        reach = 1.2 * STEPS_OF_A_STRIDE * SUBSTEPS * TIMESTEP_S / 4 / HEIGHT_M * cos
        lift = 0.25 * (-sin).clamp_min(0)
        hip = (vy + turning * HIP_AHEAD_M * ahead) * reach
        thigh = ahead * lift - (vx - turning * THIGH_ASIDE_M * left) * reach
        target = torch.stack([hip, thigh, -2 * ahead * lift], -1) / SWING_RAD
        return target.flatten(-2).clamp(-1, 1).unsqueeze(-2)

    def scene(self, world: tuple[int, int] = (0, 0)) -> Scene:
        self.data.qpos[:] = self._parts(self._state()[world])[0].cpu().numpy()
        mujoco.mj_forward(self.model, self.data)
        picture = self._paint()
        return Scene((), (0.0, picture.shape[1], 0.0, picture.shape[0]), picture=picture)

    def _felt(self, world: World) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return velocity, spin and gravity as the body sees them, and the command: [S, E, 3] each."""
        w, axis = world["attitude"][..., 0, :1], world["attitude"][..., 0, 1:]
        velocity, down = world["velocity"][..., 0, :], torch.tensor([0.0, 0, -1], device=self.device)

        def inwards(v: Tensor) -> Tensor:
            """Return a vector of the world as the body sees it."""
            across = 2 * torch.cross(v.expand_as(axis), axis, dim=-1)
            return v + w * across + torch.cross(across, axis, dim=-1)

        return inwards(velocity), world["spin"][..., 0, :], inwards(down), world["command"][..., 0, :]

    def _parts(self, state: Tensor) -> tuple[Tensor, ...]:
        """Return what states [..., width] begin with, MuJoCo's qpos and qvel, and the rest."""
        return state.tensor_split((self.model.nq, self.model.nq + self.model.nv), -1)

    def _numbers(self, name: str) -> Tensor:
        rows = torch.from_numpy(self._rows[name].astype(np.float32)).to(self.device)
        return rows.unflatten(0, (self.num_seeds, self.num_envs))


@cache
def _body() -> tuple[Body, mujoco.MjModel]:
    """Return the robot and its model, in which all joints are 0 where it stands."""
    model = mujoco.MjModel.from_xml_string(quadruped())
    return Body.from_mjcf(model), model


def quadruped() -> str:
    """Return the robot's model, MJCF: a trunk on four legs of hip, thigh and shin, knees towards its middle."""
    legs = "".join(map(_leg, LEGS, AHEAD, LEFT))
    servo = '<position name="{0}" joint="{0}" kp="40" kv="1" forcerange="-30 30"/>'
    servos = "".join(servo.format(f"{leg}_{part}") for leg in LEGS for part in ("hip", "thigh", "shin"))
    return f"""<mujoco model="quadruped">
        <compiler autolimits="true"/>
        <option timestep="{TIMESTEP_S}" integrator="implicitfast" cone="elliptic"/>
        <default>
            <joint armature="0.01" damping="0.1"/>
            <geom condim="3" friction="0.8" contype="0" rgba=".3 .35 .4 1"/>
        </default>
        <visual><headlight ambient=".5 .5 .5"/></visual>
        <asset>
            <texture type="skybox" builtin="flat" rgb1="1 1 1" width="8" height="8"/>
            <texture name="squares" type="2d" builtin="checker" rgb1=".9 .9 .9" rgb2=".75 .8 .85" width="64"
                height="64"/>
            <material name="squares" texture="squares" texrepeat="2 2" texuniform="true"/>
        </asset>
        <worldbody>
            <light directional="true" dir="-.3 .2 -1"/>
            <geom type="plane" size="0 0 1" contype="1" conaffinity="0" material="squares"/>
            <body name="trunk" pos="0 0 {HEIGHT_M}">
                <camera mode="trackcom" pos="0 -1.6 .7" xyaxes="1 0 0 0 .35 1"/>
                <freejoint/>
                <geom type="box" size=".22 .09 .05" mass="5" rgba=".2 .5 .8 1"/>
                {legs}
            </body>
        </worldbody>
        <actuator>{servos}</actuator>
    </mujoco>"""


def _leg(name: str, ahead: int, left: int) -> str:
    """Return the body of one leg, which stands with thigh and shin at 45 degrees."""
    x, y, further = ahead * HIP_AHEAD_M, left * HIP_ASIDE_M, left * (THIGH_ASIDE_M - HIP_ASIDE_M)
    return f"""<body name="{name}_hip" pos="{x} {y} 0">
        <joint name="{name}_hip" axis="1 0 0" range="-45 45"/>
        <geom type="sphere" size=".04" mass=".4"/>
        <body name="{name}_thigh" pos="0 {further} 0">
            <joint name="{name}_thigh" axis="0 1 0" range="-60 60"/>
            <geom type="capsule" size=".02" fromto="0 0 0 {-ahead * 0.14} 0 -.14" mass=".5"/>
            <body name="{name}_shin" pos="{-ahead * 0.14} 0 -.14">
                <joint name="{name}_shin" axis="0 1 0" range="-60 60"/>
                <geom type="capsule" size=".012" fromto="0 0 0 {ahead * 0.14} 0 -.14" mass=".1"/>
                <geom name="{name}_foot" type="sphere" size=".022" pos="{ahead * 0.14} 0 -.14" mass=".05"/>
            </body>
        </body>
    </body>"""
