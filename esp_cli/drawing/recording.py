"""What a policy does in some episodes, kept for drawing: scenes and returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from esp_cli.policies.loading import TrainedPolicy, single_seed
from esp_cli.training.build import build_environment
from esp_cli.training.play import PolicyController
from esp_cli.training.streams import generators
from esp_envs.base import Environment, put_back
from esp_envs.errors import UserError
from esp_envs.scene import Scene

FILM_SECONDS = 8.0
"""Short episodes follow each other until a film lasts about this long."""
HOLD_SECONDS = 0.6
"""For which a film shows how an episode ended."""
_MARGIN = 0.02
"""Share of a window by which bodies may leave it before it grows."""


@dataclass(frozen=True)
class Episode:
    """An episode to draw.

    Attributes:
        scenes: its start and every step, up to the one that ends it.
        returns: what the agents got until each scene, their mean.
    """

    scenes: Sequence[Scene]
    returns: Sequence[float]

    @property
    def steps(self) -> int:
        """Steps from the start to the end."""
        return len(self.scenes) - 1


def record(
    trained: TrainedPolicy, env: Environment, seed: int, episodes: int | None = None, greedy: bool = True
) -> list[Episode]:
    """Play episodes of one seed's policy, one after the other.

    Args:
        trained: the policies of a run.
        env: one world per seed of the run.
        seed: which of the run's seeds acts.
        episodes: how many; by default as many as last about `FILM_SECONDS`, at least one.
        greedy: act greedily, or draw actions.

    Raises:
        UserError: the run has no such seed.
    """
    seeds = trained.config.seeds
    if seed not in seeds:
        raise UserError(f"{trained.source} has no seed {seed}; it has {', '.join(map(str, seeds))}")
    noise = None if greedy else generators(seeds, "film", "noise")
    controller = PolicyController(trained.policy, noise)
    recorded: list[Episode] = []
    while len(recorded) < episodes if episodes is not None else not _long_enough(recorded, env.spec.control_period_s):
        recorded.append(_play(controller, env, (seeds.index(seed), 0)))
    return recorded


def _long_enough(recorded: Sequence[Episode], period_s: float) -> bool:
    """Return whether the film would come nearer to its length without one more episode."""
    if not recorded:
        return False
    seconds = sum(episode.steps * period_s + HOLD_SECONDS for episode in recorded)
    return seconds + seconds / len(recorded) / 2 > FILM_SECONDS


@torch.no_grad()
def _play(controller: PolicyController, env: Environment, world: tuple[int, int]) -> Episode:
    observation = env.reset()
    controller.begin(env, observation)
    scenes, returns = [env.scene(world)], [0.0]
    for _ in range(env.spec.horizon):
        step = env.step(controller.act(env, observation))
        observation = step.next
        ended = bool(step.ended[world])
        if ended and step.final is not None and env.has("set_state"):
            put_back(env, step.final)  # the world has reset itself; show how the episode ended
        scenes.append(scenes[-1] if ended and not env.has("set_state") else env.scene(world))
        returns.append(returns[-1] + float(step.reward.mean(-1)[world]))
        if ended:
            break
    return Episode(scenes, returns)


def record_both(
    first: TrainedPolicy, second: TrainedPolicy, seeds: tuple[int, int], episodes: int | None, greedy: bool
) -> tuple[list[Episode], list[Episode]]:
    """Play the same episodes with two policies.

    Args:
        first: of its episodes there are as many as `record` chooses.
        second: of the same task.
        seeds: whose policy acts, of each; the first one's decides how episodes begin.
        episodes: see `record`.
        greedy: act greedily, or draw actions.

    Raises:
        UserError: the tasks differ, or episodes do not begin alike.
    """
    recorded: list[list[Episode]] = []
    for trained, seed in zip((first, second), seeds, strict=True):
        alone = single_seed(trained, seed)
        config = alone.config.model_copy(update={"seeds": (seeds[0],)})
        env = build_environment(config, 1, "film")
        count = len(recorded[0]) if recorded else episodes
        recorded.append(record(replace(alone, config=config), env, seeds[0], count, greedy))
    for one, other in zip(*recorded, strict=True):
        places = [[body.position for body in episode.scenes[0].bodies] for episode in (one, other)]
        if places[0] != places[1]:
            raise UserError(
                f"the episodes of {first.source} and {second.source} begin differently; "
                "compare policies whose task has the same settings"
            )
    return recorded[0], recorded[1]


def framed(recorded: Sequence[Episode]) -> list[Episode]:
    """Return the episodes in one window that everything stays in."""
    scenes = [scene for episode in recorded for scene in episode.scenes]
    x_min, x_max, y_min, y_max = scenes[0].window
    slack = _MARGIN * max(x_max - x_min, y_max - y_min)
    bodies = {(*body.position, body.radius) for scene in scenes for body in scene.bodies}
    out = (
        max(max(x_min - (x - r), x + r - x_max, y_min - (y - r), y + r - y_max, 0.0) for x, y, r in bodies)
        if bodies
        else 0.0
    )
    if out <= slack:
        return list(recorded)
    window = (x_min - out, x_max + out, y_min - out, y_max + out)
    return [replace(e, scenes=[replace(scene, window=window) for scene in e.scenes]) for e in recorded]
