"""Learners on a task that shows rings of rays and records of several numbers."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from esp_cli.checking import check_symmetry
from esp_envs import (
    BatchedTask,
    Discrete,
    Field,
    Items,
    Kind,
    TaskSettings,
    TaskSpec,
    layout,
    make,
    register,
    to_others,
)
from esp_envs.registry import TASKS
from tests.algorithms.off_policy import small_learner

TASK = f"{__name__}:Scouts"
MOVES = ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
RAYS = 8


class ScoutsSettings(TaskSettings):
    horizon: int = 5


class Scouts(BatchedTask):
    """Two scouts walk to lamps, some of which are lit, and see each other by eight rays."""

    Settings = ScoutsSettings

    def _describe(self) -> TaskSpec:
        lamp = (Field("offset", Kind.VECTOR), Field("lit", Kind.SCALAR))
        return TaskSpec(
            name="scouts",
            version=1,
            convention="minus the distance to lit lamps",
            num_agents=2,
            horizon=self.settings.horizon,
            symmetry="d4*agents",
            settings=self.settings.model_dump(),
            observation=layout(Field("lamps", Kind.RECORD, 3, parts=lamp), Field("rays", Kind.RING, rays=RAYS)),
            state=layout(
                Field("position", Kind.VECTOR, 2, items=Items.AGENTS),
                Field("lamps", Kind.VECTOR, 3),
                Field("lit", Kind.SCALAR, 3),
            ),
            action=Discrete(Kind.VECTOR, MOVES, ("stay", "right", "left", "up", "down")),
        )

    def _start(self, generator: torch.Generator) -> dict[str, Tensor]:
        lit = (self.draw(3, 1, generator=generator) > 0).float()
        return {
            "position": self.draw(2, 2, generator=generator),
            "lamps": self.draw(3, 2, generator=generator),
            "lit": lit,
        }

    def _advance(self, world: dict[str, Tensor], action: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        world["position"] = world["position"] + 0.2 * torch.tensor(MOVES)[action]
        distance = self._offsets(world).norm(dim=-1) * world["lit"].transpose(-1, -2)
        return -distance.mean((-1, -2)), {}

    def _observe(self, world: dict[str, Tensor]) -> Tensor:
        lit = world["lit"].unsqueeze(2).expand(-1, -1, 2, -1, -1)
        lamps = torch.cat([self._offsets(world), lit], -1).flatten(-2)
        angles = torch.arange(RAYS) * (2 * math.pi / RAYS)
        rays = torch.stack([angles.cos(), angles.sin()])
        return torch.cat([lamps, (to_others(world["position"]) @ rays).amax(-2)], -1)

    def _offsets(self, world: dict[str, Tensor]) -> Tensor:
        return world["lamps"].unsqueeze(2) - world["position"].unsqueeze(3)


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setattr(TASKS, "_registered", {})
    assert register(Scouts) == TASK


def learner(algorithm, **overrides):
    return small_learner(TASK, algorithm, hidden=[16], **overrides)


@pytest.mark.parametrize("algorithm", ["mappo", "maddpg", "qmix"])
def test_a_learner_takes_updates_with_copies_and_penalty(algorithm):
    trained = learner(algorithm)
    before = [parameter.clone() for parameter in trained.policy.parameters()]
    for _ in range(2):
        iteration = trained.iterate(0.0)
        assert bool(iteration.finite.all())
    assert any(not torch.equal(a, b) for a, b in zip(before, trained.policy.parameters(), strict=True))
    assert float(iteration.metrics["train/value_symmetry_error"].min()) > 1e-6, "the control: a perceptron has a gap"


def test_an_equivariant_policy_has_no_symmetry_error_after_an_update():
    trained = learner("mappo", **{"network.name": "equivariant", "network.group": "d4"})
    errors = trained.iterate(0.0).metrics
    assert float(errors["train/policy_symmetry_error"].abs().max()) < 1e-6
    assert float(errors["train/value_symmetry_error"].abs().max()) < 1e-6


def test_the_task_is_as_symmetric_as_it_declares():
    report = check_symmetry(lambda count, seeds: make(TASK, count, seeds), "rot90,flip-x,agents-1-0")
    assert report.holds
    assert {field.field for element in report.elements for field in element.fields} >= {"obs.rays", "obs.lamps"}
