"""The evaluations of a run on the way, read from its metrics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from esp_cli.defaults import Mode
from esp_cli.training.build import spec_of
from esp_cli.training.config import RunConfig
from esp_cli.training.config_file import parse_config
from esp_cli.training.folder_names import METRICS
from esp_cli.training.metrics import MetricsError, column, elapsed_s, read_metrics
from esp_cli.training.run_folder import RunFolder
from esp_envs.errors import UserError
from esp_envs.spec import TaskSpec


@dataclass(frozen=True)
class RunCurve:
    """The evaluations of one run."""

    label: str  # its name in tables and pictures
    config: RunConfig  # what was run
    steps: NDArray[np.int64]  # [K] environment steps per seed
    values: NDArray[np.float64]  # [K, S] returns; NaN where a seed stopped
    seconds: float  # training time so far
    path: Path  # the run folder
    trained: int = 0  # environment steps per seed so far, where they are more than those of the last evaluation
    # of the task that it was trained on; None where it is not known, which is that of today
    task_version: int | None = None

    @cached_property
    def spec(self) -> TaskSpec:
        """What the task says of itself, the convention of its returns among it; the version is that of the run."""
        spec = spec_of(self.config.of_one_seed())
        return spec if self.task_version is None else replace(spec, version=self.task_version)

    @property
    def last_step(self) -> int:
        """Step of the last evaluation."""
        return int(self.steps[-1])

    def until(self, step: int) -> RunCurve | None:
        """Return the curve up to the evaluation nearest to a step, or None where the run did not get there."""
        if step > max(self.trained, self.last_step):
            return None
        end = int(np.abs(self.steps - step).argmin()) + 1
        return replace(self, steps=self.steps[:end], values=self.values[:end])


def read_curve(path: Path, label: str | None, mode: Mode) -> RunCurve:
    """Read the evaluations of a run folder.

    Raises:
        UserError: no run folder, or no evaluation in it yet.
    """
    folder = RunFolder.open(path)
    name = path.resolve().name if path.name in ("", "..") else path.name  # a link keeps its own name
    rows = read_metrics(folder.metrics_path)
    curve = curve_of(rows, mode, path, label or name, parse_config(folder.config, path))
    return replace(curve, task_version=folder.task_version())


def curve_of(rows: Sequence[Mapping[str, Any]], mode: Mode, run: Path, label: str, config: RunConfig) -> RunCurve:
    """Return the evaluations among rows of metrics.

    Raises:
        NoMetricError: there is no evaluation yet.
        UserError: the evaluations are damaged, or of other seeds than the configuration.
    """
    try:
        steps, values = column(rows, f"eval/return_{mode}")
    except MetricsError as error:
        raise type(error)(f"{run / METRICS}: {error}") from None
    if values.shape[1] != len(config.seeds):
        raise UserError(
            f"{run} is damaged: its metrics have {values.shape[1]} seeds, its configuration {len(config.seeds)}"
        )
    seconds = max(map(elapsed_s, rows), default=0.0)
    trained = max((row["step"] for row in rows), default=0)
    return RunCurve(label, config, steps, values, seconds, run, trained)
