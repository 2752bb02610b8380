"""What a user may change of predator-prey, and the spec that follows."""

from __future__ import annotations

from typing import Literal

from pydantic import Field as Setting
from pydantic import model_validator

from esp_envs.errors import UserError
from esp_envs.mpe.many import MOST_BODIES
from esp_envs.mpe.task import FORCE, MOVES, OWN, ParticleSettings
from esp_envs.roles import Role, spec_with_roles
from esp_envs.spec import Field, Items, Kind, Layout, TaskSpec, filled_layout


class PredatorPreySettings(ParticleSettings):
    """What a user may change of `predator-prey`."""

    num_predators: int = Setting(3, ge=1, le=100_000, description="predators; 3 in the paper")
    num_obstacles: int = Setting(2, ge=0, le=100_000, description="fixed discs; 2 in MPE, 3 by the authors' launcher")
    control: Literal["predators", "prey", "both"] = Setting(
        "predators",
        description="who learns; with 'prey' the predators follow the heuristic `chase`, with 'both' each side learns",
    )
    prey: Literal["random", "fleeing", "still"] = Setting(
        "random", description="who drives the prey while the predators learn"
    )

    @property
    def team(self) -> int:
        return self.num_predators

    @property
    def many(self) -> bool:
        return super().many or self.num_predators == MOST_BODIES  # with the prey there is one more

    @property
    def turns(self) -> str:
        """The rotations that actions, dynamics and reward carry; the learning prey's bounds are a square."""
        return super().turns if self.control == "predators" else "c4"

    def without_effect(self) -> frozenset[str]:
        return frozenset({"sees"} if self.control == "prey" else ())

    @model_validator(mode="after")
    def _one_drives_the_prey(self) -> PredatorPreySettings:
        if self.control != "predators" and self.prey != "random":
            raise UserError(f"with control '{self.control}' the prey is a learner; leave prey out")
        return self


def predator_prey_spec(settings: PredatorPreySettings) -> TaskSpec:
    """Return the spec that follows from the settings."""
    control, prey_learns, discrete = settings.control, settings.control != "predators", settings.actions == "discrete"
    order = "velocity first" if settings.convention == "esp" else "position first"
    rewards = {"predators": "10 a touch to each predator", "prey": "-10 a touch, bounds"}
    reward = rewards.get(control, ", ".join(f"{who} {what}" for who, what in rewards.items()))
    opponent = {"prey": "chasing predators", "both": "both learn"}.get(control, f"{settings.prey} prey")
    whole = "d4*agents" if discrete or prey_learns else "o2*agents"
    sides = {"predators": (settings.num_predators, _predator_layout(settings)), "prey": (1, prey_layout(settings))}
    action = MOVES if discrete else FORCE
    roles = [
        Role(name=name, num_agents=count, observation=seen, action=action, shared_reward=True)
        for name, (count, seen) in sides.items()
        if control in (name, "both")
    ]
    return spec_with_roles(
        roles,
        name="predator-prey",
        version=1,
        convention=f"{settings.convention}: {reward}, {opponent}, {order}{settings.broken_in_words()}",
        horizon=settings.horizon,
        state=_state_layout(settings),
        symmetry=settings.left_of(whole),
        nearly=whole,
        settings=settings.model_dump(),
    )


def _predator_layout(settings: PredatorPreySettings) -> Layout:
    return filled_layout(
        *OWN,
        *settings.seen_fields("obstacles", settings.num_obstacles, "predators"),
        Field("prey", Kind.VECTOR, 1, "length", family="prey"),
        Field("prey_velocity", Kind.VECTOR, 1, "length/s", family="prey"),
    )


def prey_layout(settings: PredatorPreySettings) -> Layout:
    """Return what a prey observes."""
    return filled_layout(
        *OWN,
        Field("obstacles", Kind.VECTOR, settings.num_obstacles, "length", family="obstacles"),
        Field("predators", Kind.VECTOR, settings.num_predators, "length", family="predators"),
    )


def _state_layout(settings: PredatorPreySettings) -> Layout:
    predators = settings.num_predators
    learns = {"predators": Items.FIXED, "prey": Items.FIXED} | {settings.control: Items.AGENTS}
    hunters, hunted = learns["predators"], learns["prey"]
    return filled_layout(
        Field("velocity", Kind.VECTOR, predators, "length/s", hunters, family="predators"),
        Field("prey_velocity", Kind.VECTOR, 1, "length/s", hunted, family="prey"),
        Field("position", Kind.VECTOR, predators, "length", hunters, family="predators", is_point=True),
        Field("prey_position", Kind.VECTOR, 1, "length", hunted, family="prey", is_point=True),
        Field("obstacles", Kind.VECTOR, settings.num_obstacles, "length", family="obstacles", is_point=True),
    )
