"""What a user may change of formation change, and the spec that follows."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field as Setting
from pydantic import model_validator
from torch import Tensor

from esp_envs.epuck.robot import Arena
from esp_envs.settings import Breaks, TaskSettings
from esp_envs.spec import Continuous, Discrete, Field, Items, Kind, TaskSpec, filled_layout, layout

WHEELS = Continuous(layout(Field("wheels", Kind.WHEELS, 1, "share of full speed")))
"""Left and right wheel speed in [-1, 1], times 6.28 rad/s."""
LEVELS = tuple(round(-1 + 0.2 * k, 1) for k in range(11))
WHEEL_PAIRS = Discrete(
    Kind.WHEELS,
    tuple((left, right) for left in LEVELS for right in LEVELS),
    tuple(f"{left:g}/{right:g}" for left in LEVELS for right in LEVELS),
)
"""Each wheel in steps of 0.2: 121 pairs."""
PENALTY = {"paper": 0.35, "tight": 1.0}
"""A step at full speed towards the goal is worth 1.256: in `tight`, pushing through the others hardly pays."""
PENALTY_RADIUS_M = {"paper": 0.5, "tight": 0.15}
SIGHT: dict[str, Literal["offset", "nearness"]] = {"paper": "offset", "tight": "nearness"}


class FormationSettings(TaskSettings):
    """What a user may change of `formation`."""

    convention: Literal["paper", "tight"] = Setting(
        "paper", description="what being near costs: as the paper prints it, or so that giving way pays, for robots"
    )
    actions: Literal["continuous", "discrete"] = Setting(
        "continuous", description="two wheel speeds, or 121 pairs of them in steps of 0.2 (for QMIX)"
    )
    physics: Literal["mujoco", "mujoco-3d", "pymunk"] = Setting(
        "mujoco", description="planar MuJoCo, MuJoCo with wheels and casters, or pymunk"
    )
    num_agents: int = Setting(8, ge=1, le=10_000, description="N, robots")
    num_obstacles: int = Setting(2, ge=0, le=10_000, description="M, pillars on a ring around the middle")
    obstacle_radius_m: float = Setting(0.05, gt=0, le=1, description="of a pillar, m")
    arena_m: float = Setting(2.0, gt=0, le=20, description="length of a wall, m")
    density: float | None = Setting(
        None, gt=0, description="robots per metre of wall, however many there are; by default walls have arena_m"
    )
    horizon: int = Setting(300, ge=1, le=100_000, description="control steps of an episode")
    control_period_s: float = Setting(0.1, gt=0, le=1, description="time of a control step, s; a multiple of 0.01")
    sight: Literal["offset", "nearness"] | None = Setting(
        None,
        description="bodies are seen by their offset in m (by default in the convention paper), or as nearness, a "
        "direction that fades with the gap (in the convention tight)",
    )
    goal_sight_m: float | None = Setting(
        None,
        gt=0,
        description="the goal is seen in this unit and no farther than one of it, m; by default by its offset in m",
    )
    neighbours: int = Setting(1, ge=1, description="nearest robots that an observation shows; paper: 1")
    progress_weight: float = Setting(100.0, ge=0, description="omega_g, reward per metre nearer to the goal")
    collision_penalty: float | None = Setting(
        None, ge=0, description="c_collision, reward lost in a step with a body too near; 0.35 by default, 1 in tight"
    )
    penalty_radius_m: float | None = Setting(
        None, gt=0, description="C, distance of centres, m; 0.5 by default, 0.15 in the convention tight"
    )
    arrival_radius_m: float = Setting(0.05, gt=0, description="r_arrival, distance at which a robot has arrived, m")
    start_noise_m: float = Setting(0.01, ge=0, le=0.01, description="posts are missed by up to this along x and y, m")
    sensor_noise_m: float = Setting(0.0, ge=0, le=1e3, description="standard deviation of each seen coordinate, m")
    heading_noise_rad: float = Setting(0.0, ge=0, le=1e3, description="standard deviation of the seen heading, rad")
    action_delay: int = Setting(0, ge=0, le=20, description="control steps until a chosen action acts")
    wheel_mismatch: float = Setting(
        0.0, ge=0, le=0.5, description="standard deviation of each wheel's own factor on its speed, drawn per episode"
    )
    mass_spread: float = Setting(0.0, ge=0, lt=1, description="masses are drawn from 1 - spread to 1 + spread e-pucks")
    friction_spread: float = Setting(0.0, ge=0, lt=1, description="likewise the grip of the wheels")

    slope: Annotated[float, Breaks("flip-x")] = Setting(
        0.0, ge=0, lt=1, description="breaks symmetry: share of a wheel's speed lost uphill, along x, and won downhill"
    )

    def without_effect(self) -> frozenset[str]:
        alone = self.num_agents == 1 and self.num_obstacles == 0
        idle = {
            "obstacle_radius_m": self.num_obstacles == 0,
            "arena_m": self.density is not None,
            "neighbours": self.num_agents <= 2,  # there is one to see, or none
            "sight": alone,
            "collision_penalty": alone,
            "penalty_radius_m": alone or self.penalty == 0,
        }
        return frozenset(name for name, is_idle in idle.items() if is_idle)

    @property
    def penalty(self) -> float:
        """c_collision with its default filled in."""
        return PENALTY[self.convention] if self.collision_penalty is None else self.collision_penalty

    @property
    def radius(self) -> float:
        """C with its default filled in, m."""
        return self.penalty_radius_m or PENALTY_RADIUS_M[self.convention]

    @property
    def seen_as(self) -> Literal["offset", "nearness"]:
        """How bodies are seen, with its default filled in."""
        return self.sight or SIGHT[self.convention]

    @property
    def goal_unit(self) -> str:
        return "m" if self.goal_sight_m is None else f"{self.goal_sight_m:g} m, at most 1"

    @property
    def seen_robots(self) -> int:
        return min(self.neighbours, self.num_agents - 1)

    @property
    def hidden(self) -> tuple[str, ...]:
        """What decides the next step and is not in the state."""
        parts = {
            "delayed actions": self.action_delay,
            "wheels of unequal size": self.wheel_mismatch,
            "masses": self.mass_spread,
            "grip": self.friction_spread,
            "wheels and tilts": self.physics == "mujoco-3d",
        }
        return tuple(name for name, there in parts.items() if there)

    @property
    def arena(self) -> Arena:
        side = self.arena_m if self.density is None else self.num_agents / self.density / 4
        return Arena(side, self.num_agents, self.num_obstacles, self.obstacle_radius_m)

    @model_validator(mode="after")
    def _fits(self) -> FormationSettings:
        _ = self.arena
        return self


def formation_spec(settings: FormationSettings) -> TaskSpec:
    """Return the spec that follows from the settings."""
    robots, pillars = settings.num_agents, settings.num_obstacles
    unit = "m" if settings.seen_as == "offset" else "nearness"
    penalty = f"{settings.penalty:g} once a step within {settings.radius:g} m"
    return TaskSpec(
        name="formation",
        version=1,
        convention=f"{settings.convention}: {settings.progress_weight:g} per metre, -{penalty}; {settings.physics}"
        + settings.broken_in_words(),
        num_agents=robots,
        horizon=settings.horizon,
        observation=filled_layout(
            Field("heading", Kind.VECTOR, 1, "direction"),
            Field("obstacle", Kind.VECTOR, min(pillars, 1), unit, family="obstacles"),
            Field("goal", Kind.VECTOR, 1, settings.goal_unit),
            # Sorted by distance, so that no permutation of the robots moves them.
            Field("robots", Kind.VECTOR, settings.seen_robots, unit, family="robots"),
        ),
        state=filled_layout(
            Field("heading", Kind.VECTOR, robots, "direction", Items.AGENTS),
            Field("position", Kind.VECTOR, robots, "m", Items.AGENTS, is_point=True),
            Field("velocity", Kind.VECTOR, robots, "m/s", Items.AGENTS),
            Field("spin", Kind.PSEUDOSCALAR, robots, "rad/s", Items.AGENTS),
            Field("goals", Kind.VECTOR, robots, "m", Items.AGENTS, is_point=True),
            Field("obstacles", Kind.VECTOR, pillars, "m", family="obstacles", is_point=True),
        ),
        action=WHEEL_PAIRS if settings.actions == "discrete" else WHEELS,
        symmetry=settings.left_of("d4*agents"),
        nearly="d4*agents",
        shared_reward=False,
        control_period_s=settings.control_period_s,
        hidden=settings.hidden,
        totals=("arrival_rate", "time_to_arrival_s", "collisions", "path_length_m", "final_distance_m"),
        settings=settings.model_dump()
        | {
            "arena_m": settings.arena.side_m,
            "penalty_radius_m": settings.radius,
            "collision_penalty": settings.penalty,
            "sight": settings.seen_as,
        },
    )


def nearest_pair(wheels: Tensor) -> Tensor:
    """Return the index [...] of the action nearest to wheel speeds [..., 2] in [-1, 1]."""
    level = ((wheels + 1) * 5).round().long()
    return level[..., 0] * len(LEVELS) + level[..., 1]
