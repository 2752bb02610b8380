"""From run folders to results: what a report is made from, of a study or of runs put together by hand."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import JsonValue

from esp_cli.defaults import Mode
from esp_cli.files.documents import flat
from esp_cli.files.formatting import format_exactly
from esp_cli.policies.evaluation import FinalEvaluation
from esp_cli.policies.statistics import area_under_curve, steps_to_threshold, summarise
from esp_cli.reporting.curves import RunCurve, curve_of
from esp_cli.reporting.results import CellResult, Results
from esp_cli.reporting.summary import returns_of, summarised
from esp_cli.studies.kinds import kind_of
from esp_cli.studies.paper import reported
from esp_cli.studies.run_set import Cell
from esp_cli.studies.study import Study, StudyFolder, read_evaluation
from esp_cli.training.folder_names import METRICS
from esp_cli.training.metrics import NoMetricError, read_metrics
from esp_envs.errors import UserError

_DIGITS = 4  # decimals that are kept of a return; the bootstrap and the tables need two


@dataclass(frozen=True)
class Material:
    """All that a report is made from."""

    study: Study  # what was planned
    results: Results  # what came out, with its statistics
    curves: Mapping[str, RunCurve]  # by name of the cell, those that have begun
    runs: Mapping[str, Path]  # run folders by name of the cell


@dataclass(frozen=True)
class RunState:
    """Where the run of a cell stands."""

    step: int  # environment steps per seed
    curve: RunCurve | None = None  # its evaluations, if there are any yet
    final: FinalEvaluation | None = None  # the final evaluation of its policy, if there is one
    # step at which a run put together with others by hand is compared; None for its final evaluation
    at: int | None = None


def collect_study(folder: StudyFolder, mode: Mode | None = None, thresholds: Sequence[float] = ()) -> Material:
    """Read the results of a study, finished or not.

    Args:
        folder: of the study.
        mode: which evaluations; by default those that this kind of study reports.
        thresholds: returns whose first passing is looked for; by default those of this kind of study, or that which
            the cell's reference ended with.

    Raises:
        UserError: metrics or an evaluation are damaged, or have other seeds than the study.
    """
    study, kind = folder.study, kind_of(folder.study.kind)
    runs = {cell.name: folder.run_path(cell) for cell in study.cells}
    mode = mode or kind.mode
    states = {cell.name: _state(folder, cell, mode) for cell in study.cells}
    curves = {name: state.curve for name, state in states.items() if state.curve is not None}
    return Material(study, _results(study, states, mode, thresholds or kind.thresholds), curves, runs)


def collect_runs(
    curves: Sequence[RunCurve], command: str, mode: Mode, at: Sequence[int] = (), thresholds: Sequence[float] = ()
) -> Material:
    """Return runs of one task as a study whose panels are the steps at which they are compared.

    Args:
        curves: of the runs; the others are compared with the first.
        command: that reports them again.
        mode: which evaluations.
        at: steps at which the runs are compared; by default the last step that all of them have reached.
        thresholds: returns whose first passing is stated.

    Raises:
        UserError: a label twice, or runs of different tasks, versions or settings of the task, whose returns do not
            compare.
    """
    _refuse_unlike(curves)
    first, *_ = curves
    steps = tuple(dict.fromkeys(at)) or (min(curve.last_step for curve in curves),)
    cells, states, by_name = [], {}, {}
    for step in steps:
        for k, curve in enumerate(curves):
            name, reference = f"{k}-{curve.label}-{step}", f"0-{first.label}-{step}" if k else None
            panel = f"{curve.config.task}, {format_exactly(step)}"
            cells.append(Cell(name=name, panel=panel, variant=curve.label, config=curve.config, reference=reference))
            states[name] = RunState(curve.last_step, curve, at=step)
            by_name[name] = curve
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


def _state(folder: StudyFolder, cell: Cell, mode: Mode) -> RunState:
    """Read where the run of a cell stands."""
    run, final = folder.run_path(cell), None
    rows = read_metrics(run / METRICS) if (run / METRICS).exists() else []
    if folder.is_trained(cell) and (final := read_evaluation(run)) is not None:
        wanted = len(cell.config.seeds)
        if any(len(returns.per_seed) != wanted for returns in (final.greedy, final.stochastic)):
            raise UserError(f"{run} does not fit its study: its final evaluation has not the {wanted} seeds of the run")
    try:
        curve = curve_of(rows, mode, run, cell.variant, cell.config)
    except NoMetricError:  # it has only begun
        curve = None
    return RunState(rows[-1]["step"] if rows else 0, curve, final)


def _results(study: Study, states: Mapping[str, RunState], mode: Mode, thresholds: Sequence[float]) -> Results:
    """Return the results of a study whose runs stand where these states say."""
    configs = {cell.name: dict(flat(cell.config.model_dump(mode="json"))) for cell in study.cells}
    first = next(iter(configs.values()))
    shared = {key: value for key, value in first.items() if all(c.get(key, ...) == value for c in configs.values())}
    cells = []
    for cell in study.cells:
        own = {key: value for key, value in configs[cell.name].items() if key not in shared}
        cells.append(_cell(study, cell, states[cell.name], own, mode))
    results = Results(
        kind=study.kind,
        title=study.title,
        command=study.command,
        esp_version=study.esp_version,
        mode=mode,
        rows=study.rows,
        episodes=study.episodes,
        config=shared,
        cells=tuple(cells),
    )
    timed = tuple(_timed(results, cell, states[cell.name].curve, thresholds) for cell in cells)
    return summarised(results.model_copy(update={"cells": timed}))


def _cell(study: Study, cell: Cell, state: RunState, config: Mapping[str, JsonValue], mode: Mode) -> CellResult:
    curve, number, kind = state.curve, reported(cell.paper), kind_of(study.kind)
    compared = curve.until(state.at) if curve is not None and state.at is not None else curve
    fields = _returns(study, cell, state, compared, mode)
    if curve is not None:
        fields["seconds"] = round(curve.seconds, 1)
        if kind.breakings and (early := curve.until(cell.config.steps // 5)):
            fields["early"] = _rounded(early.values[-1])
    if "returns" in fields and compared is not None:
        fields["evaluations"] = len(compared.steps)
        if len(compared.steps) > 1:
            fields["area_under_curve"] = _rounded(area_under_curve(compared.steps, compared.values))
    if kind.network_cost and state.final is not None:
        fields |= {"parameters": state.final.parameters, "flops_per_action": state.final.flops_per_action}
    return CellResult(
        name=cell.name,
        panel=cell.panel,
        variant=cell.variant,
        reference=cell.reference,
        paper=None if number is None else (number.mean, number.sem),
        status="finished" if "returns" in fields else "unfinished" if curve is not None else "not run",
        step=state.step,
        at=state.at,
        steps=cell.config.steps,
        seeds=cell.config.seeds,
        config=dict(config),
        **fields,
    )


def _returns(study: Study, cell: Cell, state: RunState, compared: RunCurve | None, mode: Mode) -> dict[str, object]:
    """Return the fields of a cell whose returns are known: by its final evaluation, or at the step of comparison."""
    if (final := state.final) is not None:
        return {
            "esp_version": final.esp_version,
            "task_version": final.task_version,
            "convention": final.convention,
            "returns": {"greedy": _rounded(final.greedy.per_seed), "stochastic": _rounded(final.stochastic.per_seed)},
            "anchors": {name: round(value, _DIGITS) for name, value in final.anchors.items()},
            "metrics": dict(zip(final.metrics, _rounded(final.metrics.values()), strict=True)),
        }
    if compared is None or state.at is None:
        return {}
    return {
        "esp_version": study.esp_version,
        "task_version": compared.spec.version,
        "convention": compared.spec.convention,
        "episodes": cell.config.evaluation.episodes,
        "returns": {mode: _rounded(compared.values[-1])},
    }


def _timed(results: Results, cell: CellResult, curve: RunCurve | None, thresholds: Sequence[float]) -> CellResult:
    """Return a cell with the first steps at thresholds, by default at what its reference ended with."""
    if curve is None or (not thresholds and cell.status != "finished"):
        return cell
    if not thresholds:
        other = results.reference_of(cell)
        values = returns_of(cell if other is None or not other.returns else other, results.mode)
        mean = None if values is None else summarise(values).mean
        thresholds = [] if mean is None else [mean]
    rounded = np.round(curve.values, _DIGITS)  # as the returns are, from which thresholds are taken
    passings = [steps_to_threshold(curve.steps, rounded, limit) for limit in thresholds]
    stated = tuple(replace(passing, threshold=round(passing.threshold, _DIGITS)) for passing in passings)
    return cell.model_copy(update={"steps_to": stated})


def _rounded(values: Iterable[float | None]) -> tuple[float | None, ...]:
    return tuple(None if x is None or not math.isfinite(x) else round(float(x), _DIGITS) for x in values)
