"""Kills at random moments and at named places; afterwards a run, or a study, equals one that nobody disturbed."""

import gc
import os
import random
import resource
import shutil
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests import faults
from tests.forks import Job, fork, said, wait
from tests.torture.disks import WHY_NOT, can_mount, start_on_full_disk, start_on_read_only_disk
from tests.torture.record import Part
from tests.torture.runs import all_configs, newest_step, run_job, run_state
from tests.torture.studies import forked_study, kill_some, real_study, study_state

SIGNALS = ("KILL", "KILL", "TERM", "INT", "HUP")
ERRORS = ("ENOSPC", "EROFS", "EIO", "EDQUOT")
SIZES = (0, 1000, 10_000, 50_000)
KINDS = ("moment", "moment", "place", "place", "place", "error", "limit", "full", "read-only", "two", "all", "clock")
FAULTS_OF_THE_DISK = (*ERRORS, "limit", "full", "read-only")
"""After these a process ends as it should, or with exit code 1."""
STUDY_SHARE, REAL_STUDY_SHARE = 0.05, 0.3
MAX_INTERRUPTIONS = 5


@dataclass(frozen=True)
class Reference:
    """The end of a run that nobody disturbed, and how long it took."""

    state: str
    seconds: float


class Kills(Part):
    def __init__(self, scratch: Path, seed: int) -> None:
        self.scratch, self.seed = scratch / "kills", seed
        self.scratch.mkdir()
        self.configs = all_configs()
        gc.collect()
        gc.freeze()  # forks do not clean up what is this process's
        self._references: dict[str, Reference] = {}
        if not can_mount():
            print(f"{WHY_NOT}; the size of files is limited instead", flush=True)

    def run(self, number: int) -> str | None:
        """Interrupt a run or a study again and again, let it end, and compare it with one that was not disturbed."""
        rng = random.Random(f"{self.seed} {number}")
        if rng.random() < STUDY_SHARE:
            real = rng.random() < REAL_STUDY_SHARE
            return self._repeat(rng, f"study {real=}", real_study if real else forked_study, study_state)
        name = list(self.configs)[number % len(self.configs)]
        config = self.configs[name]
        return self._repeat(rng, name, lambda path: run_job(path, config), run_state)

    def _repeat(self, rng: random.Random, name: str, job: Job, state: Callable[[Path], str]) -> str | None:
        study = state is study_state
        if name not in self._references:
            path, begun = self.scratch / "reference", time.monotonic()
            code = wait(fork(lambda: job(path), path))
            if code != 0:
                return f"{name}: undisturbed, it ends with exit code {code}: {said(path)}"
            self._references[name] = Reference(state(path), time.monotonic() - begun)
            shutil.rmtree(path)
        reference, path = self._references[name], self.scratch / "run"
        history, newest = [], -1
        for _ in range(rng.randint(1, MAX_INTERRUPTIONS)):
            disturb = kill_some if study and rng.random() < 0.5 else interrupt
            how, code = disturb(rng, job, path, reference.seconds)
            self.done += code != 0
            history.append(f"{how} -> {code}")
            step = newest_step(path)
            wrong_code = how.split()[-1] in FAULTS_OF_THE_DISK and code not in (0, 1)
            if wrong_code or "Traceback" in said(path) or (not study and step < newest):
                return self._lost(f"{name}: after {history}: {said(path)[-1500:]} (step {step}, was {newest})", path)
            newest = step
        for _ in range(2):  # the second time, nothing is left to do
            code = wait(fork(lambda: job(path), path))
            if code != 0:
                return self._lost(f"{name}: after {history} it ends with exit code {code}: {said(path)[-1500:]}", path)
            if state(path) != reference.state:
                return self._lost(f"{name}: after {history} it ends otherwise than undisturbed", path)
        shutil.rmtree(path)
        return None

    def _lost(self, text: str, path: Path) -> str:
        kept = Path.cwd() / f"torture-kill-{time.time_ns()}"
        shutil.move(path, kept)
        return f"{text} (kept as {kept.name})"


def interrupt(rng: random.Random, job: Job, path: Path, seconds: float) -> tuple[str, int]:
    """Start a job and disturb it in one of several ways; return which, and the exit code."""
    kind, name, size = rng.choice(KINDS), rng.choice(SIGNALS), rng.choice(SIZES)
    if kind in ("place", "error"):
        action = name if kind == "place" else rng.choice(ERRORS)
        fault = faults.Fault(rng.choice(faults.PLACES), rng.choice((1, 1, 2, 3, 5, 8, 13)), action)
        text = f"{fault.place} {fault.left} {fault.action}"
        return text, wait(fork(lambda: _with(job, path, fault=fault), path))
    if kind == "full" and can_mount():
        return f"{size} bytes, then full", wait(start_on_full_disk(job, path, size))
    if kind == "read-only" and can_mount():
        return kind, wait(start_on_read_only_disk(job, path))
    if kind in ("limit", "full", "read-only"):
        return f"files of {size} bytes, limit", wait(fork(lambda: _with(job, path, file_bytes=size), path))
    back = kind == "clock"
    first = fork(lambda: _with(job, path, clock_back=back), path)
    if kind == "two":
        second = fork(lambda: job(path), path, path.with_name("second.txt"))
        wait(second)
    time.sleep(rng.uniform(0, seconds * 1.2))
    try:
        (os.killpg if kind == "all" else os.kill)(first, getattr(signal, f"SIG{name}"))
    except ProcessLookupError:
        return f"{kind}, too late", wait(first)
    return f"{kind} {name}", wait(first)


def _with(
    job: Job, path: Path, fault: faults.Fault | None = None, file_bytes: int = -1, clock_back: bool = False
) -> None:
    if fault is not None:
        fault.plan()
    if file_bytes >= 0:
        resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, resource.RLIM_INFINITY))
    if clock_back:
        real = time.time
        time.time = lambda: real() - 86_400 * (1 + real() % 7)
    job(path)
