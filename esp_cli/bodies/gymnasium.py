"""Tasks of Gymnasium's MuJoCo robots and of MaMuJoCo, with layouts that are derived from their models."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr
from importlib import import_module
from io import StringIO
from typing import Any, ClassVar

import mujoco
import numpy as np
import torch
from pydantic import Field as Setting

from esp_cli.bodies.body import Body
from esp_cli.bodies.reading import quiet
from esp_cli.bodies.showing import Layouts, layouts_of
from esp_cli.symmetry.elements import Element
from esp_envs.adapters.gymnasium import SingleAgentSettings, SingleAgentTask
from esp_envs.adapters.pettingzoo import ParallelTask
from esp_envs.epuck.gl import choose_library
from esp_envs.errors import UserError
from esp_envs.installed import install
from esp_envs.settings import TaskSettings


class MujocoSettings(SingleAgentSettings):
    """Settings of these tasks."""

    horizon: int = Setting(1000, ge=1, le=100_000, description="steps of an episode")


class _OfModel(ParallelTask):
    """What both kinds share: layouts and symmetry follow from the model."""

    Settings = MujocoSettings
    metrics = ("x_velocity",)
    scenario: ClassVar[str]
    """What Gymnasium or MaMuJoCo call it."""
    arguments: ClassVar[Mapping[str, Any]] = {}
    """Further arguments of theirs."""
    keeps: ClassVar[tuple[str, ...]] = ("flip-x",)
    """Elements that the reward leaves alone; those of them that the model has exactly are the task's symmetry."""
    _known: ClassVar[dict[tuple[type, str], tuple[Layouts, float]]] = {}  # and the time of a step, s

    def __init__(self, settings: TaskSettings, num_envs: int, generators: Sequence[torch.Generator]) -> None:
        self.settings = settings  # type: ignore[assignment] # of this task
        key = (type(self), settings.model_dump_json())
        if key not in self._known:
            with quiet():
                env = self.make_one()
                self._known[key] = self._layouts(env), float(env.unwrapped.dt)
            env.close()
        known, self.control_period_s = self._known[key]
        self.observation, self.action, self.simulated = known.observation, known.action, known.simulated
        held = {g: Element((g,), order).name for g, order in known.orders.items() if g.name in self.keeps}
        self.symmetry = ",".join(name for g, name in held.items() if g in known.exact) or "c1"
        self.nearly = "" if held.keys() <= known.exact else ",".join(held.values())
        super().__init__(settings, num_envs, generators)

    def _layouts(self, env: Any) -> Layouts:
        """Return the layouts of a copy, which may be overwritten."""
        raise NotImplementedError


class MujocoTask(_OfModel, SingleAgentTask):
    """A MuJoCo environment of Gymnasium as a task.

    Example:
        class Hopper(MujocoTask):
            scenario, convention, terminates = "Hopper-v5", "gymnasium Hopper-v5", True
    """

    def make_single(self) -> Any:
        steps = {"max_episode_steps": self.settings.horizon, "disable_env_checker": True}
        env = _module("gymnasium").make(self.scenario, render_mode="rgb_array", **steps, **self.arguments)
        env.unwrapped.render = painter_of(env.unwrapped)
        return env

    def _layouts(self, env: Any) -> Layouts:
        bare = env.unwrapped
        return layouts_of(Body.from_mjcf(bare.model), bare.data, lambda: [bare._get_obs()])


class MujocoTeam(_OfModel):
    """A robot of MaMuJoCo, whose agents control some of its joints each, as a task.

    Example:
        class Ant2x4(MujocoTeam):
            scenario, parts, convention, terminates = "Ant", "2x4", "mamujoco Ant 2x4", True
    """

    shared_reward = True
    parts: ClassVar[str]
    """How agents share its joints, as "4x2"."""

    def make_one(self) -> Any:
        make = _module("gymnasium_robotics").mamujoco_v1.parallel_env
        env = make(self.scenario, self.parts, max_episode_steps=self.settings.horizon, **self.arguments)
        robot = env.single_agent_env.unwrapped
        for name in ("data", "model", "set_state", "dt"):  # where checks and pictures look for them
            setattr(env, name, getattr(robot, name))
        env.render_mode, env.render = "rgb_array", painter_of(robot)
        return env

    def _layouts(self, env: Any) -> Layouts:
        agents = env.possible_agents
        ends = np.cumsum([env.action_spaces[agent].shape[0] for agent in agents])
        acts = np.split(np.arange(float(env.model.nu)), ends[:-1])
        whole = env.map_local_actions_to_global_action(dict(zip(agents, acts, strict=True)))
        acting = [own.tolist() for own in np.split(np.argsort(whole), ends[:-1])]
        return layouts_of(Body.from_mjcf(env.model), env.data, lambda: list(env._get_obs().values()), acting)


class Ant(MujocoTask):
    """Gymnasium's Ant-v5: four legs, eight joints, and a reward for walking along x."""

    scenario, convention, terminates = "Ant-v5", "gymnasium Ant-v5", True


class HalfCheetah(MujocoTask):
    """Gymnasium's HalfCheetah-v5 in a plane through its two legs. Its model has no mirror, so nothing holds."""

    scenario, convention = "HalfCheetah-v5", "gymnasium HalfCheetah-v5"


class Walker2d(MujocoTask):
    """Gymnasium's Walker2d-v5 in a plane; its mirror exchanges the legs."""

    scenario, convention, terminates = "Walker2d-v5", "gymnasium Walker2d-v5", True


class Humanoid(MujocoTask):
    """Gymnasium's Humanoid-v5; its model is its own mirror image but for a hip's armature and a knee's spring."""

    scenario, convention, terminates = "Humanoid-v5", "gymnasium Humanoid-v5", True


class Swimmer(MujocoTask):
    """Gymnasium's Swimmer-v5: three links in the plane, whose mirror bends its joints the other way."""

    scenario, convention = "Swimmer-v5", "gymnasium Swimmer-v5"


class Ant4x2(MujocoTeam):
    """MaMuJoCo's Ant with an agent for each leg; a mirror exchanges agents."""

    scenario, parts, convention, terminates = "Ant", "4x2", "mamujoco_v1 Ant 4x2", True


class HalfCheetah2x3(MujocoTeam):
    """MaMuJoCo's HalfCheetah with an agent for each leg. Its model has no mirror, so nothing holds."""

    scenario, parts, convention = "HalfCheetah", "2x3", "mamujoco_v1 HalfCheetah 2x3"


def painter_of(robot: Any) -> Callable[[], Any]:
    """Return what draws a robot; Gymnasium's own way needs the variable MUJOCO_GL where there is no display."""
    opened: list[Any] = []

    def render() -> Any:
        if not opened:
            choose_library()
            opened.append(mujoco.Renderer(robot.model, 480, 480))
        opened[0].update_scene(robot.data, camera=0 if robot.model.ncam else -1)
        return opened[0].render()

    return render


def _module(package: str) -> Any:
    try:
        with redirect_stderr(StringIO()):  # of notices about tasks that are not used here
            return import_module(package)
    except ImportError as error:
        missing = f"this task needs a package that is missing ({error.name})"
        raise UserError(f"{missing}: {install('gymnasium')}") from error
