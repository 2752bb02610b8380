"""Results for other programs: every logged number as CSV, and the JSON form that marl-eval reads.

The form of marl-eval is that of the tool's public README: environment -> task -> algorithm -> run -> step -> metric.
It wants the same number of evaluations of every task of an environment, so the runs of one number of steps are an
environment of their own. Each list holds one number, the mean over the evaluation's episodes; `absolute_metrics` are
those of the final evaluation of the trained policy.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from esp_cli.files.formatting import format_count
from esp_cli.files.writing import write_file
from esp_cli.reporting.collect import Material
from esp_cli.reporting.curves import RunCurve
from esp_cli.studies.run_set import Cell
from esp_cli.training.metrics import read_metrics
from esp_cli.training.run_folder import RunFolder
from esp_envs.registry import task_class

_KEYS = ("run", "seed", "step")
SeedRun = dict[str, dict[str, int | list[float]]]  # step, or "absolute_metrics" -> metric -> numbers
MarlEval = dict[str, dict[str, dict[str, dict[str, SeedRun]]]]  # environment -> task -> algorithm -> seed


def write_csv(path: Path, material: Material) -> int:
    """Write the metrics of runs; a cell without a number is empty, a number of the whole run stands with every seed.

    Args:
        path: of the file.
        material: of a study, or of runs, which have their labels as names; runs that have not begun are left out.

    Returns:
        The number of rows.

    Raises:
        UserError: a metrics file is damaged.
    """
    runs = {cell.name if cell.at is None else cell.variant: material.runs[cell.name] for cell in material.results.cells}
    rows = [row for name, folder in runs.items() for row in _rows(name, folder)]
    names = sorted({key for row in rows for key in row} - set(_KEYS))
    text = io.StringIO()
    writer = csv.DictWriter(text, (*_KEYS, *names), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_file(path, text.getvalue().encode())
    return len(rows)


def marl_eval(material: Material) -> MarlEval:
    """Return the finished runs of a study; the tool has no place for those of which a seed stopped."""
    out: MarlEval = {}
    results = {entry.name: entry for entry in material.results.cells}
    for cell in material.study.cells:
        curve, finals = material.curves.get(cell.name), results[cell.name].returns.get(material.results.mode, ())
        whole = [value for value in finals if value is not None]
        if curve is None or not whole or len(whole) < len(finals) or not np.isfinite(curve.values).all():
            continue
        runs = {f"seed_{seed}": _seed_run(curve, k, whole[k]) for k, seed in enumerate(cell.config.seeds)}
        out.setdefault(_environment(cell), {}).setdefault(_key(cell.panel), {})[_key(cell.variant)] = runs
    return out


def _rows(name: str, folder: Path) -> Iterable[dict[str, Any]]:
    opened = RunFolder.open(folder) if folder.is_dir() else None
    if opened is None or not opened.metrics_path.is_file():
        return
    seeds = opened.config["seeds"]
    for row in read_metrics(opened.metrics_path):
        for index, seed in enumerate(seeds):
            cells = {key: _of_seed(value, index) for key, value in row.items() if key != "step"}
            yield {"run": name, "seed": seed, "step": row["step"], **cells}


def _of_seed(value: Any, index: int) -> Any:
    if not isinstance(value, list):
        return value
    return value[index] if index < len(value) else None


def _environment(cell: Cell) -> str:
    """Return the family of the task and the number of steps: "mpe_500k"."""
    package, *inner = task_class(cell.config.task).__module__.split(".")
    family = inner[0] if package == "esp_envs" and inner else package
    return f"{family}_{format_count(cell.config.steps)}"


def _key(text: str) -> str:
    return "_".join(text.replace(",", " ").replace("=", " ").split())


def _seed_run(curve: RunCurve, seed: int, final: float) -> SeedRun:
    steps: SeedRun = {
        f"step_{k}": {"step_count": int(step), "return": [float(value)]}
        for k, (step, value) in enumerate(zip(curve.steps, curve.values[:, seed], strict=True), start=1)
    }
    return {**steps, "absolute_metrics": {"return": [float(final)]}}
