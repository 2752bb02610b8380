"""What the study commands do: plan, run with live progress, tabulate."""

from __future__ import annotations

import shlex
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from esp_cli import console
from esp_cli.commands.options import note_without_effect
from esp_cli.commands.study_options import StudyChoices
from esp_cli.commands.study_progress import StudyProgress
from esp_cli.console.progress import stop_requests
from esp_cli.training.folder_names import FRESH, LOG
from esp_envs.errors import UserError
from esp_envs.installed import install

if TYPE_CHECKING:
    from esp_cli.studies.catalogue import Request
    from esp_cli.studies.engine import Engine
    from esp_cli.studies.plan import Cell, Study
    from esp_cli.studies.scheduler import Scheduler
    from esp_cli.studies.search import Search
    from esp_cli.studies.study import StudyFolder


@dataclass(frozen=True)
class Resources:
    """What a study is run with."""

    engine: Engine  # starts its runs
    jobs: int  # at once
    reused: Sequence[StudyFolder]  # studies whose finished runs are taken over
    check: bool  # whether runs take a short look at a task that is not built in
    requests: Sequence[int] = ()  # to stop; not empty once the user asks for it


@contextmanager
def open_resources(choices: StudyChoices, out: Path, device: str) -> Iterator[Resources]:
    """Yield what a study in the folder `out` is run with, whose runs train on a device."""
    from esp_cli.studies.engine import LocalEngine
    from esp_cli.studies.study import StudyFolder

    reused, check = [StudyFolder.open(path) for path in choices.reuse or ()], not choices.no_check
    if choices.engine == "local":
        if choices.address is not None:
            raise UserError("--address is that of a Ray cluster; add --engine ray, or leave it out")
        if choices.gpu_share != 1.0:
            raise UserError("--gpu-share is for GPUs of a Ray cluster; add --engine ray, or leave it out")
        local = LocalEngine()
        yield Resources(local, choices.jobs or local.places(device), reused, check)
        return
    try:
        from esp_cli.studies.engine_ray import RayEngine
    except ImportError:
        raise UserError(f"Ray is not installed: {install('cluster')}, or use --engine local") from None
    with RayEngine(out, choices.address, choices.gpu_share) as engine:
        yield Resources(engine, choices.jobs or engine.places(device), reused, check)


@contextmanager
def working(
    choices: StudyChoices, out: Path, device: str, stopping: str = "every run after its iteration"
) -> Iterator[Resources]:
    """Hold the folder `out`, and yield what a study in it is run with; where the user stops it, the command ends."""
    from esp_cli.studies.study import StudyFolder

    with (
        open_resources(choices, out, device) as resources,
        StudyFolder.held(out),
        stop_requests(f"stopping {stopping}") as requests,
    ):
        yield replace(resources, requests=requests)
    if requests:
        console.note(f"stopped; go on with: {choices.command}")
        raise typer.Exit(130)


def run_or_forecast(kind: str, request: Request, choices: StudyChoices) -> None:
    """Run and report a study of a kind of `studies.kinds`, or say what it costs, where only that was asked for."""
    from esp_cli.studies.catalogue import plan, refuse_untrainable, without_effect
    from esp_cli.studies.study import StudyFolder

    out, study = choices.folder(kind), plan(kind, request)
    note_without_effect(without_effect(kind, request))
    if choices.dry_run:
        StudyFolder.planned(out, study)  # refuses the folders that the run would refuse
        forecast(StudyFolder(out, study), choices)
        return
    refuse_untrainable(study)
    with working(choices, out, study.cells[0].config.device) as resources:
        begun = time.monotonic()
        folder = StudyFolder.create(out, study)
        failed = run_cells(folder, study, resources)
    console.note(f"this took {console.format_duration(time.monotonic() - begun)}")
    conclude(folder, failed, out, choices)


def search_or_forecast(search: Search, kind: str, choices: StudyChoices) -> None:
    """Run the trials of a search and what judges them, or say what that costs, where only that was asked for."""
    from esp_cli.studies.search import Trials
    from esp_cli.studies.study import StudyFolder

    out, planned, fresh = choices.folder(kind), search.trials, None
    note_without_effect(search.without_effect())
    trials, _ = Trials.planned(out, planned, search.keeps)
    study = search.forecast(trials)
    StudyFolder.planned(out / FRESH, study, search.keeps)  # refuses folders before anything is trained
    if choices.dry_run:
        groups = {": ".join(one): own for one, own in search.trials_of.items()}
        what = f"{len(search.draws)} trials of each, and the runs that judge"
        forecast(StudyFolder(out / FRESH, study), choices, trials, groups, what)
        return
    with working(choices, out, search.request.device) as resources:
        trials = Trials.create(out, planned, search.keeps)
        failed = follow(trials, trials.cells_of(planned), resources)
        if not (resources.requests or failed):
            study = search.judged(trials)
            fresh = StudyFolder.create(out / FRESH, study, search.keeps)
            failed = run_cells(fresh, study, resources)
    conclude(fresh, failed, out, choices)


def conclude(study: StudyFolder | None, failed: Sequence[str], out: Path, choices: StudyChoices) -> None:
    """End a command that ran a study in `out`, with the study's report and a word on what failed."""
    if study is not None:
        from esp_cli.commands.report import print_answer
        from esp_cli.reporting.collect import collect_study

        material = collect_study(study, choices.mode, choices.thresholds)
        numbers = material.results.document(statistics=True)
        console.result(choices.json, numbers, lambda: print_answer(material, True, choices.thresholds))
        first, *others = (cell.config for cell in study.study.cells)
        words = [*first.own_words(*others), *(["--mode", choices.mode] if choices.mode else [])]
        words += [word for limit in choices.thresholds for word in ("--threshold", f"{limit:g}")]
        console.note(f"next: {shlex.join(['esp', 'report', str(study.path), *words])}")
    refuse_failed(failed, out)


def forecast(
    folder: StudyFolder,
    choices: StudyChoices,
    trials: StudyFolder | None = None,
    groups: Mapping[str, Sequence[Cell]] | None = None,
    what: str = "",
) -> None:
    """Say what is left of a study, or of trials in groups and of the study that judges them, by `what` for short."""
    from esp_cli.studies.forecast import forecast_study, forecast_tuned

    cells, groups = folder.study.cells, groups or {}
    with (
        open_resources(choices, folder.path, cells[0].config.device) as resources,
        console.TrainingProgress(len(cells) + len(groups), description="measure", unit="runs") as progress,
    ):
        found = forecast_study(folder, resources.reused, resources.jobs, progress.update)
        if trials is not None:
            found = forecast_tuned(trials, groups, found, lambda done: progress.update(len(cells) + done))
    size, duration = console.format_count, console.format_duration
    rows = [(r.name, f"{size(r.steps)} x {r.num_seeds}", r.status, duration(r.seconds)) for r in found.runs]
    left = sum(run.seconds > 0 for run in found.runs)
    what = what or f"{left} run{'' if left == 1 else 's'} to do"
    core, side_by_side = map(duration, (found.core_seconds, found.seconds))

    def show() -> None:
        console.table(("run", "steps x seeds>", "state", "time left>"), rows, title=found.title)
        console.say(
            f"{what}: {core} on one core, {side_by_side} with {found.jobs} side by side, if nothing else runs here"
        )

    console.result(choices.json, found, show)


def run_cells(
    folder: StudyFolder, study: Study, resources: Resources, progress: StudyProgress | None = None
) -> list[str]:
    """Run the cells of a study in its folder, which the caller's lock holds; return the names of those that failed.

    Of cells that train the same, one is run.
    """
    cells = folder.cells_of(study)
    taken = folder.adopt_finished(cells, resources.reused)
    for cell, twin in taken:
        console.note(f"taking over {twin} as {cell.name}")
    if resources.reused and not taken and not all(folder.run_path(cell).exists() for cell in cells):
        console.note(
            "--reuse gives nothing: no finished run there has configuration and episodes of one that has not begun"
        )
    failed = follow(folder, folder.unlike(cells), resources, progress)
    for cell, twin in folder.adopt_finished(cells, [folder]):
        console.note(f"taking over {twin} as {cell.name}, which trains the same")
    return failed


def follow(
    folder: StudyFolder, cells: Sequence[Cell], resources: Resources, progress: StudyProgress | None = None
) -> list[str]:
    """Run cells of a study with live progress, by default a bar for each; return the names of the failed."""
    from esp_cli.studies.scheduler import Scheduler

    folder.check = resources.check
    scheduler = Scheduler(folder, cells, min(resources.jobs, len(cells)), resources.engine)
    console.note(
        f"{folder.study.title}: {len(cells)} runs, {scheduler.count('finished')} of them finished, "
        f"{scheduler.jobs} side by side -> {folder.path}"
    )
    with progress or StudyProgress() as shown:

        def listen(scheduler: Scheduler) -> bool:
            shown.update(scheduler)
            return not resources.requests

        scheduler.run(listen)
    return [run.cell.name for run in scheduler.runs if run.status == "failed"]


def refuse_failed(names: Sequence[str], out: Path) -> None:
    """End the command where runs of the study in a folder failed."""
    if names:
        runs = "run" if len(names) == 1 else "runs"
        raise UserError(
            f"{len(names)} {runs} failed ({', '.join(names)}); what was said of them is above, and in {LOG} of their "
            f"folders below {out}; the same command tries them again"
        )
