"""VMAS scenarios with a layout: which number is what, and under what the scenario is symmetric.

Name one as `--task esp_envs.adapters.vmas_scenarios:Transport`. Sampling is left out: its rays begin at 0.05 rad, which
no mirror leaves alone, and which cells are sampled stands in no state.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from pydantic import Field as Setting
from torch import Tensor

from esp_envs.adapters.vmas import VmasSettings, VmasTask
from esp_envs.settings import TaskSettings
from esp_envs.spec import Field, Kind, Layout, layout

_OWN = (Field("position", Kind.VECTOR, unit="length", is_point=True), Field("velocity", Kind.VECTOR, unit="length/s"))


class NavigationSettings(VmasSettings):
    """What a user may change of `Navigation`."""

    collisions: bool = Setting(True, description="whether agents collide, and see each other by a lidar")
    shared_rew: bool = Setting(True, description="whether progress is shared by the team")
    n_lidar_rays: int = Setting(12, ge=4, le=360, description="rays around each agent")

    @property
    def rays(self) -> int:
        """Rays that an agent has."""
        return self.n_lidar_rays if self.collisions else 0


class Navigation(VmasTask):
    """VMAS navigation: every agent drives to a goal of its own on the unbounded plane, and touches no other agent."""

    Settings: ClassVar[type[TaskSettings]] = NavigationSettings
    settings: NavigationSettings
    scenario, own_goals, metrics = "navigation", "goal", ("agent_collisions",)
    convention = "vmas navigation: progress, 0.01 when all have arrived, -1 a collision"
    terminates = True

    def __init__(self, *arguments: object) -> None:
        settings = arguments[0]
        assert isinstance(settings, NavigationSettings)
        self.symmetry = f"d{settings.rays}*agents" if settings.rays else "o2*agents"
        super().__init__(*arguments)  # type: ignore[arg-type]

    def seen(self) -> Layout:
        """Return the layout of one agent's observation."""
        rays = self.settings.rays
        lidar = (Field("lidar", Kind.RING, unit="length", rays=rays),) if rays else ()
        return layout(*_OWN, Field("from_goal", Kind.VECTOR, unit="length"), *lidar)


class TransportSettings(VmasSettings):
    """What a user may change of `Transport`."""

    n_packages: int = Setting(1, ge=1, le=8, description="packages to push")
    package_mass: float = Setting(50.0, gt=0, description="mass of a package; an agent has 1")


class Transport(VmasTask):
    """VMAS transport: agents push square packages to a goal in a square world."""

    Settings: ClassVar[type[TaskSettings]] = TransportSettings
    settings: TransportSettings
    scenario, symmetry, convention = "transport", "d4*agents", "vmas transport: 100 per length of progress, shared"
    terminates, shared_reward = True, True

    def seen(self) -> Layout:
        """Return the layout of one agent's observation."""
        package = (
            Field("from_goal", Kind.VECTOR, unit="length"),
            Field("offset", Kind.VECTOR, unit="length"),
            Field("speed", Kind.VECTOR, unit="length/s"),
            Field("on_goal", Kind.SCALAR, unit="0 or 1"),
        )
        return layout(*_OWN, Field("packages", Kind.RECORD, self.settings.n_packages, parts=package, family="packages"))


class BalanceSettings(VmasSettings):
    """What a user may change of `Balance`."""

    num_agents: int = Setting(3, ge=2, le=16, description="N, agents below the line")
    package_mass: float = Setting(5.0, gt=0, description="mass of the package")


class Balance(VmasTask):
    """VMAS balance: agents carry a package on a line against gravity; left and right are alike, up and down are not."""

    Settings: ClassVar[type[TaskSettings]] = BalanceSettings
    settings: BalanceSettings
    scenario, symmetry = "balance", "flip-y*agents"
    convention = "vmas balance: 100 per length of progress, -10 on the ground, shared"
    terminates, shared_reward, metrics = True, True, ("ground_rew",)

    def seen(self) -> Layout:
        """Return the layout of one agent's observation."""
        return layout(
            *_OWN,
            Field("from_package", Kind.VECTOR, unit="length"),
            Field("from_line", Kind.VECTOR, unit="length"),
            Field("package_from_goal", Kind.VECTOR, unit="length"),
            Field("package_velocity", Kind.VECTOR, unit="length/s"),
            Field("line_velocity", Kind.VECTOR, unit="length/s"),
            Field("line_spin", Kind.PSEUDOSCALAR, unit="rad/s"),
            Field("line_level", Kind.SCALAR, unit="cos of twice the angle"),
            Field("line_slope", Kind.PSEUDOSCALAR, unit="sin of twice the angle"),
        )

    def reading(self, obs: Tensor) -> Tensor:
        """Give the line's angle, which the scenario shows modulo pi, as cosine and sine of its double."""
        double = 2 * obs[..., -1:]
        return torch.cat([obs[..., :-1], double.cos(), double.sin()], -1)


class DispersionSettings(VmasSettings):
    """What a user may change of `Dispersion`."""

    n_food: int | None = Setting(None, ge=1, le=32, description="pieces of food; by default one for each agent")
    share_reward: bool = Setting(False, description="whether the team shares what one agent eats")

    @property
    def food(self) -> int:
        """Pieces of food, with the default filled in."""
        return self.n_food or self.num_agents


class Dispersion(VmasTask):
    """VMAS dispersion: agents that start together in a square world disperse to pieces of food."""

    Settings: ClassVar[type[TaskSettings]] = DispersionSettings
    settings: DispersionSettings
    scenario, symmetry, flags = "dispersion", "d4*agents", ("eaten",)
    convention = "vmas dispersion: 1 for each piece of food, shared by those who eat it"
    terminates = True

    def arguments(self) -> dict[str, object]:
        """Return the scenario's arguments."""
        return super().arguments() | {"n_food": self.settings.food}

    def seen(self) -> Layout:
        """Return the layout of one agent's observation."""
        piece = (Field("offset", Kind.VECTOR, unit="length"), Field("eaten", Kind.SCALAR, unit="0 or 1"))
        return layout(*_OWN, Field("food", Kind.RECORD, self.settings.food, parts=piece, family="food"))
