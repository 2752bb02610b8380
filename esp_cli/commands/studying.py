"""What the study commands do: plan, say what it costs, run with live progress, tabulate."""

from __future__ import annotations

import shlex
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from esp_cli import console
from esp_cli.commands.options import note_without_effect
from esp_cli.commands.stopping import stop_requests
from esp_cli.commands.study_options import StudyChoices
from esp_cli.commands.study_progress import StudyProgress
from esp_cli.machine import busy_with
from esp_cli.training.folder_names import LOG
from esp_envs.errors import UserError
from esp_envs.installed import install

if TYPE_CHECKING:
    from esp_cli.defaults import Mode
    from esp_cli.studies.catalogue import Request
    from esp_cli.studies.engine import Engine
    from esp_cli.studies.forecast import Forecast
    from esp_cli.studies.scheduler import Scheduler, Snapshot
    from esp_cli.studies.study import Study, StudyFolder

_MEBIBYTE = 2**20
BUSY = 0.5
"""Load per core from which a forecast is called unreliable."""


def run_study(
    kind: str, request: Request, choices: StudyChoices, mode: Mode | None = None, thresholds: Sequence[float] = ()
) -> None:
    """Plan a study and run it, or with --dry-run say what it would cost.

    Args:
        kind: of `studies.kinds`.
        request: what the user asks for.
        choices: how it is run.
        mode: which evaluations the tables state; by default those of this kind of study.
        thresholds: returns whose first passing the tables state, likewise.

    Raises:
        UserError: what cannot be planned; a folder that holds something else or is in use; runs that failed.
    """
    from esp_cli.studies.catalogue import plan, without_effect
    from esp_cli.studies.study import StudyFolder
    from esp_cli.training.build import build_learner

    out, study = choices.folder(kind), plan(kind, request)
    others = choices.reused()
    for cell in () if choices.dry_run else study.cells:  # refuses what does not go together before there is a folder
        build_learner(cell.config.of_one_seed())
    with open_engine(choices, out) as engine:
        jobs = choices.jobs or engine.places(study.cells[0].config.device)
        note_without_effect(without_effect(kind, request))
        if choices.dry_run:
            StudyFolder.planned(out, study)  # refuses the folders that the run would refuse
            _dry_run(StudyFolder(out, study), others, jobs, choices.json)
            return
        begun = time.monotonic()
        with StudyFolder.held(out), stop_requests("stopping every run after its iteration") as requests:
            folder = StudyFolder.create(out, study)
            complete, failed = run_cells(folder, study, others, jobs, engine, requests)
    if not complete:
        console.note(f"stopped; go on with: {study.command}{choices.running_words()}")
        raise typer.Exit(130)
    console.note(f"this took {console.format_duration(time.monotonic() - begun)}")
    report_study(folder, choices.json, mode, thresholds)
    refuse_failed(failed, out)


def refuse_failed(names: Sequence[str], out: Path) -> None:
    """End the command where runs of the study in a folder failed.

    Raises:
        UserError: some did.
    """
    if not names:
        return
    with_log = {path.parent.name for path in out.rglob(LOG)}  # a run that no machine could take has none
    logged = [name for name in names if name in with_log]
    whose = "their folders" if len(logged) == len(names) else f"the folders of {', '.join(logged)}"
    see = f" see {LOG} in {whose} below {out};" if logged else ""
    runs = "run" if len(names) == 1 else "runs"
    raise UserError(f"{len(names)} {runs} failed ({', '.join(names)});{see} the same command tries them again")


@contextmanager
def open_engine(choices: StudyChoices, out: Path) -> Iterator[Engine]:
    """Yield the engine that a study asks for.

    Args:
        choices: how the study is run.
        out: its folder.

    Raises:
        UserError: Ray is not installed, or its cluster cannot be used.
    """
    from esp_cli.studies.engine_local import LocalEngine

    if choices.engine == "local":
        if choices.address is not None:
            raise UserError("--address is that of a Ray cluster; add --engine ray, or leave it out")
        if choices.gpu_share != 1.0:
            raise UserError("--gpu-share is for GPUs of a Ray cluster; add --engine ray, or leave it out")
        yield LocalEngine()
        return
    try:
        from esp_cli.studies.engine_ray import RayEngine
    except ImportError:
        raise UserError(f"Ray is not installed: {install('cluster')}, or use --engine local") from None
    with RayEngine(out, choices.address, choices.gpu_share) as engine:
        yield engine


def run_cells(
    folder: StudyFolder,
    study: Study,
    others: Sequence[StudyFolder],
    jobs: int,
    engine: Engine,
    requests: Sequence[int],
) -> tuple[bool, list[str]]:
    """Run the cells of a study; return whether it came to its end, and which runs failed.

    Of cells that train the same, the first is run, and the others take its run over.

    Args:
        folder: of the study, held by the caller's lock.
        study: the cells that are wanted.
        others: studies whose finished runs are taken over.
        jobs: at once.
        engine: starts them.
        requests: not empty once the user asks to stop.
    """
    from esp_cli.studies.scheduler import Scheduler

    names = {cell.name for cell in study.cells}
    cells = [cell for cell in folder.study.cells if cell.name in names]
    for cell in cells:
        twin = folder.find_twin(cell, others)
        if twin is not None:
            folder.adopt(cell, twin)
            console.note(f"taking over {twin} as {cell.name}")
    same = [
        cell
        for k, cell in enumerate(cells)
        if any(cell.config == earlier.config for earlier in cells[:k]) and not folder.run_path(cell).exists()
    ]
    runs = [cell for cell in cells if cell not in same]
    complete, failed = follow(Scheduler(folder, runs, min(jobs, len(runs)), engine), study.title, requests)
    for cell in same:
        if (twin := folder.find_twin(cell, [folder])) is not None:
            folder.adopt(cell, twin)
            console.note(f"taking over {twin} as {cell.name}, which trains the same")
    return complete, failed


def follow(scheduler: Scheduler, title: str, requests: Sequence[int]) -> tuple[bool, list[str]]:
    """Run a scheduler with live progress; return whether it came to its end, and which runs failed."""
    finished = sum(run.status == "finished" for run in scheduler.runs)
    console.note(
        f"{title}: {len(scheduler.runs)} runs, {finished} of them finished, {scheduler.jobs} side by side -> "
        f"{scheduler.folder.path}"
    )
    with StudyProgress() as progress:

        def listen(snapshot: Snapshot) -> bool:
            progress.update(snapshot)
            return not requests

        complete = scheduler.run(listen)
    return complete, [run.cell.name for run in scheduler.runs if run.status == "failed"]


def report_study(folder: StudyFolder, json: str | None, mode: Mode | None, thresholds: Sequence[float]) -> None:
    """Print the table of a study and say what to do next."""
    from esp_cli.commands.report import print_tables, threshold_words
    from esp_cli.reporting.collect import collect_study

    results = collect_study(folder, mode, thresholds).results
    console.result(json, results.document(statistics=True), lambda: print_tables(results))
    first, *others = (cell.config for cell in folder.study.cells)
    words = ["esp", "report", str(folder.path), *first.own_words(*others), *threshold_words(thresholds)]
    console.note(f"next: {shlex.join(words)}")


@contextmanager
def measuring(total: int) -> Iterator[Callable[[int], object]]:
    """Yield what is told how many of these measurements are done; say if the machine was too busy for them."""
    with console.TrainingProgress(total, description="measure") as progress:
        busy = busy_with()  # before the measurement, which keeps a core busy itself
        yield progress.update
    if busy > BUSY:
        console.note(
            f"this machine was busy (load {busy:.1f} per core) while this was measured, so the times are unreliable; "
            "ask again when it is idle"
        )


def say_disk(done: int, peak: int, out: Path) -> None:
    """Say what bytes a folder needs when all is done and on the way, and whether the disk has them."""
    free = shutil.disk_usage(next(p for p in (out, *out.absolute().parents) if p.exists())).free
    console.say(
        f"disk: {done / _MEBIBYTE:.0f} MiB when done, at most {peak / _MEBIBYTE:.0f} MiB on the way; "
        f"{free / _MEBIBYTE:.0f} MiB are free -> {out}"
    )
    if peak > free:
        console.note("the disk is too small for that; choose another --out, or fewer --jobs")


def _dry_run(folder: StudyFolder, others: Sequence[StudyFolder], jobs: int, json: str | None) -> None:
    """Print the runs of a study, how long each takes by a probe on this machine, and what they need on the disk."""
    from esp_cli.studies.forecast import forecast

    with measuring(len(folder.study.cells)) as listener:
        found = forecast(folder, others, jobs, listener)
    console.result(json, found, lambda: _print_forecast(found))


def _print_forecast(found: Forecast) -> None:
    rows = [
        (
            run.name,
            f"{console.format_count(run.config.steps)} x {len(run.config.seeds)}",
            run.status if run.status == "finished" else f"at {console.format_count(run.step)}" if run.step else "new",
            console.format_duration(run.seconds_left),
        )
        for run in found.runs
    ]
    console.table(("run", "steps x seeds>", "state", "time left>"), rows, title=found.title)
    console.say(
        f"{sum(run.status != 'finished' for run in found.runs)} runs to do: "
        f"{console.format_duration(found.core_seconds)} on one core, "
        f"{console.format_duration(found.seconds)} with {found.jobs} side by side, if nothing else runs here"
    )
    say_disk(found.disk_bytes, found.disk_peak_bytes, found.out)
