"""Runs put together by hand: a study of their own, compared at one step or at several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from pydantic import JsonValue

from esp_cli.defaults import Mode
from esp_cli.files.formatting import format_exactly
from esp_cli.policies.statistics import Interval, SeedSummary, summarise
from esp_cli.reporting.collect import Material, RunState, results_of
from esp_cli.reporting.curves import RunCurve
from esp_cli.reporting.plots import Curve, learning_curves
from esp_cli.reporting.results import CellResult
from esp_cli.reporting.summary import floats, summarise_cell
from esp_cli.studies.study import Cell, Study
from esp_envs.errors import UserError


def put_together(
    curves: Sequence[RunCurve],
    paths: Sequence[Path],
    command: str,
    mode: Mode,
    at: Sequence[int] = (),
    thresholds: Sequence[float] = (),
) -> Material:
    """Return runs of one task as a study whose panels are the steps at which they are compared.

    Args:
        curves: of the runs; the others are compared with the first.
        paths: folders of the runs.
        command: that reports them again.
        mode: which evaluations.
        at: steps at which the runs are compared; by default the last step that all of them have reached.
        thresholds: returns whose first passing is stated.

    Raises:
        UserError: a label twice, or runs of different tasks, versions or settings of the task, whose returns do not
            compare.
    """
    labels = [curve.label for curve in curves]
    twice = next((label for label in labels if labels.count(label) > 1), None)
    if twice is not None:
        raise UserError(f"two runs are called '{twice}'; give each a label of its own, as in plain={paths[0]}")
    if len({(c.config.task, str(sorted(c.config.task_settings.items()))) for c in curves}) > 1:
        raise UserError("these runs have different tasks or task settings, so their returns do not compare")
    versions = sorted({curve.spec.version for curve in curves})
    if len(versions) > 1:
        raise UserError(
            f"these runs were trained on versions {' and '.join(map(str, versions))} of {curves[0].config.task}, in "
            "which observations, actions or rewards differ, so their returns do not compare; train the older ones again"
        )
    steps = tuple(dict.fromkeys(at)) or (min(curve.last_step for curve in curves),)
    cells, states, by_name, runs = [], {}, {}, {}
    for step in steps:
        for k, (curve, path) in enumerate(zip(curves, paths, strict=True)):
            name, first = f"{k}-{curve.label}-{step}", f"0-{labels[0]}-{step}"
            panel = f"{curve.config.task}, {format_exactly(step)}"
            reference = None if k == 0 else first
            cells.append(Cell(name=name, panel=panel, variant=curve.label, config=curve.config, reference=reference))
            states[name] = RunState(curve.last_step, curve, at=step)
            by_name[name], runs[name] = curve, path
    study = Study(
        kind="runs",
        title=f"{' and '.join(labels)} on {curves[0].config.task}",
        command=command,
        episodes=curves[0].config.evaluation.episodes,
        rows="variants",
        cells=tuple(cells),
    )
    return Material(study, results_of(study, states, mode, thresholds), by_name, runs)


def comparison(material: Material, thresholds: Sequence[float]) -> dict[str, JsonValue]:
    """Return runs side by side, as `esp report RUN... --json` writes them.

    Args:
        material: of `put_together`.
        thresholds: that the user asked for.

    Returns:
        A document: task, task_version, convention, episodes_per_evaluation, and by run its label, seeds, seconds, the
        step at which it stands, returns by step (None where it did not get there), steps to thresholds, area under the
        curve up to the last of these steps, and configuration.
    """
    by_run: dict[str, list[CellResult]] = {}
    for cell in material.results.cells:
        by_run.setdefault(cell.variant, []).append(cell)
    runs: list[JsonValue] = []
    for label, cells in by_run.items():
        last, curve = cells[-1], material.curves[cells[-1].name]
        passed = last.steps_to if thresholds else ()
        area = last.area_under_curve
        runs.append(
            {
                "label": label,
                "seeds": list(last.seeds),
                "seconds": curve.seconds,
                "step": last.step,
                "returns": {str(cell.at): _returns(material, cell) for cell in cells},
                "steps_to": {str(p.threshold): {"mean": p.of_mean, "per_seed": list(p.per_seed)} for p in passed},
                "area_under_curve": None if area is None else _summary(summarise(floats(area))),
                "config": curve.config.model_dump(mode="json"),
            }
        )
    spec = next(iter(material.curves.values())).spec
    return {
        "task": spec.name,
        "task_version": spec.version,
        "convention": spec.convention,
        "episodes_per_evaluation": min(curve.config.evaluation.episodes for curve in material.curves.values()),
        "runs": runs,
    }


def _returns(material: Material, cell: CellResult) -> JsonValue:
    found = summarise_cell(material.results, cell)
    if found is None:
        return None
    out = _summary(found.returns)
    if found.gap is not None:
        gap, chance = found.gap.difference, found.gap.probability
        out["difference"] = {"mean": gap.value, "ci95": _interval(gap.ci95), "paired": found.gap.paired}
        out["probability_of_improvement"] = chance.value if chance else None
        out["probability_of_improvement_ci95"] = _interval(chance.ci95) if chance else None
        of_all = found.gap.over_all_pairs
        out["probability_of_improvement_over_all_pairs"] = of_all.value if of_all else None
    return out


def _summary(of: SeedSummary) -> dict[str, JsonValue]:
    return {"mean": of.mean, "sem": of.sem, "ci95": _interval(of.ci95), "per_seed": list(of.per_seed)}


def _interval(interval: Interval | None) -> JsonValue:
    return None if interval is None else list(interval)


def plot(
    material: Material, path: Path, references: Mapping[str, float], view: tuple[float, float] | None = None
) -> tuple[Path, Path]:
    """Draw the learning curves of runs put together by hand; returns the PNG and the SVG file.

    Args:
        material: of `put_together`.
        path: where to.
        references: lines at numbers of others: name -> return.
        view: the lowest and the highest return shown, by default all.
    """
    curves = {curve.label: curve for curve in material.curves.values()}
    first = next(iter(curves.values()))
    lines = [Curve(label, curve.steps, curve.values) for label, curve in curves.items()]
    ylabel = f"{material.results.mode} return ({first.spec.convention})"
    return learning_curves(lines, path, first.config.task, ylabel, references=references, ylim=view)
