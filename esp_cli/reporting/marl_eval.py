"""Results in the JSON form that marl-eval reads: environment -> task -> algorithm -> run -> step -> metric.

The form is that of the tool's public README. It wants the same number of evaluations of every task of an environment,
so the runs of one number of steps are an environment of their own. Each list holds one number, the mean over the
evaluation's episodes; `absolute_metrics` are those of the final evaluation of the trained policy.
"""

from __future__ import annotations

import math

from esp_cli.files.formatting import format_count
from esp_cli.reporting.collect import Material
from esp_cli.reporting.curves import RunCurve
from esp_cli.studies.study import Cell
from esp_envs.registry import task_class

SeedRun = dict[str, dict[str, int | list[float]]]
"""Step, or "absolute_metrics" -> metric -> numbers."""
MarlEval = dict[str, dict[str, dict[str, dict[str, SeedRun]]]]
"""Environment -> task -> algorithm -> seed."""


def marl_eval(material: Material) -> MarlEval:
    """Return the finished runs of a study; the tool has no place for those of which a seed stopped."""
    out: MarlEval = {}
    entries = {entry.name: entry for entry in material.results.cells}
    for cell in material.study.cells:
        finals = entries[cell.name].returns.get(material.results.mode, ())
        curve, whole = material.curves.get(cell.name), [x for x in finals if x is not None]
        if curve is None or not whole or len(whole) < len(finals) or not all(map(math.isfinite, curve.values.ravel())):
            continue
        runs = {f"seed_{seed}": _run(curve, k, whole[k]) for k, seed in enumerate(cell.config.seeds)}
        task = "_".join(cell.panel.replace(",", " ").replace("=", " ").split())
        algorithm = "_".join(cell.variant.replace(",", " ").replace("=", " ").split())
        out.setdefault(_environment(cell), {}).setdefault(task, {})[algorithm] = runs
    return out


def _environment(cell: Cell) -> str:
    """Return the family of the task and the number of steps: "mpe_500k"."""
    package, *inner = task_class(cell.config.task).__module__.split(".")
    family = inner[0] if package == "esp_envs" and inner else package
    return f"{family}_{format_count(cell.config.steps)}"


def _run(curve: RunCurve, seed: int, final: float) -> SeedRun:
    steps: SeedRun = {
        f"step_{k}": {"step_count": int(step), "return": [float(value)]}
        for k, (step, value) in enumerate(zip(curve.steps, curve.values[:, seed], strict=True), start=1)
    }
    return {**steps, "absolute_metrics": {"return": [float(final)]}}
