"""A task with two roles on a line, whose numbers are worked out by hand."""

import torch
from pydantic import Field as Setting

from esp_envs import BatchedTask, Field, Items, Kind, layout
from esp_envs.base import joined
from esp_envs.roles import Role, spec_with_roles
from esp_envs.settings import TaskSettings
from esp_envs.spec import Continuous, Discrete

STEPS = Discrete(Kind.PSEUDOSCALAR, ((-1.0,), (1.0,)), ("down", "up"))
STEPS_OR_STAY = Discrete(Kind.PSEUDOSCALAR, ((-1.0,), (0.0,), (1.0,)), ("down", "stay", "up"))


class Chase(BatchedTask):
    """Two hunters want to be where the one prey is, which wants to be away; each sees where it is and the others."""

    def _describe(self):
        place = Field("place", Kind.PSEUDOSCALAR)
        hunter = layout(place, Field("fellow", Kind.PSEUDOSCALAR, items=Items.OTHERS), Field("prey", Kind.PSEUDOSCALAR))
        return spec_with_roles(
            [
                Role(name="hunter", num_agents=2, observation=hunter, action=STEPS, shared_reward=True),
                Role(
                    name="prey",
                    num_agents=1,
                    observation=layout(place, Field("hunters", Kind.PSEUDOSCALAR, 2, family="hunter")),
                    action=STEPS_OR_STAY,
                ),
            ],
            name="chase",
            version=1,
            convention="distance",
            horizon=4,
            symmetry="flip-x*agents",
            state=layout(Field("hunters", Kind.PSEUDOSCALAR, 2, family="hunter"), Field("prey", Kind.PSEUDOSCALAR)),
        )

    def _start(self, generator):
        return {"hunters": self.draw(2, 1, generator=generator), "prey": self.draw(1, 1, generator=generator)}

    def _advance(self, world, action):
        world["hunters"] = world["hunters"] + (2.0 * action[:, :, :2] - 1).unsqueeze(-1)
        world["prey"] = world["prey"] + (action[:, :, 2:] - 1.0).unsqueeze(-1)
        gap = (world["hunters"] - world["prey"]).abs().squeeze(-1).mean(-1)
        return torch.stack([-gap, -gap, 2 * gap], -1), {"gap": gap}

    def _observe(self, world):
        hunters, prey = world["hunters"], world["prey"]
        others = torch.cat([hunters.flip(2), prey.expand(-1, -1, 2, -1)], -1)
        return joined([torch.cat([hunters, others], -1), torch.cat([prey, hunters], 2).flatten(2).unsqueeze(2)])


class CrewSettings(TaskSettings):
    speeds: tuple[float, float] = Setting(default_factory=lambda: (0.1, 0.1), description="of the two cars")


class Crew(BatchedTask):
    """Two cars on a line and their boss, whose mood no transform moves."""

    Settings = CrewSettings

    def _describe(self):
        force = Continuous(layout(Field("force", Kind.SCALAR)))
        return spec_with_roles(
            [
                Role(name="car", num_agents=2, observation=layout(Field("place", Kind.SCALAR)), action=force),
                Role(name="boss", num_agents=1, observation=layout(Field("mood", Kind.SCALAR)), action=force),
            ],
            name="crew",
            version=1,
            convention="distance",
            horizon=5,
            symmetry="agents",
            state=layout(Field("places", Kind.SCALAR, 2, family="car"), Field("mood", Kind.SCALAR, family="boss")),
        )

    def _start(self, generator):
        return {"places": self.draw(2, 1, generator=generator), "mood": self.draw(1, 1, generator=generator)}

    def _advance(self, world, action):
        world["places"] = world["places"] + torch.tensor(self.settings.speeds).view(2, 1) * action[:, :, :2]
        world["mood"] = world["mood"] + 0.1 * action[:, :, 2:]
        return -torch.cat([world["places"], world["mood"]], 2)[..., 0].abs(), {}

    def _observe(self, world):
        return joined([world["places"], world["mood"]])
