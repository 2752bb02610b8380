"""Batched, device-agnostic multi-agent environments whose numbers say what they are."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from esp_envs.errors import UserError
from esp_envs.spec import (
    Continuous,
    Discrete,
    Field,
    Items,
    Kind,
    Layout,
    Spaces,
    TaskSpec,
    joint_layout,
    layout,
)

if TYPE_CHECKING:
    from esp_envs.base import (
        Environment,
        Observation,
        Step,
        TaskSettings,
        generator_states,
        generators_for,
        restore_generators,
    )
    from esp_envs.batched import BatchedTask, Outcome, World, to_others
    from esp_envs.registry import make, register, task_class, task_names
    from esp_envs.scene import Body, Scene

__all__ = [
    "BatchedTask",
    "Body",
    "Continuous",
    "Discrete",
    "Environment",
    "Field",
    "Items",
    "Kind",
    "Layout",
    "Observation",
    "Outcome",
    "Scene",
    "Spaces",
    "Step",
    "TaskSettings",
    "TaskSpec",
    "UserError",
    "World",
    "generator_states",
    "generators_for",
    "joint_layout",
    "layout",
    "make",
    "register",
    "restore_generators",
    "task_class",
    "task_names",
    "to_others",
]


def __getattr__(name: str) -> Any:
    """Import what makes worlds when it is asked for; a spec alone needs the standard library alone."""
    if name in __all__:
        for module in map(import_module, ("esp_envs.base", "esp_envs.scene", "esp_envs.registry", "esp_envs.batched")):
            if hasattr(module, name):
                return getattr(module, name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
