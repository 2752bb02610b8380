"""From run folders to results: what a report is made from, of a study or of runs put together by hand."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import JsonValue

from esp_cli.defaults import Mode
from esp_cli.files.tables import flat
from esp_cli.policies.curve_statistics import area_under_curve, steps_to_threshold
from esp_cli.policies.evaluation import FinalEvaluation
from esp_cli.policies.statistics import summarise
from esp_cli.reporting.curves import RunCurve, read_curve
from esp_cli.reporting.network_cost import flops_per_action, network_parameters
from esp_cli.reporting.results import CellResult, Passing, Results
from esp_cli.reporting.summary import returns_of
from esp_cli.studies.kinds import kind_of
from esp_cli.studies.paper import reported
from esp_cli.studies.study import Cell, Study, StudyFolder, read_evaluation
from esp_cli.training.folder_names import CONFIG, METRICS
from esp_cli.training.metrics import NoMetricError, read_last_row

_DIGITS = 4
"""Decimals that are kept of a return; the bootstrap and the tables need two."""


@dataclass(frozen=True)
class Material:
    """All that a report is made from.

    Attributes:
        study: what was planned.
        results: what came out.
        curves: by name of the cell, those that have begun.
        runs: run folders by name of the cell.
    """

    study: Study
    results: Results
    curves: Mapping[str, RunCurve]
    runs: Mapping[str, Path]


@dataclass(frozen=True)
class RunState:
    """Where the run of a cell stands.

    Attributes:
        step: environment steps per seed.
        curve: its evaluations, if there are any yet.
        final: the final evaluation of its policy, if there is one.
        at: step at which a run put together with others by hand is compared; None for its final evaluation.
    """

    step: int
    curve: RunCurve | None = None
    final: FinalEvaluation | None = None
    at: int | None = None


def collect(folder: StudyFolder, mode: Mode | None = None, thresholds: Sequence[float] = ()) -> Material:
    """Read the results of a study, finished or not.

    Args:
        folder: of the study.
        mode: which evaluations; by default those that this kind of study reports.
        thresholds: returns whose first passing is looked for; by default those of this kind of study, or that which
            the cell's reference ended with.
    """
    study, kind = folder.study, kind_of(folder.study.kind)
    mode, thresholds = mode or kind.mode, thresholds or kind.thresholds
    states = {}
    for cell in study.cells:
        run = folder.run_path(cell)
        step = int(read_last_row(run / METRICS).get("step", 0))
        final = read_evaluation(run) if folder.is_trained(cell) else None
        states[cell.name] = RunState(step, _read_curve(run, cell, mode), final)
    results = results_of(study, states, mode, thresholds)
    if kind.network_cost:
        cells = []
        for found, config in zip(results.cells, (cell.config for cell in study.cells), strict=True):
            cost = {"parameters": network_parameters(config), "flops_per_action": flops_per_action(config)}
            cells.append(found.model_copy(update=cost))
        results = results.model_copy(update={"cells": tuple(cells)})
    curves = {name: state.curve for name, state in states.items() if state.curve is not None}
    return Material(study, results, curves, {cell.name: folder.run_path(cell) for cell in study.cells})


def results_of(study: Study, states: Mapping[str, RunState], mode: Mode, thresholds: Sequence[float]) -> Results:
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
    timed = [_timed(results, cell, states[cell.name].curve, thresholds) for cell in cells]
    return results.model_copy(update={"cells": tuple(timed)})


def _read_curve(run: Path, cell: Cell, mode: Mode) -> RunCurve | None:
    """Read the evaluations of a cell's run; None where there are none yet."""
    if not (run / CONFIG).is_file() or not (run / METRICS).exists():
        return None
    try:
        return read_curve(run, cell.variant, mode)
    except NoMetricError:  # it has only begun
        return None


def _cell(study: Study, cell: Cell, state: RunState, config: Mapping[str, JsonValue], mode: Mode) -> CellResult:
    curve, final, number = state.curve, state.final, reported(cell.paper)
    found: dict[str, object] = {}
    if curve is not None:
        found["seconds"] = round(curve.seconds, 1)
    compared = curve.until(state.at) if curve is not None and state.at is not None else curve
    if final is not None:
        found |= {
            "esp_version": final.esp_version,
            "task_version": final.task_version,
            "convention": final.convention,
            "returns": {"greedy": _rounded(final.greedy.per_seed), "stochastic": _rounded(final.stochastic.per_seed)},
            "anchors": {name: round(value, _DIGITS) for name, value in final.anchors.items()},
            "metrics": dict(zip(final.metrics, _rounded(final.metrics.values()), strict=True)),
        }
    elif compared is not None and state.at is not None:
        found |= {
            "esp_version": study.esp_version,
            "task_version": compared.spec.version,
            "convention": compared.spec.convention,
            "episodes": cell.config.evaluation.episodes,
            "returns": {mode: _rounded(compared.values[-1])},
        }
    breaks = kind_of(study.kind).breakings
    if curve is not None and breaks and (early := curve.until(cell.config.steps // 5)):
        found["early"] = _rounded(early.values[-1])
    if "returns" in found and compared is not None:
        found["evaluations"] = len(compared.steps)
        if len(compared.steps) > 1:
            found["area_under_curve"] = _rounded(area_under_curve(compared.steps, compared.values))
    return CellResult(
        name=cell.name,
        panel=cell.panel,
        variant=cell.variant,
        reference=cell.reference,
        paper=None if number is None else (number.mean, number.sem),
        status="finished" if "returns" in found else "unfinished" if curve is not None else "not run",
        step=state.step,
        at=state.at,
        steps=cell.config.steps,
        seeds=cell.config.seeds,
        config=dict(config),
        **found,
    )


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
    passed = [(limit, steps_to_threshold(curve.steps, rounded, limit)) for limit in thresholds]
    found = tuple(
        Passing(threshold=round(limit, _DIGITS), of_mean=p.of_mean, per_seed=p.per_seed) for limit, p in passed
    )
    return cell.model_copy(update={"steps_to": found})


def _rounded(values: Iterable[float | None]) -> tuple[float | None, ...]:
    return tuple(None if x is None or not math.isfinite(x) else round(float(x), _DIGITS) for x in values)
