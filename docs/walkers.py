"""Three robots on two legs each, on which left and right may change places: the task of docs/add-a-symmetry.md."""

from __future__ import annotations

import torch
from legs import LEGS  # the first file of the page
from torch import Tensor

from esp_envs import BatchedTask, Continuous, Field, Items, TaskSettings, TaskSpec, layout

OTHERS = [[1, 2], [0, 2], [0, 1]]


class WalkersSettings(TaskSettings):
    """What `--set task.NAME=VALUE` chooses."""

    lame: bool = False  # whether each left leg is weak: legs may not change places then


class Walkers(BatchedTask):
    """The robots bring all their knees to the mean of all knees."""

    Settings = WalkersSettings

    def _describe(self) -> TaskSpec:
        return TaskSpec(
            name="walkers",
            version=1,
            convention="minus the mean square",
            num_agents=3,
            horizon=10,
            symmetry="legs*agents",
            settings=self.settings.model_dump(),
            observation=layout(Field("knees", LEGS), Field("others", LEGS, 2, items=Items.OTHERS)),
            state=layout(Field("knees", LEGS, 3, items=Items.AGENTS)),
            action=Continuous(layout(Field("torque", LEGS))),
        )

    def _start(self, generator: torch.Generator) -> dict[str, Tensor]:
        return {"knees": self.draw(3, 2, generator=generator)}

    def _advance(self, world: dict[str, Tensor], action: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        strength = torch.tensor([0.2 if self.settings.lame else 1.0, 1.0])
        knees = world["knees"] = world["knees"] + 0.3 * action * strength
        return -(knees - knees.mean((-2, -1), keepdim=True)).square().mean((-2, -1)), {}

    def _observe(self, world: dict[str, Tensor]) -> Tensor:
        return torch.cat([world["knees"], world["knees"][:, :, OTHERS].flatten(-2)], -1)
