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
_MOST_ROWS = 16
"""Actions beyond which the README leaves the list to `policy.json`."""
_MASKED = "A mask says which actions are allowed: action_mask, in C allowed. Where none is allowed, all are."


def describe(alone: TrainedPolicy, program: Program, sample: Sample) -> dict[str, Any]:
    """Return what `policy.json` holds.

    Args:
        alone: one seed's policy.
        program: the same as plain arrays.
        sample: of what it does; its first row (of a team its first world), with empty memory, is the worked example.
    """
    config, spec = alone.config, alone.spec
    first = slice(program.team) if program.team > 1 else 0
    # What builds observations from poses knows no compass.
    robot = {} if config.prior.effective().compass else task_class(config.task).robot
    std = {}
    if isinstance(alone.policy.head, BoundedGaussian):
        head = alone.policy.head
        std = {"latent_std": head.log_std[0].exp()[head.item].tolist()}
    return {
        "format": EXPORT_FORMAT,
        "version": EXPORT_VERSION,
        "esp_version": __version__,
        "task": {
            "name": spec.name,
            "version": spec.version,
            "convention": spec.convention,
            "num_agents": spec.num_agents,
            "control_period_s": spec.control_period_s,
            "settings": spec.settings,
        },
        "policy": {
            "algorithm": config.algorithm,
            "prior": config.prior.kind,
            "seed": config.seeds[0],
            "step": alone.step,
            "network": program.describe(),
            "parameters": program.num_parameters,
            "flops_per_action": program.flops,
            **std,
        },
        **({"robot": dict(robot)} if robot else {}),
        "observation": _rows(spec.observation),
        "action": _action(spec),
        "memory": {"hidden": program.hidden, "previous_action": program.previous},
        "example": {
            "observation": sample.obs[first].tolist(),
            "memory": sample.memory[first].tolist(),
            **({} if sample.mask is None else {"action_mask": sample.mask[first].tolist()}),
            "outputs": sample.outputs[first].tolist(),
            "action": sample.action[first].tolist(),
            "memory_after": sample.after[first].tolist(),
        },
    }


def _rows(layout: Layout) -> list[dict[str, str]]:
    return [dict(zip(("index", "field", "kind", "unit"), row, strict=True)) for row in layout.table()]


def _action(spec: TaskSpec) -> dict[str, Any]:
    if isinstance(spec.action, Discrete):
        points = zip(spec.action.names, spec.action.points, strict=True)
        options = [{"index": k, "name": name, "means": list(point)} for k, (name, point) in enumerate(points)]
        return {"choose": spec.action.kind.name, "options": options}
    return {"bounds": [-1.0, 1.0], "fields": _rows(spec.action.layout)}


def title(alone: TrainedPolicy) -> str:
    """Return what the policy is in a line."""
    config = alone.config
    prior = "without prior" if config.prior.kind == "none" else f"with the prior {config.prior.kind}"
    return (
        f"{config.task} version {alone.spec.version}: greedy policy of {config.algorithm} {prior}, seed "
        f"{config.seeds[0]}, {alone.step} environment steps"
    )


def summary(alone: TrainedPolicy, program: Program) -> str:
    """Return title, layouts and memory as plain lines, for the top of a source file."""
    spec = alone.spec
    lines = [f"{title(alone)}.", f"Written by esp {__version__}.", "", "Observation of one agent (float32):"]
    lines += [f"  {span:>7}  {name}: {kind}{_unit(unit)}" for span, name, kind, unit in spec.observation.table()]
    lines += [_together(program.team)] if program.team > 1 else []
    lines.append("Action of one agent:")
    if isinstance(spec.action, Discrete):
        lines.append(f"  the index of one of {spec.action.count} options, each a {spec.action.kind.name}:")
        shown = list(describe_action(spec.action))
        lines += [f"  {name}: {means}" for name, means in shown[:_MOST_ROWS]]
        lines += ["  ... (the rest is in policy.json)"] if len(shown) > _MOST_ROWS else []
        lines += [_MASKED] if program.masked else []
    else:
        lines += [f"  {span:>7}  {name}: {kind}{_unit(unit)}" for span, name, kind, unit in spec.action.layout.table()]
        lines.append("  each number in [-1, 1], planar vectors in the unit disc")
    lines.append(f"One action every {spec.control_period_s:g} s.")
    if program.memory_width:
        lines.append(f"Memory of one agent: {program.memory_width} numbers, zeros when an episode begins.")
    return "\n".join(lines)


def _together(team: int) -> str:
    return f"The {team} agents of a world exchange messages and act together: their rows are adjacent."


def _unit(unit: str) -> str:
    return f" ({unit})" if unit else ""


def readme(alone: TrainedPolicy, description: dict[str, Any], sections: list[str]) -> str:
    """Return the README of an export.

    Args:
        alone: one seed's policy.
        description: of `describe`.
        sections: one for each format, with its own heading.
    """
    spec, example = alone.spec, description["example"]
    lines = [f"# {title(alone)}", "", f"Reward convention: {spec.convention}. Written by esp {__version__}.", ""]
    lines += ["## Observation of one agent", "", "| index | field | kind | unit |", "|---|---|---|---|"]
    lines += [f"| {' | '.join(row)} |" for row in spec.observation.table()]
    lines += ["", "The frame is the world's: x to the right, y up, angles counter-clockwise in radians.", ""]
    lines += [_together(alone.policy.actor.team), ""] if alone.policy.actor.team > 1 else []
    lines += ["## Action", ""]
    if isinstance(spec.action, Discrete):
        shown = list(describe_action(spec.action))
        lines += [f"The index of one option; each means a {spec.action.kind.name}.", ""]
        lines += ["| option | means |", "|---|---|", *(f"| {name} | {means} |" for name, means in shown[:_MOST_ROWS])]
        lines += ["", f"All {len(shown)} are in `policy.json`."] if len(shown) > _MOST_ROWS else []
        lines += ["", _MASKED] if spec.masks else []
    else:
        lines += ["Numbers in [-1, 1], planar vectors in the unit disc.", "", "| index | field | kind | unit |"]
        lines += ["|---|---|---|---|", *(f"| {' | '.join(row)} |" for row in spec.action.layout.table())]
    lines += ["", f"One action every {spec.control_period_s:g} s, the best one: exports do not explore.", ""]
    if description["memory"]["hidden"]:
        width = description["memory"]["hidden"] + description["memory"]["previous_action"]
        lines += [f"The policy remembers: {width} numbers an agent, zeros when an episode begins.", ""]
    lines += ["## Worked example", "", "| | |", "|---|---|"]
    names = [name for name in example if not name.startswith("memory")]
    lines += [f"| {name} | {_shortly(example[name])} |" for name in names]
    lines += [
        "",
        "`policy.json` has it in full" + (", with the memory." if alone.policy.actor.memory_width else "."),
        "",
    ]
    return "\n".join([*lines, *sections])


def _shortly(values: Any) -> str:
    numbers = np.ravel(values).tolist()
    text = ", ".join(f"{x:.4g}" for x in numbers[:12])
    return f"{text}, ..." if len(numbers) > 12 else text
