"""The description of an export: layouts with units, meaning of the actions, a worked example; JSON and README."""

from __future__ import annotations

from typing import Any

import numpy as np

from esp_cli.defaults import __version__
from esp_cli.export.check import Sample
from esp_cli.export.program import Program
from esp_cli.networks.heads import BoundedGaussian
from esp_cli.policies.loading import TrainedPolicy
from esp_envs.registry import task_class
from esp_envs.spec import Discrete, Layout, TaskSpec, describe_action

EXPORT_FORMAT, EXPORT_VERSION = "esp-export", 1
_MOST_ROWS = 16  # actions beyond which only `policy.json` lists them


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
    return {
        "format": EXPORT_FORMAT,
        "version": EXPORT_VERSION,
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
        | ({"sets": {name: table[first].tolist() for name, table in sample.sets.items()}} if sample.sets else {}),
    }


def _fields(layout: Layout) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for row, parts in zip(layout.table(), _parts(layout), strict=True):
        rows.append(
            dict(zip(("index", "field", "kind", "unit"), row, strict=True)) | ({"parts": parts} if parts else {})
        )
    return rows


def _parts(layout: Layout) -> list[tuple[str, ...]]:
    """Return for each field what its numbers are called, as joints are."""
    named = [tuple(getattr(field.kind, "parts", ())) for field in layout.fields]
    return [parts if set(parts) - {f.name} else () for f, parts in zip(layout.fields, named, strict=True)]


def _action(spec: TaskSpec) -> dict[str, Any]:
    if isinstance(spec.action, Discrete):
        points = zip(spec.action.names, spec.action.points, strict=True)
        options = [{"index": k, "name": name, "means": list(point)} for k, (name, point) in enumerate(points)]
        return {"choose": spec.action.kind.name, "options": options}
    return {"bounds": [-1.0, 1.0], "fields": _fields(spec.action.layout)}


def title(trained: TrainedPolicy) -> str:
    """Return what the policy is in a line."""
    config = trained.config
    role = f", role {trained.role}" if trained.role else ""
    prior = "without prior" if config.prior.kind == "none" else f"with the prior {config.prior.kind}"
    return (
        f"{config.task} version {trained.spec.version}{role}: greedy policy of {config.algorithm} {prior}, seed "
        f"{config.seeds[0]}, {trained.step} environment steps"
    )


def summary(trained: TrainedPolicy, program: Program) -> str:
    """Return title, layouts and memory as plain lines, for the top of a source file."""
    return "\n".join([f"{title(trained)}.", f"Written by esp {__version__}.", "", *spaces(trained.spec, program)])


def spaces(spec: TaskSpec, program: Program) -> list[str]:
    """Return layouts and memory as plain lines."""
    lines = ["Observation of one agent (float32):", *_rows(spec.observation)]
    if program.team > 1:
        lines.append(
            f"The {program.team} agents of a world exchange messages and act together: their rows are adjacent."
        )
    if program.sets:
        names = ", ".join(f"{name} {len(columns[0])}" for name, columns in program.sets)
        lines.append(
            f"The policy takes the {program.num_inputs} own numbers as its observation, and beside them a table "
            f"of each set, with a row for each thing, as many as there are, at least one; numbers of a row: {names}."
        )
    of_robot = any(hasattr(field.kind, "parts") for field in spec.observation.fields)
    if not of_robot:  # whose numbers may be seen from its body
        lines += ["The frame is the world's: x to the right, y up, angles counter-clockwise in radians."]
    lines.append("Action of one agent:")
    if isinstance(spec.action, Discrete):
        lines.append(f"  the index of one of {spec.action.count} options, each a {spec.action.kind.name}:")
        options = list(describe_action(spec.action))
        lines += [f"  {name}: {means}" for name, means in options[:_MOST_ROWS]]
        lines += ["  ... (the rest is in policy.json)"] if len(options) > _MOST_ROWS else []
        if program.masked:
            lines.append("A mask gives the allowed actions: action_mask, in C allowed. Where none is allowed, all are.")
    else:
        lines += [*_rows(spec.action.layout), "  each number in [-1, 1], planar vectors in the unit disc"]
    lines.append(f"One action every {spec.control_period_s:g} s, the best one: exports do not explore.")
    if program.memory_width:
        lines.append(f"Memory of one agent: {program.memory_width} numbers, zeros when an episode begins.")
    return lines


def _rows(layout: Layout) -> list[str]:
    rows = []
    for (index, name, kind, unit), parts in zip(layout.table(), _parts(layout), strict=True):
        names = f": {', '.join(parts[:_MOST_ROWS])}{', ...' if len(parts) > _MOST_ROWS else ''}" if parts else ""
        rows.append(f"  {index:>7}  {name}: {kind}{f' ({unit})' if unit else ''}{names}")
    return rows


def shortly(values: Any) -> str:
    """Return the first numbers of an array."""
    numbers = np.ravel(values).tolist()
    text = ", ".join(f"{x:.4g}" for x in numbers[:12])
    return f"{text}, ..." if len(numbers) > 12 else text
