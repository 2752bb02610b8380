"""Runs put together by hand: a study of their own, compared at one step or at several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from pydantic import BaseModel, ConfigDict, JsonValue

from esp_cli.evaluation.final import Mode
from esp_cli.evaluation.statistics import Interval, SeedSummary, summarise
from esp_cli.formatting import format_count
from esp_cli.reporting.collect import Material, RunState, results_of
from esp_cli.reporting.curves import RunCurve, read_curve
from esp_cli.reporting.plots import Curve, learning_curves
from esp_cli.reporting.results import CellResult
from esp_cli.reporting.summary import floats, summarise_cell
from esp_cli.studies.study import Cell, Study

KIND = "runs"


class GapEntry(BaseModel):
    """The difference from the first run."""

    mean: float
    ci95: Interval | None
    paired: bool


class ReturnEntry(BaseModel):
    """The returns of a run at a step; the fields of the difference are missing where there is none."""

    mean: float | None
    sem: float | None
    ci95: Interval | None
    per_seed: tuple[float | None, ...]
    difference: GapEntry | None = None
    probability_of_improvement: float | None = None
    probability_of_improvement_ci95: Interval | None = None


class PassingEntry(BaseModel):
    """When a return is first reached: environment steps per seed, None for never."""

    mean: int | None
    per_seed: tuple[int | None, ...]


class RunEntry(BaseModel):
    """One run: at which step it stands, and its returns by the step at which it is compared."""

    label: str
    seeds: tuple[int, ...]
    seconds: float
    step: int
    returns: dict[int, ReturnEntry | None]
    steps_to: dict[float, PassingEntry]
    area_under_curve: SeedSummary | None
    config: dict[str, JsonValue]


class Comparison(BaseModel):
    """Runs side by side, as `esp report RUN... --json` writes them."""

    model_config = ConfigDict(frozen=True)

    task: str
    task_version: int
    convention: str
    episodes_per_evaluation: int
    runs: tuple[RunEntry, ...]

    def document(self) -> dict[str, JsonValue]:
        """Return what is written."""
        return self.model_dump(mode="json", exclude_unset=True)


def read_runs(
    places: Sequence[tuple[str | None, Path]],
    command: str,
    mode: Mode,
    at: Sequence[int] = (),
    thresholds: Sequence[float] = (),
) -> Material:
    """Read runs of one task as a study; see `put_together`.

    Args:
        places: label and folder of each run.
        command: that reports them again.
        mode: which evaluations.
        at: steps at which the runs are compared.
        thresholds: returns whose first passing is stated.

    Raises:
        ValueError: no run folder, no evaluation in it yet, or runs that do not compare.
    """
    curves = [read_curve(path, label, mode) for label, path in places]
    return put_together(curves, [path for _, path in places], command, mode, at, thresholds)


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
        ValueError: a label twice, or runs of different tasks or settings of the task, whose returns do not compare.
    """
    labels = [curve.label for curve in curves]
    twice = next((label for label in labels if labels.count(label) > 1), None)
    if twice is not None:
        raise ValueError(f"two runs are called '{twice}'; give each a label of its own, as in plain={paths[0]}")
    if len({(c.config.task, str(sorted(c.config.task_settings.items()))) for c in curves}) > 1:
        raise ValueError("these runs have different tasks or task settings, so their returns do not compare")
    steps = tuple(dict.fromkeys(at)) or (min(curve.last_step for curve in curves),)
    cells, states, by_name, runs = [], {}, {}, {}
    for step in steps:
        for k, (curve, path) in enumerate(zip(curves, paths, strict=True)):
            name, first = f"{k}-{curve.label}-{step}", f"0-{labels[0]}-{step}"
            panel = f"{curve.config.task}, {format_count(step)}"
            reference = None if k == 0 else first
            cells.append(Cell(name=name, panel=panel, variant=curve.label, config=curve.config, reference=reference))
            states[name] = RunState(curve.last_step, curve, at=step)
            by_name[name], runs[name] = curve, path
    study = Study(
        kind=KIND,
        title=f"{' and '.join(labels)} on {curves[0].config.task}",
        command=command,
        episodes=curves[0].config.evaluation.episodes,
        rows="variants",
        cells=tuple(cells),
    )
    return Material(study, results_of(study, states, mode, thresholds), by_name, runs)


def comparison(material: Material, thresholds: Sequence[float]) -> Comparison:
    """Return runs side by side.

    Args:
        material: of `read_runs`.
        thresholds: that the user asked for.
    """
    results, curves = material.results, material.curves
    by_run: dict[str, list[CellResult]] = {}
    for cell in results.cells:
        by_run.setdefault(cell.variant, []).append(cell)
    entries = []
    for label, cells in by_run.items():
        last, curve = cells[-1], curves[cells[-1].name]
        passed = {p.threshold: PassingEntry(mean=p.of_mean, per_seed=p.per_seed) for p in last.steps_to}
        area = None if last.area_under_curve is None else summarise(floats(last.area_under_curve))
        entries.append(
            RunEntry(
                label=label,
                seeds=last.seeds,
                seconds=curve.seconds,
                step=last.step,
                returns={cell.at or 0: _entry(material, cell) for cell in cells},
                steps_to=passed if thresholds else {},
                area_under_curve=area,
                config=curve.config.model_dump(mode="json"),
            )
        )
    first = next(iter(curves.values()))
    return Comparison(
        task=first.spec.name,
        task_version=first.spec.version,
        convention=first.spec.convention,
        episodes_per_evaluation=min(curve.config.evaluation.episodes for curve in curves.values()),
        runs=tuple(entries),
    )


def plot(
    material: Material, path: Path, references: Mapping[str, float], view: tuple[float, float] | None = None
) -> tuple[Path, Path]:
    """Draw the learning curves of runs put together by hand; returns the PNG and the SVG file.

    Args:
        material: of `read_runs`.
        path: where to.
        references: lines at numbers of others: name -> return.
        view: the lowest and the highest return shown, by default all.
    """
    curves = {curve.label: curve for curve in material.curves.values()}
    first = next(iter(curves.values()))
    lines = [Curve(label, curve.steps, curve.values) for label, curve in curves.items()]
    ylabel = f"{material.results.mode} return ({first.spec.convention})"
    return learning_curves(lines, path, first.config.task, ylabel, references=references, ylim=view)


def _entry(material: Material, cell: CellResult) -> ReturnEntry | None:
    found = summarise_cell(material.results, cell)
    if found is None:
        return None
    own = found.returns
    fields: dict[str, object] = {"mean": own.mean, "sem": own.sem, "ci95": own.ci95, "per_seed": own.per_seed}
    if found.gap is not None:
        gap, chance = found.gap, found.gap.probability
        fields |= {
            "difference": GapEntry(mean=gap.difference.value, ci95=gap.difference.ci95, paired=gap.paired),
            "probability_of_improvement": chance.value if chance else None,
            "probability_of_improvement_ci95": chance.ci95 if chance else None,
        }
    return ReturnEntry.model_validate(fields)
