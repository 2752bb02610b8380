"""From run folders to results: what a report is made from, of a study or of runs put together by hand."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from esp_cli.defaults import Mode
from esp_cli.files.documents import flat
from esp_cli.files.formatting import format_exactly, name_of
from esp_cli.policies.evaluation import FinalEvaluation, blind_anchor
from esp_cli.policies.statistics import Passing, area_under_curve, steps_to_threshold
from esp_cli.reporting.results import CellResult, Results, returns_of, summarised
from esp_cli.studies.kinds import kind_of
from esp_cli.studies.paper import reported
from esp_cli.studies.plan import Cell, Study
from esp_cli.studies.study import StudyFolder
from esp_cli.training.build import spec_of
from esp_cli.training.config import RunConfig
from esp_cli.training.folder_names import CONFIG, METRICS
from esp_cli.training.metrics import column, elapsed_s, read_last_row, read_metrics
from esp_cli.training.run_folder import RunFolder
from esp_cli.training.settings import parse_config
from esp_envs.errors import UserError
from esp_envs.spec import TaskSpec

_LIKE = 0.1  # of the steps trained, by which evaluations that are compared may lie apart


@dataclass(frozen=True)
class RunCurve:
    """The evaluations of one run on the way."""

    label: str  # its name in tables and pictures
    config: RunConfig  # what was run
    steps: NDArray[np.int64]  # [K] environment steps per seed
    values: NDArray[np.float64]  # [K, S] returns; NaN where a seed stopped
    seconds: float  # training time so far
    path: Path  # the run folder
    trained: int = 0  # environment steps per seed so far, where they are more than those of the last evaluation
    task_version: int | None = None  # of the task that it was trained on; None where it is not known: that of today

    @cached_property
    def spec(self) -> TaskSpec:
        """What the task says of itself, the convention of its returns among it; the version is that of the run."""
        spec = spec_of(self.config.of_one_seed())
        return spec if self.task_version is None else replace(spec, version=self.task_version)

    @property
    def last_step(self) -> int:
        return int(self.steps[-1])

    def until(self, step: int) -> RunCurve | None:
        """Return the curve up to the evaluation nearest to a step, or None where the run did not get there."""
        if step > max(self.trained, self.last_step):
            return None
        end = int(np.abs(self.steps - step).argmin()) + 1
        return replace(self, steps=self.steps[:end], values=self.values[:end])


def read_curve(path: Path, label: str | None, mode: Mode) -> RunCurve:
    """Read the evaluations of a run folder, which has to have one."""
    folder = RunFolder.open(path)
    rows = read_metrics(folder.metrics_path)
    curve = _curve(rows, mode, path, label or name_of(path), parse_config(folder.config, path))
    return replace(curve, task_version=folder.task_version())


def begun_curve(run: Path, cell: Cell, mode: Mode) -> RunCurve | None:
    """Read the evaluations of a run of a study; None where there is none yet."""
    rows = read_metrics(run / METRICS) if (run / METRICS).exists() else []
    begun = any(f"eval/return_{mode}" in row for row in rows)
    return _curve(rows, mode, run, cell.variant, cell.config) if begun else None


def _curve(rows: Sequence[Mapping[str, Any]], mode: Mode, run: Path, label: str, config: RunConfig) -> RunCurve:
    try:
        steps, values = column(rows, f"eval/return_{mode}")
    except UserError as error:
        raise UserError(f"{run / METRICS}: {error}") from None
    if values.shape[1] != len(config.seeds):
        raise UserError(
            f"{run} is damaged: its metrics have {values.shape[1]} seeds, its configuration {len(config.seeds)}"
        )
    trained = max((row["step"] for row in rows), default=0)
    return RunCurve(label, config, steps, values, max(map(elapsed_s, rows), default=0.0), run, trained)


@dataclass(frozen=True)
class Material:
    """All that a report is made from."""

    study: Study  # what was planned
    results: Results  # what came out, with its statistics
    curves: Mapping[str, RunCurve]  # by name of the cell, those that have begun
    runs: Mapping[str, Path]  # run folders by name of the cell


@dataclass(frozen=True)
class _State:
    step: int  # environment steps per seed
    curve: RunCurve | None = None  # its evaluations, if there are any yet
    final: FinalEvaluation | None = None  # of its policy, if there is one
    stopped: bool = False  # whether it ended without a policy, since every seed stopped
    at: int | None = None  # step at which runs put together by hand are compared; None for the final evaluation
    floor: Mapping[str, float] = field(default_factory=dict)  # their anchor: what a policy that sees nothing reaches


def collect_study(folder: StudyFolder, mode: Mode | None = None, thresholds: Sequence[float] = ()) -> Material:
    """Read the results of a study, finished or not; mode and thresholds are by default those of its kind."""
    study, kind = folder.study, kind_of(folder.study.kind)
    mode = mode or kind.mode
    states = {cell.name: _state(folder, cell, mode) for cell in study.cells}
    curves = {name: state.curve for name, state in states.items() if state.curve is not None}
    runs = {cell.name: folder.run_path(cell) for cell in study.cells}
    return Material(study, _results(study, states, mode, thresholds or kind.thresholds), curves, runs)


def collect_runs(
    curves: Sequence[RunCurve], command: str, mode: Mode, at: Sequence[int] = (), thresholds: Sequence[float] = ()
) -> Material:
    """Return runs of one task as a study whose panels are the steps at which they are compared."""
    _refuse_unlike(curves)
    at = _compared_at(curves, at)
    curves = [_thinned(curve, at, max(map(_apart, curves))) for curve in curves]
    first, *_ = curves
    floor = blind_anchor(first.config, first.spec.version) if len(curves) > 1 else {}
    cells, states, by_name = [], {}, {}
    for step in at:
        for k, curve in enumerate(curves):
            name, reference = f"{k}-{curve.label}-{step}", f"0-{first.label}-{step}" if k else None
            panel = f"{curve.config.task}, {format_exactly(step)}"
            cells.append(Cell(name=name, panel=panel, variant=curve.label, config=curve.config, reference=reference))
            states[name], by_name[name] = _State(curve.last_step, curve, at=step, floor=floor), curve
    study = Study(
        kind="runs",
        title=f"{' and '.join(curve.label for curve in curves)} on {first.config.task}",
        command=command,
        episodes=first.config.evaluation.episodes,
        rows="variants",
        cells=tuple(cells),
    )
    runs = {name: curve.path for name, curve in by_name.items()}
    return Material(study, _results(study, states, mode, thresholds), by_name, runs)


def _apart(curve: RunCurve) -> float:
    """Return how many steps lie between evaluations, at most."""
    return float(np.diff(curve.steps).max()) if len(curve.steps) > 1 else 0.0


def _thinned(curve: RunCurve, at: Sequence[int], apart: float) -> RunCurve:
    """Return a curve without evaluations that others lack: who is looked at more often seems to be there sooner."""
    if _apart(curve) >= (1 - _LIKE) * apart:
        return curve
    marks = np.r_[np.arange(0, curve.last_step + 1, apart), at, curve.last_step]
    kept = np.unique(np.abs(curve.steps[:, None] - marks).argmin(0))
    return replace(curve, steps=curve.steps[kept], values=curve.values[kept])


def _compared_at(curves: Sequence[RunCurve], at: Sequence[int]) -> tuple[int, ...]:
    """Return the steps at which runs are compared, by default the last at which all of them were evaluated."""
    for step in at:
        if not any(curve.until(step) for curve in curves):
            raise UserError(
                f"none of these runs got to step {format_exactly(step)}: {_evaluated(curves)}; give an earlier --at"
            )
        if not _alike(curves, step):
            raise UserError(
                f"these runs were not evaluated at like steps near {format_exactly(step)}: {_evaluated(curves)}; "
                "give an --at near which all were evaluated"
            )
    if at:
        return tuple(dict.fromkeys(at))
    last = min(curve.last_step for curve in curves)
    steps = sorted({int(step) for curve in curves for step in curve.steps if 0 < step <= last}, reverse=True) or [last]
    found = next((step for step in steps if _alike(curves, step)), None)
    if found is None:
        raise UserError(
            f"these runs were evaluated at no like steps: {_evaluated(curves)}; train them with the same "
            "evaluation.every_steps"
        )
    return (found,)


def _alike(curves: Sequence[RunCurve], step: int) -> bool:
    """Whether the evaluations nearest to a step, of the runs that got there, are about as far on as it is."""
    ends = [step, *(reached.last_step for curve in curves if (reached := curve.until(step)) is not None)]
    return max(ends) - min(ends) <= _LIKE * max(ends)


def _evaluated(curves: Sequence[RunCurve]) -> str:
    steps = {c.label: [format_exactly(int(step)) for step in c.steps] for c in curves}
    few = {label: own if len(own) <= 4 else [*own[:2], "...", own[-1]] for label, own in steps.items()}
    return "; ".join(f"{label} at {', '.join(own)}" for label, own in few.items())


def _refuse_unlike(curves: Sequence[RunCurve]) -> None:
    """Refuse runs that no table can hold side by side."""
    labels = [curve.label for curve in curves]
    twice = next((label for label in labels if labels.count(label) > 1), None)
    if twice is not None:
        raise UserError(f"two runs are called '{twice}'; give each a label of its own, as in plain={curves[0].path}")
    if len({(c.config.task, str(sorted(c.config.task_settings.items()))) for c in curves}) > 1:
        raise UserError("these runs have different tasks or task settings, so their returns do not compare")
    versions = sorted({curve.spec.version for curve in curves})
    if len(versions) > 1:
        raise UserError(
            f"these runs were trained on versions {' and '.join(map(str, versions))} of {curves[0].config.task}, in "
            "which observations, actions or rewards differ, so their returns do not compare; train the older ones again"
        )


def _state(folder: StudyFolder, cell: Cell, mode: Mode) -> _State:
    run = folder.run_path(cell)
    if (run / CONFIG).is_file() and not folder.is_own(cell):
        raise UserError(f"{run} does not fit its study: its {CONFIG} is that of another run, or damaged")
    curve = begun_curve(run, cell, mode)
    step = curve.trained if curve else read_last_row(run / METRICS).get("step", 0)
    return _State(step, curve, folder.evaluation(cell) if folder.is_trained(cell) else None, folder.has_stopped(cell))


def _results(study: Study, states: Mapping[str, _State], mode: Mode, thresholds: Sequence[float]) -> Results:
    configs = {cell.name: dict(flat(cell.config.model_dump(mode="json"))) for cell in study.cells}
    first = next(iter(configs.values()))
    shared = {key: value for key, value in first.items() if all(c.get(key, ...) == value for c in configs.values())}
    own = {name: {key: config[key] for key in config if key not in shared} for name, config in configs.items()}
    cells = [_cell(study, cell, states[cell.name], mode, own[cell.name]) for cell in study.cells]
    ended = {cell.name: float(found.mean()) for cell in cells if (found := returns_of(cell, mode)) is not None}
    for k, cell in enumerate(cells):
        last = ended.get(cell.reference or cell.name, math.nan) if cell.name in ended else math.nan
        limits = thresholds or ([last] if math.isfinite(last) else [])  # not of the seeds beside one that stopped
        cells[k] = cell.model_copy(update={"steps_to": _passings(states[cell.name].curve, limits)})
    return summarised(Results(**study.model_dump(exclude={"cells"}), mode=mode, config=shared, cells=tuple(cells)))


def _cell(study: Study, cell: Cell, state: _State, mode: Mode, config: Mapping[str, Any]) -> CellResult:
    curve, kind, final = state.curve, kind_of(study.kind), state.final
    compared = curve.until(state.at) if curve is not None and state.at is not None else curve
    anchors = {name: _short(value) for name, value in (final.anchors if final else state.floor).items()}
    fields: dict[str, Any] = {}
    if final is not None:
        fields = {
            "esp_version": final.esp_version,
            "task_version": final.task_version,
            "convention": final.convention,
            "returns": {"greedy": _rounded(final.greedy.per_seed), "stochastic": _rounded(final.stochastic.per_seed)},
            "anchors": anchors,
            "roles": final.roles,
            "metrics": dict(zip(final.metrics, _rounded(final.metrics.values()), strict=True)),
        }
        if kind.network_cost:
            fields |= {"parameters": final.parameters, "flops_per_action": final.flops_per_action}
    elif compared is not None and state.stopped:
        none = (None,) * len(cell.config.seeds)
        fields = {"convention": compared.spec.convention, "returns": {"greedy": none, "stochastic": none}}
    elif compared is not None and state.at is not None:
        fields = {
            "esp_version": study.esp_version,
            "task_version": compared.spec.version,
            "convention": compared.spec.convention,
            "episodes": cell.config.evaluation.episodes,
            "returns": {mode: _rounded(compared.values[-1])},
            "anchors": anchors,
        }
    status = "finished" if fields else "unfinished" if curve is not None else "not run"
    if fields and compared is not None:
        fields["evaluations"] = len(compared.steps)
        if len(compared.steps) > 1:
            fields["area_under_curve"] = _rounded(area_under_curve(compared.steps, compared.values))
    if curve is not None:
        fields["seconds"] = round(curve.seconds, 1)
        if (kind.breakings or kind.benchmark) and (early := curve.until(cell.config.steps // 5)):
            fields["early"] = _rounded(early.values[-1])
    fields |= cell.model_dump(exclude={"config"}) | {"paper": reported(cell.paper), "status": status, "config": config}
    fields |= {"step": state.step, "at": state.at, "steps": cell.config.steps, "seeds": cell.config.seeds}
    return CellResult(**fields)


def _passings(curve: RunCurve | None, thresholds: Sequence[float]) -> tuple[Passing, ...]:
    """Return the first steps of a curve at thresholds."""
    if curve is None:
        return ()
    rounded = np.vectorize(_short, otypes=[float])(curve.values)  # as the returns are, from which thresholds are taken
    return tuple(replace(steps_to_threshold(curve.steps, rounded, x), threshold=_short(x)) for x in thresholds)


def _rounded(values: Iterable[float | None]) -> tuple[float | None, ...]:
    return tuple(None if x is None or not math.isfinite(x) else _short(x) for x in values)


def _short(value: float) -> float:
    return float(f"{value:.9g}")  # of any scale; float32, in which returns are summed, has no more digits
