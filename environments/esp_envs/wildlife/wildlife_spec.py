"""What a user may change of wildlife monitoring, and the spec that follows."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field as Setting
from pydantic import model_validator

from esp_envs.errors import UserError
from esp_envs.settings import Breaks, TaskSettings
from esp_envs.spec import DOWN, LEFT, RIGHT, UP, Discrete, Field, Items, Kind, TaskSpec, layout

REST = (0.0, 0.0)
MOVES = Discrete(Kind.VECTOR, (REST, UP, RIGHT, DOWN, LEFT), ("rest", "up", "right", "down", "left"))
"""In the order of van der Pol's code; the meaning of each is the way to the next cell."""
STEP_COST = 0.05  # what a step costs the whole team
PIXELS = 3  # along a side of a cell in a drone's picture


class WildlifeSettings(TaskSettings):
    """What a user may change of `wildlife`."""

    convention: Literal["esp", "corrected"] = Setting(
        "esp",
        description="whose rules: 'esp' is van der Pol's code, which the paper used, 'corrected' has its quirks mended",
    )
    num_agents: int = Setting(3, ge=2, le=256, description="N, drones; van der Pol: 3")
    width: int = Setting(7, ge=3, le=63, description="columns of the grid, an odd number; van der Pol: 7")
    height: int = Setting(7, ge=3, le=63, description="rows of the grid, an odd number")
    horizon: int = Setting(100, ge=1, le=100_000, description="steps of an episode, at most")
    poacher_moves: float = Setting(0.8, ge=0, le=1, description="probability that the poacher moves in a step")
    wind: Annotated[float, Breaks("flip-x")] = Setting(
        0.0, ge=0, le=1, description="breaks symmetry: probability that a moving poacher is carried to the right"
    )

    @model_validator(mode="after")
    def _fits(self) -> WildlifeSettings:
        if self.width % 2 == 0 or self.height % 2 == 0:
            raise UserError(
                f"a grid of {self.width} x {self.height} cells has no cell in its middle; use odd numbers, so that a "
                "drone can be in the middle of its picture"
            )
        if self.num_agents >= self.width * self.height:
            raise UserError(f"{self.num_agents} drones and a poacher do not fit on {self.width * self.height} cells")
        return self


def wildlife_spec(settings: WildlifeSettings) -> TaskSpec:
    """Return the spec that follows from the settings."""
    agents, width, height = settings.num_agents, settings.width, settings.height
    before = "before its move, no way round the torus" if settings.convention == "esp" else "after its move"
    whole = "d4*agents" if width == height else "d2*agents"
    return TaskSpec(
        name="wildlife",
        version=1,
        convention=f"{settings.convention}: 1 a drone at the trap, -{STEP_COST:g} a step; poacher's cell {before}"
        + settings.broken_in_words(),
        num_agents=agents,
        horizon=settings.horizon,
        observation=layout(
            Field("picture", Kind.PICTURE, 1, "shade", pixels=(PIXELS * height, PIXELS * width)),
            Field("others", Kind.VECTOR, agents - 1, "cell", Items.OTHERS),
        ),
        state=layout(
            Field("drones", Kind.VECTOR, agents, "cell", Items.AGENTS, is_point=True),
            Field("poacher", Kind.VECTOR, 1, "cell", is_point=True),
        ),
        action=MOVES,
        symmetry=settings.left_of(whole),
        nearly=whole,
        control_period_s=0.25,
        totals=("captures", "lone_landings", "collisions", "steps"),
        terminates=True,
        settings=settings.model_dump(),
    )
