"""A task whose agents end one by one: who reaches the right half of the line has arrived, and acts no more."""

import torch
from torch import Tensor

from esp_envs import BatchedTask, Discrete, Field, Items, Kind, TaskSettings, TaskSpec, layout, to_others


class LeavingSettings(TaskSettings):
    num_agents: int = 3
    horizon: int = 6
    shared: bool = False


class Leaving(BatchedTask):
    """Agents walk right; each is paid 1 when it arrives at x = 1, and -0.1 for each step on the way."""

    Settings = LeavingSettings

    def _describe(self) -> TaskSpec:
        n = self.settings.num_agents
        return TaskSpec(
            name="leaving",
            version=1,
            convention="1 for arriving",
            num_agents=n,
            horizon=self.settings.horizon,
            symmetry="d1*agents",
            shared_reward=self.settings.shared,
            agents_end=True,
            settings=self.settings.model_dump(),
            observation=layout(Field("position", Kind.VECTOR), Field("others", Kind.VECTOR, n - 1, items=Items.OTHERS)),
            state=layout(Field("position", Kind.VECTOR, n, items=Items.AGENTS)),
            action=Discrete(Kind.VECTOR, ((0.0, 0.0), (1.0, 0.0)), ("stay", "right")),
        )

    def _start(self, generator: torch.Generator) -> dict[str, Tensor]:
        return {"position": self.draw(self.settings.num_agents, 2, generator=generator)}

    def _living(self, world: dict[str, Tensor]) -> Tensor:
        return world["position"][..., 0] < 1

    def _advance(self, world: dict[str, Tensor], action: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        alive = self._living(world)
        step = torch.where(alive & (action == 1), 0.5, 0.0)
        world["position"] = world["position"] + torch.stack([step, torch.zeros_like(step)], -1)
        arrived = alive & ~self._living(world)
        reward = torch.where(alive, arrived.float() - 0.1, 0.0)
        if self.settings.shared:
            reward = reward.mean(-1, keepdim=True).expand_as(reward)
        return reward, {"arrived": 1 - self._living(world).float().mean(-1)}

    def _observe(self, world: dict[str, Tensor]) -> Tensor:
        return torch.cat([world["position"].unsqueeze(-2), to_others(world["position"])], -2)


class Returning(Leaving):
    """Some of its agents act again after they have ended."""

    def _living(self, world: dict[str, Tensor]) -> Tensor:
        return super()._living(world) | (self._time % 3 == 2)


class BriefSettings(LeavingSettings):
    shared: bool = True


class Brief(Leaving):
    """All agents end with the first step, which costs the team 1; nothing is paid behind it: the return is -1."""

    Settings = BriefSettings

    def _advance(self, world: dict[str, Tensor], action: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        reward = torch.where(self._living(world), -1.0, 0.0)
        world["position"] = world["position"] + torch.tensor([4.0, 0.0])
        return reward, {"arrived": 1 - self._living(world).float().mean(-1)}
