"""Batched, device-agnostic multi-agent environments whose numbers say what they are."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from esp_envs.errors import UserError
from esp_envs.spec import Continuous, Discrete, Field, Items, Kind, Layout, Spaces, TaskSpec, joint_layout, layout

if TYPE_CHECKING:
    from esp_envs.base import Environment, Observation, Step, generator_states, generators_for, restore_generators
    from esp_envs.batched import BatchedTask, Outcome, World, to_others
    from esp_envs.registry import make, register, task_class, task_names
    from esp_envs.scene import Body, Scene
    from esp_envs.settings import TaskSettings

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
        for module in ("base", "settings", "scene", "registry", "batched"):
            found = import_module(f"esp_envs.{module}")
            if hasattr(found, name):
                return getattr(found, name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
