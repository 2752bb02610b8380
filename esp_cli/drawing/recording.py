"""Episodes of policies, kept for drawing: scenes and returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from esp_cli.policies.loading import TrainedPolicy
from esp_cli.training.build import PolicyController, build_environment, generators
from esp_envs.base import Environment, put_back
from esp_envs.errors import UserError
from esp_envs.scene import Scene

FILM_SECONDS = 8.0  # short episodes follow each other until a film lasts about this long
HOLD_SECONDS = 1.0  # for which a film shows how an episode ended
_MARGIN = 0.02  # share of a window by which bodies may leave it before it grows


@dataclass(frozen=True)
class Episode:
    """An episode to draw, or its beginning."""

    scenes: Sequence[Scene]  # its start and every step; trails come from those before the last
    returns: Sequence[float]  # mean return of the agents until each scene
    end: str = ""  # how it ended, where it has
    name: str | None = None  # of the policy where two are compared

    @property
    def steps(self) -> int:
        return len(self.scenes) - 1

    def until(self, step: int, name: str | None = None) -> Episode:
        """Return the episode until a step, or until its end where that comes first."""
        until = slice(step + 1)
        return Episode(self.scenes[until], self.returns[until], self.end if step >= self.steps else "", name)


def record(policies: Sequence[TrainedPolicy], episodes: int | None = None, greedy: bool = True) -> list[list[Episode]]:
    """Play the same episodes with each policy, of one task and one seed each, by default about `FILM_SECONDS` long."""
    seeds, recorded = policies[0].config.seeds, list[list[Episode]]()
    for trained in policies:
        config = trained.config.model_copy(update={"seeds": seeds})
        controller = PolicyController(trained.policy, None if greedy else generators(seeds, "film", "noise"))
        own, seconds = list[Episode](), 0.0
        while len(own) < episodes if episodes else seconds * (1 + 0.5 / max(1, len(own))) <= FILM_SECONDS:
            # worlds of its own for each: where one begins hangs on no draw of the one before
            env = build_environment(config, 1, "film", *([len(own)] if own else []))
            own.append(_play(controller, env))
            seconds += own[-1].steps * env.spec.control_period_s + HOLD_SECONDS
        recorded.append(own)
        episodes = len(own)
    for together in zip(*recorded, strict=True):
        starts = [[body.position for body in episode.scenes[0].bodies] for episode in together]
        if starts[0] != starts[-1]:
            raise UserError(
                f"the episodes of {policies[0].source} and {policies[-1].source} begin differently; "
                "compare policies whose task has the same settings"
            )
    return recorded


@torch.no_grad()
def _play(controller: PolicyController, env: Environment) -> Episode:
    observation = env.reset()
    controller.begin(env, observation)
    scenes, returns, end = [env.scene()], [0.0], "end"
    for _ in range(env.spec.horizon):
        step = env.step(controller.act(env, observation))
        observation = step.next
        ended = bool(step.ended[0, 0])
        if ended and step.final is not None and env.has("set_state"):
            put_back(env, step.final)  # the world has reset itself; show how the episode ended
        scenes.append(scenes[-1] if ended and not env.has("set_state") else env.scene())
        returns.append(returns[-1] + float(step.reward.mean(-1)[0, 0]))
        if ended:
            end = f"end: {env.ending}" if bool(step.terminated[0, 0]) else end
            break
    return Episode(scenes, returns, end)


def framed(recorded: Sequence[Sequence[Episode]]) -> list[list[Episode]]:
    """Return the episodes in one window that everything stays in."""
    scenes = [scene for episodes in recorded for episode in episodes for scene in episode.scenes]
    x_min, x_max, y_min, y_max = scenes[0].window
    bodies = {(*body.position, body.radius) for scene in scenes for body in scene.bodies}
    beyond = (max(x_min - (x - r), x + r - x_max, y_min - (y - r), y + r - y_max) for x, y, r in bodies)
    out = max(beyond, default=0.0)
    if out <= _MARGIN * max(x_max - x_min, y_max - y_min):
        return [list(episodes) for episodes in recorded]
    window = (x_min - out, x_max + out, y_min - out, y_max + out)
    return [
        [replace(episode, scenes=[replace(scene, window=window) for scene in episode.scenes]) for episode in episodes]
        for episodes in recorded
    ]
