"""Batched, device-agnostic multi-agent environments whose numbers say what they are."""

from esp_envs.base import (
    Body,
    Environment,
    Observation,
    Scene,
    Step,
    TaskSettings,
    generator_states,
    generators_for,
    restore_generators,
)
from esp_envs.registry import make, task_class, task_names
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

__all__ = [
    "Body",
    "Continuous",
    "Discrete",
    "Environment",
    "Field",
    "Items",
    "Kind",
    "Layout",
    "Observation",
    "Scene",
    "Spaces",
    "Step",
    "TaskSettings",
    "TaskSpec",
    "generator_states",
    "generators_for",
    "joint_layout",
    "layout",
    "make",
    "restore_generators",
    "task_class",
    "task_names",
]
