"""The one scheduler of all studies: runs side by side in processes of their own, resumed, skipped and reported.

What is done and what is not is read off the run folders alone, so a study may be killed at any moment, and
the next scheduler goes on with what is there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from esp_cli.files.failures import sentence
from esp_cli.files.locking import is_held
from esp_cli.files.opening import require_held
from esp_cli.files.writing import remove_file
from esp_cli.studies.engine import Engine, Job
from esp_cli.studies.study import Cell, StudyFolder
from esp_cli.training.folder_names import METRICS
from esp_cli.training.metrics import read_last_row
from esp_cli.training.run_folder import RunFolder

Status = Literal["waiting", "training", "evaluating", "elsewhere", "finished", "failed", "stopped"]
POLL_S = 0.5
"""Seconds between two looks at the running processes."""


@dataclass
class Run:
    """Where one cell stands.

    Attributes:
        cell: of the study.
        status: "elsewhere" is in use by a process that an earlier, killed scheduler left; it is waited for.
        step: environment steps per seed so far.
        trained_s: seconds of training behind these steps, summed over interruptions.
        message: why it failed.
    """

    cell: Cell
    status: Status = "waiting"
    step: int = 0
    trained_s: float = 0.0
    message: str = ""
    job: Job | None = field(default=None, repr=False)

    @classmethod
    def found(cls, folder: StudyFolder, cell: Cell) -> Run:
        """Return where a cell stands by its folder alone."""
        run = cls(cell, "finished" if folder.is_finished(cell) else "waiting")
        run.look(folder)
        return run

    def look(self, folder: StudyFolder) -> None:
        """Read from its folder how far the run is; rows past its last checkpoint may go when it is resumed."""
        row = read_last_row(folder.run_path(self.cell) / METRICS)
        self.step = min(int(row.get("step", 0)), self.cell.config.steps)
        elapsed = row.get("time/elapsed_s")
        if isinstance(elapsed, int | float):
            self.trained_s = float(elapsed)

    @property
    def is_active(self) -> bool:
        """Whether a process works on it, of this scheduler or of another."""
        return self.status in ("training", "evaluating", "elsewhere")

    @property
    def rate(self) -> float | None:
        """Environment steps of all seeds per second of training, evaluation included; None before there are any."""
        return self.step * len(self.cell.config.seeds) / self.trained_s if self.trained_s > 0 and self.step else None


@dataclass(frozen=True)
class Snapshot:
    """What a listener is told at every look.

    Attributes:
        runs: all cells, in order.
        left_s: seconds until all are trained, or None where nothing can be said yet.
    """

    runs: Sequence[Run]
    left_s: float | None

    def count(self, *statuses: Status) -> int:
        """Return how many runs have one of these states."""
        return sum(run.status in statuses for run in self.runs)


Listener = Callable[[Snapshot], bool]
"""Told of progress; returns False to ask all running processes to stop after their iteration."""


class Scheduler:
    """Runs the cells of a study side by side; an engine trains each of them, then evaluates it.

    Args:
        folder: of the study, held by the caller's lock.
        cells: those of its cells that are wanted, in order.
        jobs: at once.
        engine: starts them.
    """

    def __init__(self, folder: StudyFolder, cells: Sequence[Cell], jobs: int, engine: Engine) -> None:
        self.folder, self.jobs, self.engine = folder, jobs, engine
        self.runs = [Run.found(folder, cell) for cell in cells]

    def run(self, listener: Listener, poll_s: float = POLL_S) -> bool:
        """Run everything that is not finished.

        A run that fails is left as it is and the others go on.

        Args:
            listener: told at every look.
            poll_s: seconds between two looks.

        Returns:
            Whether it came to its end; False where the listener asked to stop.

        Raises:
            FolderLostError: the folder of the study was moved, replaced or deleted; its processes are ended.
        """
        going = True
        try:
            while True:
                require_held(self.folder.path)
                if going:
                    self._fill()
                active = [run for run in self.runs if run.is_active]
                if not listener(Snapshot(self.runs, self.left_s())) and going:
                    going = False
                    self._stop()
                if not any(run.is_active for run in self.runs):
                    return going
                time.sleep(poll_s)
                for run in active:
                    self._follow(run, going)
        finally:
            for run in self.runs:  # after a second Ctrl-C, or a bug
                if run.job is not None:
                    run.job.kill()

    def left_s(self) -> float | None:
        """Return the seconds until the last run is trained, from what the runs so far took; None where none tells."""
        costs = [(run, self._seconds_left(run)) for run in self.runs if run.is_active or run.status == "waiting"]
        if any(seconds is None for _, seconds in costs):
            return None
        running = [seconds or 0.0 for run, seconds in costs if run.is_active]
        waiting = [seconds or 0.0 for run, seconds in costs if not run.is_active]
        return makespan(running, waiting, self.jobs)

    def _seconds_left(self, run: Run) -> float | None:
        """Estimate what is left of a run by its own speed, or by that of the runs that are most like it."""
        steps = max(0, run.cell.config.steps - run.step)
        own = run.trained_s / run.step if run.step and run.trained_s else None
        if own is None:
            known = [r for r in self.runs if r.step and r.trained_s]
            if not known:
                return None
            best = max(likeness(run.cell, r.cell) for r in known)
            alike = [r.trained_s / r.step for r in known if likeness(run.cell, r.cell) == best]
            own = sum(alike) / len(alike)
        return steps * own

    def _fill(self) -> None:
        """Start waiting runs while there is room."""
        for run in self.runs:
            if sum(r.is_active for r in self.runs) >= self.jobs:
                return
            if run.status == "waiting":
                self._start(run)

    def _start(self, run: Run) -> None:
        """Start the next process of a run, if anything is left to do."""
        cell, folder = run.cell, self.folder
        run.job = None
        if folder.is_finished(cell):
            run.status = "finished"
            return
        try:
            run_folder = folder.prepare(cell)
            if is_held(run_folder.lock_path):
                run.status = "elsewhere"
                return
            path = str(run_folder.path)
            if folder.is_trained(cell):
                run.status = "evaluating"
                arguments = ["eval", path, "--episodes", str(folder.study.episodes)]
                arguments += ["--json", str(folder.evaluation_path(cell))]
            else:
                run.status, arguments = "training", ["train", "--resume", path]
            arguments += cell.config.own_words()  # a job imports what the study's command line names, not its folder
            if run.status != "training":  # a damaged evaluation is made again, and a link there is not followed
                remove_file(folder.evaluation_path(cell))
            run.job = self.engine.start(arguments, folder.log_path(cell))
        except OSError as error:
            run.status, run.message = "failed", sentence(error)
        except ValueError as error:
            run.status, run.message = "failed", str(error)

    def _follow(self, run: Run, going: bool) -> None:
        """Look at a run: how far it is, and whether its process has ended."""
        run.look(self.folder)
        if run.job is None:  # in use by a process that is not ours
            if not is_held(RunFolder.open(self.folder.run_path(run.cell)).lock_path):
                run.status = "waiting"
        elif (code := run.job.poll()) is not None:
            done = self.folder.is_trained if run.status == "training" else self.folder.is_finished
            if code == 0 and done(run.cell):
                if going:
                    self._start(run)  # what comes after training, or nothing
                else:
                    run.status = "finished" if self.folder.is_finished(run.cell) else "stopped"
            elif going:
                run.status, run.message = "failed", run.job.last_words()
            else:
                run.status = "stopped"
            if not run.is_active:
                run.job = None
        if not going and run.job is None and run.status in ("elsewhere", "waiting"):
            run.status = "stopped"

    def _stop(self) -> None:
        """Ask every process to stop; what waits stays as it is."""
        for run in self.runs:
            if run.job is not None:
                run.job.ask_to_stop()
            elif run.status in ("waiting", "elsewhere"):
                run.status = "stopped"


def makespan(running: Sequence[float], waiting: Sequence[float], jobs: int) -> float:
    """Return when the last job ends where each waiting one, in order, takes the first place that becomes free.

    Args:
        running: seconds left of each that runs.
        waiting: seconds of each that waits.
        jobs: places.
    """
    places = sorted([*running, *[0.0] * max(0, jobs - len(running))])
    for seconds in waiting:
        places = sorted([places[0] + seconds, *places[1:]])
    return max(places, default=0.0)


def likeness(a: Cell, b: Cell) -> int:
    """Return how alike two runs are in what decides their speed, the heaviest first."""
    first, second = a.config, b.config
    same = (
        first.task == second.task,
        first.algorithm == second.algorithm,
        first.network == second.network,
        len(first.seeds) == len(second.seeds),
        first.prior.augments == second.prior.augments,
        first.prior.copies == second.prior.copies and first.prior.transforms == second.prior.transforms,
    )
    return sum(2 ** (len(same) - k) for k, equal in enumerate(same) if equal)
