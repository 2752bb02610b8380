"""Results in the JSON form that marl-eval reads: environment -> task -> algorithm -> run -> step -> metric.

The form is that of the tool's public README. It wants the same number of evaluations of every task of an environment,
so the runs of one number of steps are an environment of their own. Each list holds one number, the mean over the
evaluation's episodes; `absolute_metrics` are those of the final evaluation of the trained policy.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from esp_cli.formatting import format_count
from esp_cli.reporting.curves import RunCurve
from esp_cli.studies.study import Cell, Study
from esp_envs.registry import task_class


def marl_eval(study: Study, curves: Mapping[str, RunCurve], results: Mapping[str, Any]) -> dict[str, Any]:
    """Return the finished runs of a study.

    Runs of which a seed stopped are left out, as the tool has no place for them.

    Args:
        study: the runs.
        curves: by name of the cell.
        results: as `results.collect` returns them.
    """
    out: dict[str, Any] = {}
    entries = {entry["name"]: entry for entry in results["cells"]}
    for cell in study.cells:
        entry, curve = entries[cell.name], curves.get(cell.name)
        finals = (entry.get("returns") or {}).get(results["mode"])
        if curve is None or finals is None or not all(map(math.isfinite, curve.values.ravel())) or None in finals:
            continue
        runs = {f"seed_{seed}": _run(curve, k, finals[k]) for k, seed in enumerate(cell.config.seeds)}
        task = "_".join(cell.panel.replace(",", " ").replace("=", " ").split())
        algorithm = "_".join(cell.variant.replace(",", " ").replace("=", " ").split())
        out.setdefault(_environment(cell), {}).setdefault(task, {})[algorithm] = runs
    return out


def _environment(cell: Cell) -> str:
    """Return the family of the task and the number of steps: "mpe_500k"."""
    family = task_class(cell.config.task).__module__.split(".")[1]
    return f"{family}_{format_count(cell.config.steps)}"


def _run(curve: RunCurve, seed: int, final: float) -> dict[str, Any]:
    steps = {
        f"step_{k}": {"step_count": int(step), "return": [float(value)]}
        for k, (step, value) in enumerate(zip(curve.steps, curve.values[:, seed], strict=True), start=1)
    }
    return {**steps, "absolute_metrics": {"return": [float(final)]}}
