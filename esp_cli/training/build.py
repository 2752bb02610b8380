"""Building what a run consists of from its configuration alone: its worlds and its learner."""

from __future__ import annotations

from esp_cli.algorithms.learner import Learner
from esp_cli.algorithms.registry import ALGORITHMS
from esp_cli.training.config import RunConfig
from esp_cli.training.memory import refuse_what_does_not_fit
from esp_cli.training.streams import generators, stream_seeds
from esp_envs.base import Environment
from esp_envs.compass import Compass
from esp_envs.registry import make


def build_environment(config: RunConfig, num_envs: int, *stream: object) -> Environment:
    """Make `num_envs` worlds per seed whose draws come from the named random stream, with the prior's compass."""
    env = make(config.task, num_envs, stream_seeds(config.seeds, *stream), config.task_settings, config.device)
    prior = config.prior.effective()
    return Compass(env, prior.compass, labels="agents" in prior.transforms) if prior.compass else env


def build_learner(config: RunConfig) -> Learner:
    """Build the learner of a run, with its worlds, from the configuration alone.

    Raises:
        ValueError: parts of the configuration do not go together, or it needs more memory than the machine has.
    """
    cls = ALGORITHMS[config.algorithm]
    settings = cls.config_class(**config.algorithm_settings)
    refuse_what_does_not_fit(config, settings, build_environment(config, 1, "shape").spec)
    env = build_environment(config, settings.num_envs, "training worlds")
    return cls(
        env,
        settings,
        config.network,
        config.prior,
        generators(config.seeds, "learner"),
        generators(config.seeds, "prior"),
    )
