"""The description of an export: layouts with units, meaning of the actions, a worked example; JSON and README."""

from __future__ import annotations

from typing import Any

import numpy as np

from esp_cli.defaults import __version__
from esp_cli.export.check import Sample
from esp_cli.export.program import Program
from esp_cli.export.sets import named
from esp_cli.files.documents import DocumentFormat
from esp_cli.networks.heads import BoundedGaussian
from esp_cli.policies.loading import TrainedPolicy
from esp_envs.registry import task_class
from esp_envs.spec import Discrete, Layout, TaskSpec, describe_action

EXPORT = DocumentFormat("esp-export", 1, "the description of an export")


def describe(trained: TrainedPolicy, program: Program, sample: Sample) -> dict[str, Any]:
    """Return what `policy.json` holds; the sample's first row (of a team its first world) is the worked example."""
    config, spec, head = trained.config, trained.spec, trained.policy.head
    first = slice(program.team) if program.team > 1 else 0
    # What builds observations from poses knows no compass.
    robot = {} if config.prior.effective().compass else task_class(config.task).robot
    std = {"latent_std": head.log_std[0].exp()[head.item].tolist()} if isinstance(head, BoundedGaussian) else {}
    rows = {"observation": sample.obs, "memory": sample.memory, "action_mask": sample.mask, "outputs": sample.outputs}
    rows |= {"action": sample.action, "memory_after": sample.after}
    task = ("name", "version", "convention", "num_agents", "control_period_s", "settings")
    content: dict[str, Any] = {
        "esp_version": __version__,
        "task": {name: getattr(spec, name) for name in task},
        "policy": {
            "algorithm": config.algorithm,
            "prior": config.prior.kind,
            "seed": config.seeds[0],
            "step": trained.step,
            "network": program.describe(),
            "parameters": program.num_parameters,
            **std,
        },
        **({"robot": dict(robot)} if robot else {}),
        "observation": _fields(spec.observation),
        "action": _action(spec),
        "memory": {"hidden": program.hidden, "previous_action": program.previous},
        "example": {name: array[first].tolist() for name, array in rows.items() if array is not None}
        | ({"sets": {name: table[0].tolist() for name, table in sample.sets.items()}} if sample.sets else {}),
    }
    return EXPORT.document(content)


def _fields(layout: Layout) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for row, field in zip(layout.table(), layout.fields, strict=True):
        rows.append(dict(zip(("index", "field", "kind", "unit"), row, strict=True)))
        parts = getattr(field.kind, "parts", ())  # what its numbers are called, as joints are
        if set(parts) - {field.name}:
            rows[-1]["parts"] = parts
    return rows


def _action(spec: TaskSpec) -> dict[str, Any]:
    if isinstance(spec.action, Discrete):
        points = zip(spec.action.names, spec.action.points, strict=True)
        options = [{"index": k, "name": name, "means": list(point)} for k, (name, point) in enumerate(points)]
        return {"choose": spec.action.kind.name, "options": options}
    return {"bounds": [-1.0, 1.0], "fields": _fields(spec.action.layout)}


def words(trained: TrainedPolicy, program: Program, description: dict[str, Any]) -> dict[str, Any]:
    """Return what templates need to say what the policy is and what its numbers mean."""
    config, spec = trained.config, trained.spec
    role = f", role {trained.role}" if trained.role else ""
    prior = "without prior" if config.prior.kind == "none" else f"with the prior {config.prior.kind}"
    return {
        "title": f"{config.task} version {spec.version}{role}: greedy policy of {config.algorithm} {prior}, seed "
        f"{config.seeds[0]}, {trained.step} environment steps",
        "version": __version__,
        "spec": spec,
        "program": program,
        "description": description,
        "set_names": named(name for name, _ in program.sets),
        "options": [f"{name}: {means}" for name, means in describe_action(spec.action)],
        "most_rows": 16,  # beyond which only `policy.json` lists them
        "of_robot": any(hasattr(field.kind, "parts") for field in spec.observation.fields),  # may be seen from its body
    }


def shortly(values: Any) -> str:
    """Return the first numbers of an array."""
    numbers = np.ravel(values).tolist()
    text = ", ".join(f"{x:.4g}" for x in numbers[:12])
    return f"{text}, ..." if len(numbers) > 12 else text
