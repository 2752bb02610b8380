"""The results of a study as one small JSON: per cell every seed's numbers, the configuration and version behind them.

Everything that tables state is computed from this file by `verdict` and `aggregates`, so that whoever has the file can
compute the tables again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from esp_cli.evaluation.curve_statistics import area_under_curve, steps_to_threshold
from esp_cli.evaluation.final import FinalEvaluation
from esp_cli.evaluation.statistics import (
    Estimate,
    aggregate,
    average_improvement,
    interquartile_mean,
    leader,
    normalise,
)
from esp_cli.reporting.curves import Mode, RunCurve, read_curve, summarise, versus
from esp_cli.studies.paper import NUM_SEEDS, reported
from esp_cli.studies.study import Cell, Study, StudyFolder, read_evaluation
from esp_cli.training.metrics import MetricsError, read_last_row

RESULTS_FORMAT = "esp-results"
RESULTS_VERSION = 1
_DIGITS = 4
"""Decimals that are kept of a return; the bootstrap and the tables need two."""


def collect(folder: StudyFolder, mode: Mode = "greedy", thresholds: Sequence[float] = ()) -> dict[str, Any]:
    """Read the results of a study, finished or not.

    Args:
        folder: of the study.
        mode: which evaluations.
        thresholds: returns whose first passing is looked for; by default that where the cell's reference ended.

    Returns:
        A JSON-able dict, see the module; `cells` in the study's order.
    """
    study = folder.study
    curves = {cell.name: read_curve_of(folder.run_path(cell), cell, mode) for cell in study.cells}
    judged = {cell.name: read_evaluation(folder.run_path(cell)) for cell in study.cells if folder.is_finished(cell)}
    steps = {
        cell.name: int(read_last_row(folder.run_path(cell) / "metrics.jsonl").get("step", 0)) for cell in study.cells
    }
    return _results(study, curves, judged, steps, mode, thresholds)


def of_runs(study: Study, curves: Mapping[str, RunCurve], mode: Mode, thresholds: Sequence[float]) -> dict[str, Any]:
    """Return the results of runs put together by hand; those that were not judged stand with their last evaluation."""
    steps = {name: int(curve.steps[-1]) for name, curve in curves.items()}
    return _results(study, curves, {}, steps, mode, thresholds)


def read_results(path: Path) -> dict[str, Any]:
    """Read a results file.

    Raises:
        ValueError: it is missing, damaged, foreign, or of a newer version.
    """
    try:
        found = json.loads(path.read_bytes())
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror or error}") from None
    except (ValueError, RecursionError):
        raise ValueError(f"{path} is damaged: it is not JSON") from None
    if not isinstance(found, dict) or found.get("format") != RESULTS_FORMAT:
        raise ValueError(f"{path} holds no results of a study; write some with esp report STUDY --results {path}")
    if found.get("version") != RESULTS_VERSION:
        raise ValueError(f"{path} was written by another version of esp; write it anew with esp report STUDY --results")
    return found


def join(several: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the results of studies of one kind as those of one study, the cells in their order.

    Raises:
        ValueError: kinds or evaluations that do not go together, or a cell that two of them have.
    """
    first = several[0]
    if any(results[key] != first[key] for results in several for key in ("kind", "mode", "rows")):
        raise ValueError("results of studies of different kinds, or of different evaluations, have no table in common")
    cells = [
        cell | {"config": results["config"] | cell["config"], "episodes": cell.get("episodes", results["episodes"])}
        for results in several
        for cell in results["cells"]
    ]
    names = [cell["name"] for cell in cells]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"{twice[0]} stands in two of the results files")
    commands = "\n".join(dict.fromkeys(results["command"] for results in several))
    return dict(first) | {"command": commands, "config": {}, "cells": cells}


def read_curve_of(run: Path, cell: Cell, mode: Mode) -> RunCurve | None:
    """Read the evaluations of a cell's run; None where there are none yet."""
    if not (run / "config.json").is_file():
        return None
    try:
        return read_curve(run, cell.variant, mode)
    except MetricsError:  # it has only begun
        return None


def _results(
    study: Study,
    curves: Mapping[str, RunCurve | None],
    judged: Mapping[str, FinalEvaluation | None],
    steps: Mapping[str, int],
    mode: Mode,
    thresholds: Sequence[float],
) -> dict[str, Any]:
    configs = {cell.name: flat(cell.config.model_dump(mode="json")) for cell in study.cells}
    first = next(iter(configs.values()))
    shared = {key: value for key, value in first.items() if all(c.get(key, ...) == value for c in configs.values())}
    cells = []
    for cell in study.cells:
        curve, verdicts = curves.get(cell.name), judged.get(cell.name)
        entry: dict[str, Any] = {
            "name": cell.name,
            "panel": cell.panel,
            "variant": cell.variant,
            "reference": cell.reference,
            "paper": _paper(cell),
            "status": "finished" if verdicts or study.kind == "runs" else "unfinished" if curve else "not run",
            "step": steps[cell.name],
            "steps": cell.config.steps,
            "seeds": list(cell.config.seeds),
            "config": {key: value for key, value in configs[cell.name].items() if key not in shared},
        }
        cells.append(entry)
        if curve is not None:
            entry["seconds"] = round(curve.seconds, 1)
        if verdicts is not None:
            entry |= _judged(verdicts)
        elif curve is not None and study.kind == "runs":
            entry |= {"esp_version": study.esp_version} | _last_evaluation(curve, mode)
    results = {
        "format": RESULTS_FORMAT,
        "version": RESULTS_VERSION,
        "kind": study.kind,
        "title": study.title,
        "command": study.command,
        "esp_version": study.esp_version,
        "mode": mode,
        "rows": study.rows,
        "episodes": study.episodes,
        "config": shared,
        "cells": cells,
    }
    for entry in cells:
        curve = curves.get(entry["name"])
        if curve is not None and entry["status"] == "finished":
            entry.update(_way_there(curve, thresholds or _reference_level(results, entry)))
    return results


def _judged(found: FinalEvaluation) -> dict[str, Any]:
    """Return what a final evaluation says, small enough to be kept."""
    return {
        "esp_version": found.esp_version,
        "task_version": found.task_version,
        "convention": found.convention,
        "returns": {"greedy": _rounded(found.greedy.per_seed), "stochastic": _rounded(found.stochastic.per_seed)},
        "anchors": {name: round(value, _DIGITS) for name, value in found.anchors.items()},
        "metrics": dict(zip(found.metrics, _rounded(found.metrics.values()), strict=True)),
    }


def _last_evaluation(curve: RunCurve, mode: Mode) -> dict[str, Any]:
    """Return what the end of a curve says of a run that was not judged."""
    return {
        "convention": curve.spec.convention,
        "episodes": curve.config.evaluation.episodes,
        "returns": {mode: _rounded(curve.values[-1])},
    }


def _way_there(curve: RunCurve, thresholds: Sequence[float]) -> dict[str, Any]:
    """Return what the evaluations on the way say: mean height, and first steps at thresholds."""
    found: dict[str, Any] = {"evaluations": len(curve.steps)}
    if len(curve.steps) > 1:
        found["area_under_curve"] = _rounded(area_under_curve(curve.steps, curve.values))
    passed = {limit: steps_to_threshold(curve.steps, curve.values, limit) for limit in thresholds}
    found["steps_to"] = [
        {"threshold": round(limit, _DIGITS), "of_mean": s.of_mean, "per_seed": list(s.per_seed)}
        for limit, s in passed.items()
    ]
    return found


def _reference_level(results: Mapping[str, Any], entry: Mapping[str, Any]) -> list[float]:
    """Return where the run ended that a cell is compared with, or the cell itself, as a list of one or none."""
    name = entry["reference"] or entry["name"]
    other = next((cell for cell in results["cells"] if cell["name"] == name), entry)
    mean = summarise(returns_of(other, results["mode"]))["mean"] if other.get("returns") else None
    return [] if mean is None else [mean]


def returns_of(entry: Mapping[str, Any], mode: str) -> NDArray[np.float64]:
    """Return the final returns of a cell [S], NaN where a seed stopped."""
    return _floats(entry["returns"][mode])


def verdict(results: Mapping[str, Any], entry: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return everything that tables say about one cell; None where it is not finished.

    Args:
        results: as `collect` returns them.
        entry: of its cells.

    Returns:
        mean, sem, ci95, iqm, normalised (0 is the random policy, 1 the heuristic), difference and probability of
        improvement against the cell's reference, ahead ("ahead", "behind" or "level" with it, by whether the interval
        of the difference holds 0), area, and the paper's side: mean, sem, ahead ("first" is ours).
    """
    if not entry.get("returns"):
        return None
    values = returns_of(entry, results["mode"])
    out = summarise(values)
    good = values[np.isfinite(values)]
    if not good.size:
        return out | {"iqm": None, "normalised": None, "ahead": None, "area": None, "paper": None}
    out["iqm"] = _plain(interquartile_mean(good))
    scores = _normalised(entry, good)
    out["normalised"] = None if scores is None else summarise(scores)
    out["area"] = summarise(_floats(entry["area_under_curve"])) if entry.get("area_under_curve") else None
    out["ahead"] = None
    other = next((cell for cell in results["cells"] if cell["name"] == entry["reference"]), None)
    if other is not None and other.get("returns"):
        gap = versus(values, returns_of(other, results["mode"]), entry["seeds"] == other["seeds"])
        if gap is not None:
            interval = gap["difference"]["ci95"]
            out |= gap
            out["ahead"] = None if interval is None else _side(interval)
    out["paper"] = None
    if entry["paper"]:
        mean, sem = entry["paper"]
        ahead = leader((out["mean"], out["sem"], good.size), (mean, sem, NUM_SEEDS))
        out["paper"] = {"mean": mean, "sem": sem, "ahead": ahead}
    return out


def aggregates(results: Mapping[str, Any]) -> dict[str, dict[str, Estimate]]:
    """Return, by variant, numbers over all panels, with intervals whose bootstrap redraws seeds within each panel.

    `iqm` and `mean` of the normalised returns, and `improvement`, the mean probability of improvement over the panel's
    reference. Only variants with two or more panels, all of them finished and with anchors.
    """
    out: dict[str, dict[str, Estimate]] = {}
    cells = results["cells"]
    for variant in dict.fromkeys(cell["variant"] for cell in cells):
        own = [cell for cell in cells if cell["variant"] == variant]
        scores: dict[str, NDArray[np.float64]] = {}
        pairs: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
        for cell in own:
            values = returns_of(cell, results["mode"]) if cell.get("returns") else np.full(1, np.nan)
            normalised = _normalised(cell, values) if np.isfinite(values).all() else None
            if normalised is None:
                break
            scores[cell["panel"]] = normalised
            other = next((c for c in cells if c["name"] == cell["reference"] and c.get("returns")), None)
            if other is not None and other["seeds"] == cell["seeds"]:
                pairs[cell["panel"]] = (values, returns_of(other, results["mode"]))
        if len(scores) < max(2, len(own)):
            continue
        out[variant] = {"iqm": aggregate(scores, "iqm"), "mean": aggregate(scores, "mean")}
        alike = len({x.size for x, _ in pairs.values()}) == 1
        if len(pairs) == len(own) and alike and all(np.isfinite(y).all() for _, y in pairs.values()):
            out[variant]["improvement"] = average_improvement(pairs)
    return out


def _normalised(entry: Mapping[str, Any], values: NDArray[np.float64]) -> NDArray[np.float64] | None:
    anchors = entry.get("anchors") or {}
    if "random" not in anchors or "heuristic" not in anchors or anchors["random"] == anchors["heuristic"]:
        return None
    return normalise(values, anchors["random"], anchors["heuristic"])


def _side(interval: Sequence[float]) -> str:
    low, high = interval
    return "ahead" if low > 0 else "behind" if high < 0 else "level"


def _plain(estimate: Estimate) -> dict[str, Any]:
    return {"value": estimate.value, "ci95": estimate.ci95}


def _paper(cell: Cell) -> list[float | None] | None:
    number = reported(cell.paper)
    return None if number is None else [number.mean, number.sem]


def _floats(values: Sequence[float | None]) -> NDArray[np.float64]:
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)


def _rounded(values: Any) -> list[float | None]:
    return [None if x is None or not math.isfinite(x) else round(float(x), _DIGITS) for x in values]


def flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return a configuration with dotted names, so that two of them can be held against each other."""
    out: dict[str, Any] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        out |= flat(value, f"{name}.") if isinstance(value, dict) and value else {name: value}
    return out
