"""The scheduler, over a stand-in that does to run folders what training does."""

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from esp_cli.studies.engine import APPLICATION, LocalEngine
from esp_cli.studies.scheduler import Scheduler, makespan
from esp_cli.studies.study import StudyFolder
from esp_cli.training.folder_names import FINAL, LOG
from tests.studies.small_studies import small_study, stand_in, write_study

ROOT = Path(__file__).parents[2]
FOUR = ("navigation", "predator-prey")


def trace(folder: StudyFolder) -> list[str]:
    file = folder.path / "trace.txt"
    return file.read_text().splitlines() if file.exists() else []


def run(folder: StudyFolder, jobs: int = 2, engine=None, listener=lambda snapshot: True) -> Scheduler:
    scheduler = Scheduler(folder, folder.study.cells, jobs, engine or LocalEngine(stand_in()))
    scheduler.complete = scheduler.run(listener, 0.01)
    return scheduler


@pytest.fixture
def folder(tmp_path):
    return StudyFolder.create(tmp_path / "s", small_study(tasks=FOUR))


def statuses(scheduler: Scheduler) -> list[str]:
    return [run.status for run in scheduler.runs]


def test_every_run_is_trained_and_evaluated_once_and_no_more_than_jobs_at_once(folder):
    seen = []
    scheduler = run(folder, 2, listener=lambda s: seen.append(s.count("training", "evaluating", "elsewhere")) or True)
    assert scheduler.complete
    assert statuses(scheduler) == ["finished"] * 4
    names = [cell.name for cell in folder.study.cells]
    assert sorted(trace(folder)) == sorted([f"{what} {name}" for what in ("eval", "train") for name in names])
    assert max(seen) == 2
    assert all("$ esp" in (folder.run_path(cell) / LOG).read_text() for cell in folder.study.cells)


def test_what_is_finished_is_skipped_and_what_is_trained_is_only_evaluated(tmp_path):
    folder = write_study(tmp_path / "s", small_study(tasks=FOUR), {"MAPPO": [-1.0, -2.0, -3.0]})
    cells = folder.study.cells
    (folder.run_path(cells[0]) / FINAL).unlink()
    assert statuses(run(folder, 1)) == ["finished"] * 4
    assert trace(folder) == [
        f"eval {cells[0].name}",
        f"train {cells[1].name}",
        f"eval {cells[1].name}",
        f"train {cells[3].name}",
        f"eval {cells[3].name}",
    ]


@pytest.mark.parametrize("damage", [b"{}", b"[" * 200_000, b"[]", b"", b'{"greedy": 7}', "link"])
def test_a_damaged_evaluation_is_made_anew(tmp_path, damage):
    folder = write_study(tmp_path / "s", small_study(), {"MAPPO": [-1.0, -2.0, -3.0]})
    cell = next(cell for cell in folder.study.cells if folder.is_finished(cell))
    path, mine = folder.run_path(cell) / FINAL, tmp_path / "mine.txt"
    mine.write_text("mine")
    path.unlink()
    if damage == "link":
        path.symlink_to(mine)
    else:
        path.write_bytes(damage)
    assert not folder.is_finished(cell)
    run(folder, 1)
    assert f"eval {cell.name}" in trace(folder)
    assert folder.is_finished(cell)
    assert mine.read_text() == "mine"


def test_a_run_whose_log_is_a_planted_link_fails_alone(folder, tmp_path):
    mine = tmp_path / "mine.txt"
    mine.write_text("mine")
    bad = folder.study.cells[1]
    folder.prepare(bad)
    (folder.run_path(bad) / LOG).symlink_to(mine)
    scheduler = run(folder)
    assert statuses(scheduler) == ["finished", "failed", "finished", "finished"]
    assert "no regular file is there; remove it" in scheduler.runs[1].message
    assert mine.read_text() == "mine"


def test_a_failed_run_is_reported_and_the_others_go_on_and_the_next_time_it_is_tried_again(folder):
    bad = folder.study.cells[1]
    (folder.path / f"fail-{bad.name}").touch()
    scheduler = run(folder)
    assert scheduler.complete
    assert statuses(scheduler) == ["finished", "failed", "finished", "finished"]
    assert scheduler.runs[1].message == "the disk is on fire"
    (folder.path / f"fail-{bad.name}").unlink()
    before = len(trace(folder))
    assert statuses(run(folder)) == ["finished"] * 4
    assert trace(folder)[before:] == [f"train {bad.name}", f"eval {bad.name}"]


def test_a_run_that_is_something_else_fails_alone(folder):
    path = folder.run_path(folder.study.cells[0])
    path.mkdir(parents=True)
    (path / "thesis.tex").touch()
    scheduler = run(folder)
    assert statuses(scheduler) == ["failed"] + ["finished"] * 3
    assert "is not empty and no run folder" in scheduler.runs[0].message


def test_a_killed_process_is_told_by_its_signal(folder):
    def killer(snapshot):
        first = snapshot.runs[0]
        if first.job is not None and first.step:
            os.kill(first.job.pid, signal.SIGKILL)
        return True

    scheduler = run(folder, 1, LocalEngine(stand_in(0.05)), killer)
    assert scheduler.runs[0].message == "ended by SIGKILL"
    assert statuses(scheduler) == ["failed"] + ["finished"] * 3
    assert statuses(run(folder)) == ["finished"] * 4


def test_a_stop_lets_the_running_ones_end_and_starts_no_other(folder):
    scheduler = run(folder, 1, LocalEngine(stand_in(0.05)), lambda snapshot: snapshot.runs[0].step < 100)
    assert not scheduler.complete
    assert statuses(scheduler) == ["stopped"] * 4
    assert trace(folder) == [f"train {folder.study.cells[0].name}"]
    assert folder.progress(folder.study.cells[0])[0] >= 100
    resumed = run(folder)
    assert statuses(resumed) == ["finished"] * 4
    steps = (folder.run_path(folder.study.cells[0]) / "metrics.jsonl").read_text().splitlines()
    assert len(steps) == len(set(steps)) == 4


def test_after_an_interrupt_nothing_is_left_running(folder):
    started = []

    def impatient(snapshot):
        jobs = [run.job for run in snapshot.runs if run.job is not None]
        if jobs:
            started.extend(jobs)
            raise KeyboardInterrupt
        return True

    with pytest.raises(KeyboardInterrupt):
        run(folder, 2, LocalEngine(stand_in(5.0)), impatient)
    assert [job.poll() for job in started] == [-signal.SIGKILL] * 2


def test_a_run_that_a_killed_study_left_behind_is_waited_for_and_not_run_twice(folder):
    cell = folder.study.cells[0]
    orphan = folder.prepare(cell)
    seen = set()
    with subprocess.Popen([*stand_in(0.1), "train", "--resume", str(orphan.path)]):
        while not trace(folder) or not (orphan.path / "metrics.jsonl").stat().st_size:
            time.sleep(0.01)
        scheduler = run(folder, 1, listener=lambda snapshot: seen.add(snapshot.runs[0].status) or True)
    assert "elsewhere" in seen
    assert statuses(scheduler) == ["finished"] * 4
    assert trace(folder).count(f"train {cell.name}") == 1


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process that its parent ended")
def test_a_job_ends_with_the_process_that_started_it(tmp_path):
    waiter = "from esp_cli.studies.engine import follow_parent; follow_parent(); import time; time.sleep(60)"
    parent = (
        "import os, signal, sys, pathlib, time\n"
        "from esp_cli.studies.engine import APPLICATION, LocalEngine\n"
        f"engine = LocalEngine([sys.executable, '-c', {waiter!r}])\n"
        f"print(engine.start([], pathlib.Path({str(tmp_path / 'log')!r})).pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE, text=True) as process:
        child = int(process.stdout.readline())
        process.kill()
    for _ in range(500):
        status = Path(f"/proc/{child}/status")
        if not status.exists() or "State:\tZ" in status.read_text():
            return
        time.sleep(0.05)
    pytest.fail(f"process {child} outlived its parent")


def test_a_job_imports_nothing_from_the_folder_in_which_it_runs(tmp_path):
    for name in ("json", "torch", "random", "esp_cli"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('planted')")
    environment = {name: text for name, text in os.environ.items() if name != "PYTHONSAFEPATH"}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), str(ROOT / "environments")])

    def said(*words: str) -> str:
        done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        return done.stderr

    assert said(*APPLICATION, "--version") == ""
    assert "planted" in said(sys.executable, "-c", "import json")  # negative control


def test_the_last_words_of_a_job_are_its_error_or_its_last_line(tmp_path):
    def words(code: str) -> str:
        job = LocalEngine([sys.executable, "-S", "-c", code]).start([], tmp_path / "log")
        while job.poll() is None:
            time.sleep(0.01)
        return job.last_words()

    assert words("print('a'); print('error: no disk'); print('b')") == "no disk"
    assert words("raise ZeroDivisionError('by hand')") == "ZeroDivisionError: by hand"


def test_when_the_last_job_ends():
    assert makespan([], [], 2) == 0
    assert makespan([], [5, 3, 4], 1) == 12
    # places: 5 | 3, then the third goes behind the 3: 5 | 7
    assert makespan([], [5, 3, 4], 2) == 7
    # two run with 1 and 10 left; 4 and 4 go behind the 1: 9, then 10 is last
    assert makespan([1, 10], [4, 4], 2) == 10


def test_time_left_is_that_of_the_runs_most_alike(folder):
    scheduler = Scheduler(folder, folder.study.cells, 1, LocalEngine(()))
    assert scheduler.left_s() == math.inf
    plain, _, hunt, _ = scheduler.runs
    plain.step, plain.trained_s = 100, 10.0  # of 200 steps, 0.1 s a step
    assert scheduler.left_s() == pytest.approx(0.1 * 700)
    hunt.step, hunt.trained_s = 200, 40.0
    hunt.status = "finished"
    # plain 100 steps and esp 200 of 0.1 s; the hunt with the prior like the hunt, 0.2 s
    assert scheduler.left_s() == pytest.approx(10 + 20 + 40)
