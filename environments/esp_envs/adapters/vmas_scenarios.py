"""VMAS scenarios with a layout: which number is what, and under what the scenario is symmetric.

Name one as `--task esp_envs.adapters.vmas_scenarios:Transport`. Those with settings of their own are classes, the
others lines of a table. Left out is road_traffic, whose agents steer. What lies around in sampling is no part of the
state: it is drawn anew in each episode, and lies in wait where a check puts the agents.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from pydantic import Field as Setting
from torch import Tensor

from esp_envs.adapters.vmas import VmasSettings, VmasTask
from esp_envs.settings import TaskSettings
from esp_envs.spec import Field, Items, Kind, Layout, layout

_OWN = (Field("position", Kind.VECTOR, unit="length", is_point=True), Field("velocity", Kind.VECTOR, unit="length/s"))


def _with_direction(place: int) -> Any:
    """Return a `reading` that gives a line's angle, shown modulo pi, as cosine and sine of its double."""

    def reading(_: VmasTask, obs: Tensor) -> Tensor:
        double = 2 * obs[..., place : place + 1]
        return torch.cat([obs[..., :place], double.cos(), double.sin(), obs[..., place + 1 :]], -1)

    return reading


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

    @property
    def symmetry(self) -> str:  # type: ignore[override]  # which follows from the settings
        return f"d{self.settings.rays}*agents" if self.settings.rays else "o2*agents"

    def seen(self) -> Layout:
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

    reading = _with_direction(15)


class DispersionSettings(VmasSettings):
    """What a user may change of `Dispersion`."""

    n_food: int | None = Setting(None, ge=1, le=32, description="pieces of food; by default one for each agent")
    share_reward: bool = Setting(False, description="whether the team shares what one agent eats")

    @property
    def food(self) -> int:
        """Pieces of food, with the default filled in."""
        return self.n_food or self.num_agents


class Dispersion(VmasTask):
    """VMAS dispersion: agents that start together in a square world disperse to pieces of food.

    Its hand-written policies fly to the "nearest" piece that is left, all together, or "apart": each to its own first.
    """

    heuristics = ("apart", "nearest")

    Settings: ClassVar[type[TaskSettings]] = DispersionSettings
    settings: DispersionSettings
    scenario, symmetry, flags = "dispersion", "d4*agents", ("eaten",)
    convention = "vmas dispersion: 1 for each piece of food, shared by those who eat it"
    terminates = True

    def arguments(self) -> dict[str, object]:
        return super().arguments() | {"n_food": self.settings.food}

    def seen(self) -> Layout:
        piece = (Field("offset", Kind.VECTOR, unit="length"), Field("eaten", Kind.SCALAR, unit="0 or 1"))
        return layout(*_OWN, Field("food", Kind.RECORD, self.settings.food, parts=piece, family="food"))

    def heuristic(self, name: str | None = None) -> Tensor:
        apart = self.named_heuristic(name) == "apart"
        return torch.stack([self._flight(sim, apart) for sim in self._sims])

    def _flight(self, sim: Any, apart: bool) -> Tensor:
        places, food = (torch.stack([x.state.pos for x in xs], 1) for xs in (sim.agents, sim.world.landmarks))
        eaten = torch.stack([piece.eaten for piece in sim.world.landmarks], 1).unsqueeze(1)
        offset = food.unsqueeze(1) - places.unsqueeze(2)
        distance = offset.norm(dim=-1)
        if apart:
            agents = torch.arange(distance.shape[1])
            distance[:, agents, agents % distance.shape[2]] = -1.0
        goal = distance.masked_fill(eaten, torch.inf).argmin(-1)
        return torch.nn.functional.normalize(offset.take_along_dim(goal[..., None, None], 2).squeeze(2), dim=-1)


def _vector(name: str) -> Field:
    return Field(name, Kind.VECTOR, unit="length")


def _scenario(name: str, *seen: str | Field, agents: int, fixed: bool = False, **attributes: object) -> type[VmasTask]:
    """Return the task of a scenario without symmetry; where it is `fixed`, it takes no other number of agents.

    An agent sees its position, its velocity and then what is `seen`; a name alone is that of a vector.
    """
    least, most = (agents, agents) if fixed else (1, 64)
    number = Setting(agents, ge=least, le=most, description="N, agents of the team")
    settings = type("Settings", (VmasSettings,), {"__annotations__": {"num_agents": int}, "num_agents": number})
    whole = layout(*_OWN, *(_vector(one) if isinstance(one, str) else one for one in seen))
    members: dict[str, object] = {"Settings": settings, "scenario": name, "symmetry": "c1", "terminates": True}
    members |= {"convention": f"vmas {name}", "seen": lambda _: whole, "__module__": __name__}
    if fixed:
        members["arguments"] = lambda _: {}
    return type(name.title().replace("_", ""), (VmasTask,), members | attributes)


def _samples_around(_: VmasTask, obs: Tensor) -> Tensor:
    """Give the cells around an agent counter-clockwise from the right."""
    return torch.cat([obs[..., :16], obs[..., 16:][..., [0, 7, 2, 6, 1, 4, 3, 5]]], -1)


def _player(rival: str) -> Layout:
    """Return what a player of football sees, the other players as vectors from them."""
    body = tuple(Field(name, Kind.VECTOR) for name in ("offset", "relative_velocity", "velocity", "force"))
    ball = ("force", "from_ball", "ball_relative_velocity", "ball_from_goal", "ball_velocity", "ball_force")
    return layout(
        *map(_vector, (*ball, "from_goal", "velocity")),
        Field("rivals", Kind.RECORD, 3, parts=body, family=rival),
        Field("fellows", Kind.RECORD, 2, parts=body, items=Items.OTHERS),
    )


def _lidar(rays: int, name: str = "lidar") -> Field:
    return Field(name, Kind.RING, rays=rays)


_FINE = "angles to the last digit"  # which stiff joints feel
_CONTROLLERS = "what controllers remember"

BallPassage = _scenario("ball_passage", "from_goal", "from_ball", "from_passage", agents=2, fixed=True)
BallTrajectory = _scenario("ball_trajectory", "from_ball", "again", agents=2, fixed=True, hidden=(_FINE,))
BuzzWire = _scenario("buzz_wire", "from_goal", agents=2, fixed=True, hidden=(_FINE,))
Discovery = _scenario("discovery", _lidar(15), agents=5)
Dropout = _scenario("dropout", "goal", Field("done", Kind.SCALAR), agents=4, flags=("eaten",))
Football = _scenario(
    "football",
    agents=6,
    fixed=True,
    arguments=lambda _: {"ai_red_agents": False},
    seen=lambda _: {"agent_blue": _player("agent_red"), "agent_red": _player("agent_blue")},
    hidden=("forces of the last step",),  # which players see
)
Flocking = _scenario("flocking", "from_target", _lidar(12), agents=4, hidden=("the clock",))
GiveWay = _scenario("give_way", agents=2, fixed=True, own_goals="goal", hidden=(_CONTROLLERS,))
JointPassage = _scenario(
    "joint_passage",
    *("from_goal", "from_passage", "goal_direction"),
    agents=2,
    fixed=True,
    angles=("joint_goal",),
    hidden=(_FINE,),
)
JointPassageSize = _scenario(
    "joint_passage_size",
    *("from_goal", "from_big", "from_small", "goal_direction"),
    agents=2,
    fixed=True,
    hidden=("which passage is big", _FINE),
)
MultiGiveWay = _scenario(
    "multi_give_way",
    *("from_goal", Field("distance", Kind.SCALAR)),
    agents=4,
    fixed=True,
    own_goals="goal",
    hidden=(_CONTROLLERS,),
)
Passage = _scenario("passage", "goal", "passage", agents=5, fixed=True, own_goals="goal")
ReverseTransport = _scenario("reverse_transport", "package_velocity", "package", "package_from_goal", agents=4)
Sampling = _scenario("sampling", _lidar(12), _lidar(8, "samples"), agents=3, reading=_samples_around)
Wheel = _scenario(
    "wheel",
    *("from_line", "end", "other_end"),
    *(Field("level", Kind.SCALAR), Field("slope", Kind.PSEUDOSCALAR), Field("spin", Kind.SCALAR, 2)),
    agents=4,
    reading=_with_direction(10),
)
WindFlocking = _scenario("wind_flocking", agents=2, fixed=True, hidden=(_CONTROLLERS,))
