"""Tiny runs for the tests of training."""

from esp_cli.training.config import RunConfig, resolve_config
from esp_cli.training.run_folder import RunFolder
from tests.algorithms.off_policy import on_perceptron

TINY = {
    "mappo.num_envs": 2,
    "mappo.num_epochs": 1,
    "mappo.num_minibatches": 1,
    "network.hidden": [8],
    "evaluation.episodes": 2,
    "evaluation.every_steps": 100,
}


def tiny_config(steps=300, seeds=(0, 1), task="navigation", **overrides) -> RunConfig:
    """A run of 50 steps an iteration that takes milliseconds."""
    settings = TINY | on_perceptron(task) | {name.replace("__", "."): value for name, value in overrides.items()}
    return resolve_config(task, steps=steps, seeds=seeds, overrides=settings)


def tiny_folder(path, **choice) -> RunFolder:
    return RunFolder.create(path, tiny_config(**choice).model_dump(mode="json"))
