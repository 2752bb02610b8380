"""The tasks by name: built in, installed by other packages, or named by module and class.

A built-in task is one module and one line here; see `esp_envs.installed` for the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from pydantic import ValidationError

from esp_envs.base import Environment, generators_for
from esp_envs.errors import UserError
from esp_envs.installed import Registry

TASKS: Registry[Environment] = Registry(
    "task",
    {
        "navigation": "esp_envs.mpe.navigation:Navigation",
        "predator-prey": "esp_envs.mpe.predator_prey:PredatorPrey",
        "formation": "esp_envs.epuck.formation:Formation",
        "wildlife": "esp_envs.wildlife:Wildlife",
    },
    base="esp_envs.base:Environment",
    option="--task",
    example="rendezvous:Rendezvous",
)


def task_names() -> tuple[str, ...]:
    """Return the names of the built-in and the installed tasks, and of those that the caller registered."""
    return tuple(TASKS)


def register(task: str | type[Environment]) -> str:
    """Admit a task that is not installed and return its name; `Registry.register` says what it refuses."""
    return TASKS.register(task)


def task_class(name: str) -> type[Environment]:
    """Return the environment class of a task; a UserError says what is wrong with a name that has none."""
    return TASKS[name]


def make(
    name: str,
    num_envs: int,
    seeds: Sequence[int],
    settings: Mapping[str, object] | None = None,
    device: torch.device | str = "cpu",
) -> Environment:
    """Make E worlds for each of the S seeds.

    Args:
        name: of a built-in, installed or registered task.
        num_envs: E, worlds per seed.
        seeds: one integer per seed.
        settings: task settings that differ from the defaults.
        device: where the worlds live.

    Raises:
        UserError: unknown task, unknown setting, or a value out of range.
    """
    cls = task_class(name)
    try:
        chosen = cls.Settings(**(settings or {}))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise UserError(f"{name} does not take these settings{f', {where}' if where else ''}: {first['msg']}") from None
    return cls(chosen, num_envs, generators_for(seeds, device))
