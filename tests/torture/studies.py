"""Studies of two runs at once, whose scheduler, any job, or everything is killed; jobs are forks or real processes."""

import contextlib
import hashlib
import os
import random
import signal
import time
from collections.abc import Callable
from pathlib import Path

from esp_cli.studies.catalogue import plan
from esp_cli.studies.engine import Engine, LocalEngine
from esp_cli.studies.scheduler import Scheduler
from esp_cli.studies.study import StudyFolder
from esp_cli.training import trainer
from esp_cli.training.folder_names import FINAL
from tests.benchmarks.growth import family
from tests.forks import PATIENCE_S, ForkEngine, Job, fork, wait
from tests.studies.small_studies import request
from tests.torture.runs import run_state

TARGETS = ("parent", "job", "all")


def study_job(path: Path, engine: Engine) -> None:
    """Run a small study, or go on with it, two runs at once."""
    trainer.CHECKPOINT_SECONDS = trainer.CHECKPOINT_SPACING = 0
    os.environ["ESP_CHECKPOINT_SECONDS"] = "0"  # of real processes
    study = plan("table1", request(tasks=("navigation",), seeds=(0, 1), steps=((None, 200),)))
    with StudyFolder.held(path):
        folder = StudyFolder.create(path, study)
        scheduler = Scheduler(folder, folder.study.cells, 2, engine)
        scheduler.run(lambda snapshot: True, 0.02)
    failed = [run.message for run in scheduler.runs if run.status != "finished"]
    if failed:
        print(f"runs failed: {'; '.join(failed)}")
        raise SystemExit(1)


def forked_study(path: Path) -> None:
    """Run the study with jobs that are forks, which takes a second."""
    study_job(path, ForkEngine())


def real_study(path: Path) -> None:
    """Run the study as `esp reproduce` does, every job a process that imports everything."""
    study_job(path, LocalEngine())


def kill_some(rng: random.Random, job: Job, path: Path, seconds: float) -> tuple[str, int]:
    """Start a study and kill a part of it at a random moment; return how, and the exit code of its scheduler."""
    target, name = rng.choice(TARGETS), rng.choice(("KILL", "KILL", "TERM", "INT", "HUP"))
    end = time.monotonic() + rng.uniform(0, seconds * 1.2)
    return f"{target} {name}", kill_members(job, path, target, name, lambda members: time.monotonic() > end)


def kill_members(job: Job, path: Path, target: str, name: str, is_due: Callable[[list[int]], bool]) -> int:
    """Start a study; when due, signal its scheduler, its newest job, or everything.

    Args:
        job: the study.
        path: its folder.
        target: one of TARGETS.
        name: of the signal.
        is_due: whether it is time, told the numbers of all its processes.

    Returns:
        The scheduler's exit code.
    """
    members, end = [fork(lambda: job(path), path)], time.monotonic() + PATIENCE_S
    while not is_due(members) and time.monotonic() < end:
        time.sleep(0.002)
        members = list(family(members[0]))
    for member in {"parent": members[:1], "job": members[1:][-1:], "all": members}[target]:
        with contextlib.suppress(ProcessLookupError):
            os.kill(member, getattr(signal, f"SIG{name}"))
    return wait(members[0])


def study_state(path: Path) -> str:
    """Return a digest of what a study leaves: its runs and their final evaluations."""
    folder = StudyFolder.open(path)
    digest = hashlib.sha256((path / "study.json").read_bytes())
    for cell in folder.study.cells:
        digest.update(run_state(folder.run_path(cell)).encode())
        text = (folder.run_path(cell) / FINAL).read_text().replace(str(path), "")
        digest.update(text.encode())
    return digest.hexdigest()
