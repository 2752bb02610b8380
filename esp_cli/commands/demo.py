"""`esp demo`: one learner with the symmetry prior and without it, side by side."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text
from typer import Option

from esp_cli import console
from esp_cli.commands import options
from esp_cli.commands.study_options import StudyChoices
from esp_cli.commands.study_progress import StudyProgress
from esp_cli.files.formatting import format_count

if TYPE_CHECKING:
    from esp_cli.studies.plan import Study
    from esp_cli.studies.scheduler import Scheduler
    from esp_cli.studies.study import StudyFolder

EPILOG = """Examples:\n
    esp demo\n
    esp demo --task navigation --steps 100k --out runs/demo-navigation"""

STEPS, SEEDS = 50_000, (0, 1, 2)
LABELS = {"none": "MAPPO", "esp": "MAPPO with symmetry"}
CURVES, FILM = "curves.png", "film.gif"
_EVALUATIONS, _EPISODES, _FILM_EPISODES, _FILM_PIXELS = 10, 100, 3, 320


def demo(
    context: typer.Context,
    task: options.TaskOption = "predator-prey",
    steps: options.StepsOption = STEPS,
    seeds: Annotated[options.Seeds | None, options.seeds_option(len(SEEDS))] = None,
    out: Annotated[Path, Option("--out", "-o", help="Folder of both runs, picture and film.")] = Path("runs/demo"),
    settings: options.SetOption = None,
) -> None:
    """Train MAPPO with symmetry and without it, in half a minute: two curves, a picture, and a film of both.

    Called again, it goes on where it was.
    """
    from esp_cli.commands import studying
    from esp_cli.studies.catalogue import refuse_untrainable
    from esp_cli.studies.study import StudyFolder

    choices = StudyChoices(seeds=seeds or SEEDS, jobs=2, settings=settings, episodes=_EPISODES)
    choices.command = options.command_line(context)
    study = _plan(task, steps, choices)
    refuse_untrainable(study)
    with studying.working(choices, out, "cpu", "both runs after their iteration") as resources:
        folder = StudyFolder.create(out, study)
        folder.study = study.model_copy(update={"cells": tuple(folder.cells_of(study))})  # of this call alone
        failed = studying.run_cells(folder, study, resources, LiveCurves(folder))
    studying.refuse_failed(failed, out)
    _show(folder)


def _plan(task: str, steps: int, choices: StudyChoices) -> Study:
    from esp_cli.studies.catalogue import plan

    options.register_named([task])
    request, often = choices.request(), {"evaluation.every_steps": max(1, steps // _EVALUATIONS)}
    request = replace(request, tasks=(task,), steps=((None, steps),), overrides={**often, **request.overrides})
    study = plan("ablate-prior", request)
    cells = tuple(cell.model_copy(update={"variant": LABELS[cell.config.prior.kind]}) for cell in study.cells)
    return study.model_copy(update={"title": "One learner with symmetry and without it", "cells": cells})


class LiveCurves(StudyProgress):
    """Progress of a study of two runs with their learning curves: above the bars, or as lines in a pipe."""

    def __init__(self, folder: StudyFolder) -> None:
        super().__init__()
        self._folder, self._told = folder, 0

    def update(self, scheduler: Scheduler) -> None:
        from esp_cli.reporting.collect import begun_curve

        super().update(scheduler)
        curves: dict[str, list[tuple[int, float]]] = {}
        for cell in self._folder.study.cells:
            read = begun_curve(self._folder.run_path(cell), cell, "greedy")
            curves[cell.variant] = list(zip(read.steps, read.values.mean(1), strict=True)) if read else []
        if self._live is not None:
            self._live.above = draw_curves(curves, self._folder.study.cells[0].config.steps, console.err.width)
            return
        both = list(zip(*curves.values(), strict=False))
        for points in both[self._told :]:
            returns = (f"{label} {value:.1f}" for label, (_, value) in zip(curves, points, strict=True))
            console.note(f"after {console.format_count(points[0][0])} steps: return {', '.join(returns)}")
        self._told = len(both)


def _show(folder: StudyFolder) -> None:
    from esp_cli.commands.report import print_answer
    from esp_cli.drawing.draw import Request, draw
    from esp_cli.policies.loading import TrainedPolicy
    from esp_cli.reporting import study_figures
    from esp_cli.reporting.collect import collect_study
    from esp_cli.training.build import build_environment

    material, out = collect_study(folder), folder.path
    console.note(f"curves -> {study_figures.draw_curves(material, out / CURVES)}")
    trained = [TrainedPolicy.read(folder.run_path(cell)) for cell in folder.study.cells]
    if build_environment(trained[0].config.of_one_seed(), 1, "film").has("scene"):
        request = Request(out / FILM, episodes=_FILM_EPISODES, size=_FILM_PIXELS)
        with console.watching("draw", "frames") as watch:
            drawing = draw(request, trained, [*LABELS.values()], watch)
        returns = (f"{label} {value:.1f}" for value, label in zip(drawing.returns, LABELS.values(), strict=True))
        console.note(f"film of the same {_FILM_EPISODES} episodes, return {', '.join(returns)} -> {drawing.path}")
    print_answer(material, full=False)
    console.note(f"next: {shlex.join(['esp', 'report', str(out), '--films'])}    esp train --task formation")


MARKS, _STYLES = ("○", "●"), ("dodger_blue2", "dark_orange")  # of the curves in turn
_HEIGHT, _WIDEST, _LABEL = 12, 64, 8  # rows and columns of the drawing, columns of a number beside it


def draw_curves(curves: Mapping[str, Sequence[tuple[float, float]]], steps: int, width: int) -> Text:
    """Draw two curves, name -> points (step, value), in one pair of axes, with extremes and legend."""
    import numpy as np

    columns = max(10, min(_WIDEST, width - _LABEL - 2))
    values = [value for points in curves.values() for _, value in points if math.isfinite(value)]
    low, high = (min(values), max(values)) if values else (0.0, 0.0)
    grid = np.full((_HEIGHT, columns), -1)
    for index, points in enumerate(curves.values()):
        if points:
            at, means = np.array(points).T
            shown = np.arange(columns) * steps / (columns - 1)
            share = (np.interp(shown, at, means, np.nan, np.nan) - low) / max(high - low, 1e-9)
            seen = np.isfinite(share)  # where a seed stopped there is no mean
            rows = np.round((1 - share[seen]) * (_HEIGHT - 1)).astype(int)
            grid[rows, np.flatnonzero(seen)] = index
    text = Text()
    for number, row in enumerate(grid):
        level = {0: high, _HEIGHT - 1: low}.get(number) if values else None
        text.append(f"{'' if level is None else f'{level:.4g}':>{_LABEL}} │")
        for index in row:
            text.append(" " if index < 0 else MARKS[index], "" if index < 0 else _STYLES[index])
        text.append("\n")
    text.append(f"{'':{_LABEL}} └{'─' * columns}\n{'':{_LABEL}}  0{format_count(steps) + ' steps':>{columns - 1}}\n")
    for index, (name, points) in enumerate(curves.items()):
        newest = f" {points[-1][1]:.1f}" if points else ""
        text.append(f"{'':{_LABEL}}  {MARKS[index]} {name}{newest}", _STYLES[index])
    return text.append("\n")
