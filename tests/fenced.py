"""A task whose actions are masked: agents may not leave a square. It raises where an agent does."""

from dataclasses import replace

import torch
from torch import Tensor

from esp_envs import BatchedTask, Discrete, Field, Items, Kind, TaskSettings, TaskSpec, layout, to_others

MOVES = ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
NAMES = ("stay", "right", "left", "up", "down")


class FencedSettings(TaskSettings):
    num_agents: int = 2
    horizon: int = 6


class Fenced(BatchedTask):
    """Agents walk to the middle of a square, in steps of 0.4."""

    Settings = FencedSettings

    def _describe(self) -> TaskSpec:
        n = self.settings.num_agents
        return TaskSpec(
            name="fenced",
            version=1,
            convention="minus the mean distance to the middle",
            num_agents=n,
            horizon=self.settings.horizon,
            symmetry="d4*agents",
            masks=True,
            settings=self.settings.model_dump(),
            observation=layout(Field("position", Kind.VECTOR), Field("others", Kind.VECTOR, n - 1, items=Items.OTHERS)),
            state=layout(Field("position", Kind.VECTOR, n, items=Items.AGENTS)),
            action=Discrete(Kind.VECTOR, MOVES, NAMES),
        )

    def _start(self, generator: torch.Generator) -> dict[str, Tensor]:
        return {"position": self.draw(self.settings.num_agents, 2, generator=generator)}

    def _allow(self, world: dict[str, Tensor]) -> Tensor:
        after = world["position"].unsqueeze(-2) + 0.4 * torch.tensor(MOVES)
        return (after.abs() <= 1).all(-1) | (torch.arange(5) == 0)

    def _advance(self, world: dict[str, Tensor], action: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        if not bool(Fenced._allow(self, world).gather(-1, action.unsqueeze(-1)).all()):
            raise RuntimeError("a forbidden action is taken")
        world["position"] = world["position"] + 0.4 * torch.tensor(MOVES)[action]
        return -world["position"].norm(dim=-1).mean(-1), {"spread": world["position"].norm(dim=-1).amax(-1)}

    def _observe(self, world: dict[str, Tensor]) -> Tensor:
        return torch.cat([world["position"].unsqueeze(-2), to_others(world["position"])], -2)


class OneSided(Fenced):
    """Its mask forbids going right alone, so that it is not symmetric, though the moves are."""

    def _allow(self, world: dict[str, Tensor]) -> Tensor:
        allowed = super()._allow(world)
        allowed[..., 1] &= world["position"][..., 0] < 0
        return allowed


class Nothing(Fenced):
    """Its mask allows some agents nothing."""

    def _allow(self, world: dict[str, Tensor]) -> Tensor:
        return super()._allow(world) & (world["position"][..., :1] < 0)


class GatedSettings(FencedSettings):
    fenced: bool = True


class Gated(Fenced):
    """Its fence is a setting; without one all may be done."""

    Settings = GatedSettings

    def _describe(self) -> TaskSpec:
        return replace(super()._describe(), masks=self.settings.fenced)

    def _allow(self, world: dict[str, Tensor]) -> Tensor | None:
        return super()._allow(world) if self.settings.fenced else None

    def _advance(self, world: dict[str, Tensor], action: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        reward = -world["position"].norm(dim=-1).mean(-1)
        return reward, {"spread": world["position"].norm(dim=-1).amax(-1)}
