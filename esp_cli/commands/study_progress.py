"""Live progress of a study: a bar for every running process and one for the whole, or plain lines in a pipe."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from rich.progress import TaskID

from esp_cli import console
from esp_cli.console.progress import LiveProgress
from esp_cli.files.formatting import format_standing

if TYPE_CHECKING:
    from esp_cli.studies.scheduler import Run, Scheduler

LINE_INTERVAL_S = 60.0  # seconds between two plain lines where standard error is no terminal
_SAID = {"training": "training", "evaluating": "evaluating", "elsewhere": "waiting for", "finished": "finished"}


class StudyProgress:
    """Shows how far a scheduler is; a test has a clock of its own."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._last_line_s = clock, -math.inf
        self._seen: dict[str, str] = {}
        self._bars: dict[str, TaskID] = {}
        self._live: LiveProgress | None = None

    def __enter__(self) -> StudyProgress:
        if (live := console.live_progress()) is not None:
            self._total, self._live = live.add_task("", total=1.0, status="whole study"), live
            live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def update(self, scheduler: Scheduler) -> None:
        """Show where all runs are; what changed since the last time is said in a line of its own."""
        self._say_changes(scheduler)
        if self._live is not None:
            self._draw(self._live, scheduler)
        elif (now := self._clock()) - self._last_line_s >= LINE_INTERVAL_S:
            self._last_line_s = now
            for run in scheduler.runs:
                if run.is_active:
                    console.note(f"  {run.cell.name}  {run_status(run)}")
            console.note(whole_status(scheduler))

    def _say_changes(self, scheduler: Scheduler) -> None:
        for run in scheduler.runs:
            name, before = run.cell.name, self._seen.get(run.cell.name)
            self._seen[name] = run.status
            if before == run.status or (before is None and run.status in ("waiting", "finished")):
                continue
            if run.status == "failed":
                console.error(f"{name} failed: {run.message}; the others go on")
            elif run.status == "training" and run.step:
                console.note(f"resuming {name} at {console.format_count(run.step)}")
            elif run.status in _SAID:
                spent = f" after {console.format_duration(run.trained_s)}" if run.status == "finished" else ""
                elsewhere = ", which another process still trains" if run.status == "elsewhere" else ""
                console.note(f"{_SAID[run.status]} {name}{spent}{elsewhere}")

    def _draw(self, live: LiveProgress, scheduler: Scheduler) -> None:
        for run in scheduler.runs:
            name = run.cell.name
            if run.is_active and name not in self._bars:
                self._bars[name] = live.add_task("", total=run.cell.config.steps, status=name)
            if name in self._bars:
                if run.is_active:
                    live.update(self._bars[name], completed=run.step, status=f"{run_status(run)}  {name}")
                else:
                    live.remove_task(self._bars.pop(name))
        live.update(self._total, completed=share(scheduler), status=f"{whole_status(scheduler)}  whole study")


def share(scheduler: Scheduler) -> float:
    """Return the share of all environment steps that is done."""
    total = sum(run.cell.config.steps for run in scheduler.runs)
    done = sum(run.cell.config.steps if run.status == "finished" else run.step for run in scheduler.runs)
    return done / total if total else 1.0


def run_status(run: Run) -> str:
    """Return steps, rate and time left of a run in one line."""
    if run.status == "evaluating":
        return "playing its final evaluation"
    return format_standing(run.step, run.cell.config.steps, run.rate, len(run.cell.config.seeds))


def whole_status(scheduler: Scheduler) -> str:
    """Return how many runs are done, and the time left of the whole study, in one line."""
    failed = scheduler.count("failed")
    parts = [f"{share(scheduler):.0%}", f"{scheduler.count('finished')}/{len(scheduler.runs)} runs finished"]
    parts += [f"{failed} failed"] if failed else []
    return "  ".join([*parts, f"{console.format_duration(scheduler.left_s())} left"])
