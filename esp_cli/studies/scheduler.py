"""The scheduler of studies: runs side by side in processes of their own, resumed and skipped."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from esp_cli.files.formatting import sentence
from esp_cli.studies.engine import Engine, Job
from esp_cli.studies.plan import Cell
from esp_cli.studies.study import StudyFolder
from esp_cli.training.folder_names import LOG
from esp_envs.errors import UserError

Status = Literal["waiting", "training", "evaluating", "elsewhere", "finished", "failed", "stopped"]
POLL_S = 0.5  # seconds between two looks at the running processes


@dataclass
class Run:
    """Where one cell stands."""

    cell: Cell  # of the study
    # "elsewhere" is in use by a process that an earlier, killed scheduler left; it is waited for
    status: Status = "waiting"
    step: int = 0  # environment steps per seed so far
    trained_s: float = 0.0  # seconds of training behind these steps, summed over interruptions
    message: str = ""  # why it failed
    job: Job | None = field(default=None, repr=False)  # its process, if this scheduler started it

    @property
    def is_active(self) -> bool:
        """Whether a process works on it, of this scheduler or of another."""
        return self.status in ("training", "evaluating", "elsewhere")

    @property
    def rate(self) -> float | None:
        """Environment steps of all seeds per second of training, evaluation included; None before there are any."""
        return self.step * len(self.cell.config.seeds) / self.trained_s if self.trained_s > 0 and self.step else None


class Scheduler:
    """Runs cells of a study side by side; its folder says what each of them does next."""

    def __init__(self, folder: StudyFolder, cells: Sequence[Cell], jobs: int, engine: Engine) -> None:
        self.folder, self.jobs, self.engine = folder, jobs, engine
        self.runs = [Run(cell, "finished" if folder.is_finished(cell) else "waiting") for cell in cells]

    def count(self, *statuses: Status) -> int:
        return sum(run.status in statuses for run in self.runs)

    def run(self, listener: Callable[[Scheduler], bool], poll_s: float = POLL_S) -> bool:
        """Run everything that is not finished; a run that fails is left as it is and the others go on.

        The listener is handed this scheduler every `poll_s` seconds; where it returns False, all processes are asked
        to stop cleanly and so does this.
        """
        going = True
        for run in self.runs:
            run.step, run.trained_s = self.folder.progress(run.cell)
        try:
            while True:
                if going:
                    self._fill()
                active = [run for run in self.runs if run.is_active]
                if not listener(self) and going:
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

    def left_s(self) -> float:
        """Return the seconds until the last run ends, from what the runs so far took; infinite where nothing tells."""
        running = [self._seconds_left(run) for run in self.runs if run.is_active]
        return makespan(running, [self._seconds_left(run) for run in self.runs if run.status == "waiting"], self.jobs)

    def _seconds_left(self, run: Run) -> float:
        """Estimate what is left of a run by its own speed, or by that of runs like it."""
        steps = max(0, run.cell.config.steps - run.step)
        if run.status == "evaluating":
            return math.inf  # its final evaluation takes what no training tells
        if run.step and run.trained_s:
            return steps * run.trained_s / run.step
        known = [other for other in self.runs if other.step and other.trained_s]
        alike = [other for other in known if _kind(other) == _kind(run)] or known
        return steps * sum(other.trained_s / other.step for other in alike) / len(alike) if alike else math.inf

    def _fill(self) -> None:
        for run in self.runs:
            if sum(r.is_active for r in self.runs) >= self.jobs:
                return
            if run.status == "waiting":
                self._start(run)

    def _start(self, run: Run) -> None:
        try:
            self.folder.prepare(run.cell)
            if self.folder.is_finished(run.cell):
                run.status = "finished"
                return
            if self.folder.is_in_use(run.cell):
                run.status = "elsewhere"
                return
            arguments = self.folder.next_command(run.cell)
            run.status = "training" if arguments[0] == "train" else "evaluating"
            run.job = self.engine.start(arguments, self.folder.run_path(run.cell) / LOG)
        except (OSError, UserError) as error:
            run.status, run.message = "failed", sentence(error) if isinstance(error, OSError) else str(error)

    def _follow(self, run: Run, going: bool) -> None:
        """Look at a run: how far it is, and whether its process has ended."""
        run.step, run.trained_s = self.folder.progress(run.cell)
        if run.job is None:  # in use by a process that is not ours
            if not self.folder.is_in_use(run.cell):
                run.status = "waiting" if going else "stopped"
        elif (code := run.job.poll()) is not None:
            words, run.job = run.job.last_words(), None
            if self.folder.is_finished(run.cell):
                run.status = "finished"
            elif going and code == 0 and run.status == "training" and self.folder.is_trained(run.cell):
                self._start(run)
            else:
                run.status, run.message = ("failed", words) if going else ("stopped", "")

    def _stop(self) -> None:
        for run in self.runs:
            if run.job is not None:
                run.job.ask_to_stop()
            elif run.status in ("waiting", "elsewhere"):
                run.status = "stopped"


def makespan(running: Sequence[float], waiting: Sequence[float], jobs: int) -> float:
    """Return when the last job ends where each waiting one, in order, takes the first of the places that is free."""
    places = sorted([*running, *[0.0] * max(0, jobs - len(running))])
    for seconds in waiting:
        places = sorted([places[0] + seconds, *places[1:]])
    return max(places, default=0.0)


def _kind(run: Run) -> tuple[object, ...]:
    config = run.cell.config
    return config.task, config.algorithm, config.network.name, len(config.seeds)
