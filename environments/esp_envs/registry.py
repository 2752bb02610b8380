"""The tasks by name. Adding a task is one module and one line here; a module is imported when its task is asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module

import torch

from esp_envs.base import Environment, generators_for

_TASKS = {
    "navigation": "esp_envs.mpe.navigation:Navigation",
    "predator-prey": "esp_envs.mpe.predator_prey:PredatorPrey",
    "formation": "esp_envs.epuck.formation:Formation",
    "wildlife": "esp_envs.wildlife.wildlife:Wildlife",
}


def task_names() -> tuple[str, ...]:
    """Return the registered names."""
    return tuple(_TASKS)


def task_class(name: str) -> type[Environment]:
    """Import and return the environment class of a task.

    Raises:
        ValueError: no such task.
    """
    if name not in _TASKS:
        raise ValueError(f"unknown task '{name}'; the tasks are {', '.join(_TASKS)}")
    module, attribute = _TASKS[name].split(":")
    return getattr(import_module(module), attribute)


def make(
    name: str,
    num_envs: int,
    seeds: Sequence[int],
    settings: Mapping[str, object] | None = None,
    device: torch.device | str = "cpu",
) -> Environment:
    """Make E worlds for each of the S seeds.

    Args:
        name: registered name.
        num_envs: E, worlds per seed.
        seeds: one integer per seed.
        settings: task settings that differ from the defaults.
        device: where the worlds live.

    Raises:
        ValueError: unknown task, unknown setting, or a value out of range.
    """
    cls = task_class(name)
    return cls(cls.Settings(**(settings or {})), num_envs, generators_for(seeds, device))
