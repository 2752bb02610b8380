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
from esp_envs.lockstep import BatchedTask, Outcome, World, to_others
from esp_envs.registry import make, register, task_class, task_names
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
