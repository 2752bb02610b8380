"""Several runs side by side: returns at given steps, the way there, and the difference from the first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from esp_cli.evaluation.curve_statistics import area_under_curve, steps_to_threshold
from esp_cli.evaluation.statistics import bootstrap_interval, difference, mean_and_sem, probability_of_improvement
from esp_cli.reporting.plots import Curve, learning_curves
from esp_cli.training.build import build_environment
from esp_cli.training.config import RunConfig
from esp_cli.training.loading import parse_config
from esp_cli.training.metrics import column, read_metrics
from esp_cli.training.run_folder import RunFolder
from esp_envs.spec import TaskSpec

Mode = Literal["greedy", "stochastic"]


@dataclass(frozen=True)
class RunCurve:
    """The evaluations of one run.

    Attributes:
        label: how tables and pictures call it.
        config: what was run.
        steps: [K] environment steps per seed.
        values: [K, S] returns; NaN where a seed stopped.
        seconds: training time so far.
    """

    label: str
    config: RunConfig
    steps: NDArray[np.int64]
    values: NDArray[np.float64]
    seconds: float

    @cached_property
    def spec(self) -> TaskSpec:
        """What the task says of itself, the convention of its returns among it."""
        return build_environment(self.config.model_copy(update={"device": "cpu"}), 1, "shape").spec

    def at(self, step: int) -> NDArray[np.float64] | None:
        """Return the returns [S] of the evaluation nearest to a step, or None where the run did not get there."""
        if step - self.steps[-1] > self.config.evaluation.every_steps:
            return None
        return self.values[int(np.abs(self.steps - step).argmin())]


def read_curve(path: Path, label: str | None, mode: Mode) -> RunCurve:
    """Read the evaluations of a run folder.

    Raises:
        ValueError: no run folder, or no evaluation in it yet.
    """
    folder = RunFolder.open(path)
    rows = read_metrics(folder.metrics_path)
    steps, values = column(rows, f"eval/return_{mode}")
    config = parse_config(folder.config, path)
    if values.shape[1] != len(config.seeds):
        raise ValueError(
            f"{path} is damaged: its metrics have {values.shape[1]} seeds, its configuration {len(config.seeds)}"
        )
    times = (row.get("time/elapsed_s") for row in rows)
    seconds = max((time for time in times if isinstance(time, int | float)), default=0.0)
    return RunCurve(label or path.name, config, steps, values, seconds)


def compare(curves: Sequence[RunCurve], at: Sequence[int], thresholds: Sequence[float]) -> dict[str, Any]:
    """Compare runs of one task.

    Args:
        curves: the runs; the first is the one that the others are held against.
        at: steps at which returns are stated; empty for the last step that all runs reached.
        thresholds: returns whose first passing is stated.

    Returns:
        A JSON-able dict: task, convention, and one entry per run with its returns, differences, steps to thresholds
        and area under the curve.

    Raises:
        ValueError: runs of different tasks or conventions, whose returns do not compare.
    """
    conventions = {(c.config.task, str(sorted(c.config.task_settings.items()))) for c in curves}
    if len(conventions) > 1:
        raise ValueError("these runs have different tasks or task settings, so their returns do not compare")
    at = at or [int(min(curve.steps[-1] for curve in curves))]
    spec = curves[0].spec
    return {
        "task": spec.name,
        "task_version": spec.version,
        "convention": spec.convention,
        "episodes_per_evaluation": min(curve.config.evaluation.episodes for curve in curves),
        "runs": [_entry(curve, curves[0], at, thresholds) for curve in curves],
    }


def _entry(curve: RunCurve, reference: RunCurve, at: Sequence[int], thresholds: Sequence[float]) -> dict[str, Any]:
    entry: dict[str, Any] = {"label": curve.label, "seeds": list(curve.config.seeds), "seconds": curve.seconds}
    entry["returns"] = {str(step): _returns(curve, reference, step) for step in at}
    passed = {str(limit): steps_to_threshold(curve.steps, curve.values, limit) for limit in thresholds}
    entry["steps_to"] = {limit: {"mean": s.of_mean, "per_seed": list(s.per_seed)} for limit, s in passed.items()}
    entry["area_under_curve"] = summarise(area_under_curve(curve.steps, curve.values)) if len(curve.steps) > 1 else None
    return entry | {"config": curve.config.model_dump(mode="json")}


def _returns(curve: RunCurve, reference: RunCurve, step: int) -> dict[str, Any] | None:
    values, others = curve.at(step), reference.at(step)
    if values is None:
        return None
    out = summarise(values)
    if curve is not reference and others is not None:
        out |= versus(values, others, curve.config.seeds == reference.config.seeds) or {}
    return out


def summarise(values: NDArray[np.float64]) -> dict[str, Any]:
    """Summarise one number per seed; seeds that stopped (NaN) are left out and counted."""
    good = values[np.isfinite(values)]
    if not good.size:
        return {"mean": None, "sem": None, "ci95": None, "per_seed": [None] * len(values)}
    mean, sem = mean_and_sem(good)
    per_seed = [float(x) if np.isfinite(x) else None for x in values]
    return {"mean": mean, "sem": sem, "ci95": bootstrap_interval(good), "per_seed": per_seed}


def versus(values: NDArray[np.float64], others: NDArray[np.float64], paired: bool) -> dict[str, Any] | None:
    """Return the difference from another run and the probability of improvement over it.

    None where a seed of either stopped: those that are left are no fair sample.

    Args:
        values: one number per seed [S], NaN where it stopped.
        others: likewise, of the run that it is compared with.
        paired: both have the same seeds.
    """
    if not (np.isfinite(values).all() and np.isfinite(others).all()):
        return None
    gap = difference(values, others, paired)
    chance = probability_of_improvement(values, others, paired)
    return {
        "difference": {"mean": gap.value, "ci95": gap.ci95, "paired": paired},
        "probability_of_improvement": chance.value,
        "probability_of_improvement_ci95": chance.ci95,
    }


def plot(
    curves: Sequence[RunCurve],
    path: Path,
    convention: str,
    mode: Mode,
    references: dict[str, float],
    view: tuple[float, float] | None = None,
) -> tuple[Path, Path]:
    """Draw the learning curves with 95 % bands; returns the PNG and the SVG file.

    `view` is the lowest and the highest return shown, by default all.
    """
    lines = [Curve(curve.label, curve.steps, curve.values) for curve in curves]
    task = curves[0].config.task
    return learning_curves(lines, path, task, f"{mode} return ({convention})", references=references, ylim=view)
