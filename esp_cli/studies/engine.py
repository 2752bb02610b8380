"""What starts the runs of a study: an engine, of this machine or any other, and the one of this machine."""

from __future__ import annotations

import ctypes
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import esp_envs
from esp_cli.files.opening import open_own
from esp_envs.installed import available_cores

_SET_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of Linux's prctl
_PARENT = "ESP_PARENT_PROCESS"
_TAIL_BYTES = 8192
_BOOT = (
    "import sys; sys.path[:] = filter(None, sys.path); "  # a file called random.py in the user's folder is not imported
    "from esp_cli.studies.engine import follow_parent; follow_parent(); from esp_cli.app import main; main()"
)
APPLICATION = (sys.executable, "-c", _BOOT)  # a child process that stops cleanly when the study that started it ends


class Job(Protocol):
    """One command line of the application that an engine has started."""

    def poll(self) -> int | None:
        """Return the exit code, negative for a signal, or None while the job runs."""

    def ask_to_stop(self) -> None:
        """Ask the job to end after its iteration, with a checkpoint."""

    def kill(self) -> None:
        """End the job at once and wait until it is gone."""

    def last_words(self) -> str:
        """Return why the job failed: its last error message, or its last line."""


class Engine(Protocol):
    """Starts jobs. The scheduler reads their progress from the run folders, into which a job elsewhere copies it."""

    def places(self, device: str) -> int:
        """Return how many jobs on a device, "cpu" or "cuda", run side by side by default."""

    def start(self, arguments: Sequence[str], log: Path) -> Job:
        """Start the application with these arguments of its command line; append all that it prints to the log.

        A UserError fails this run, and the others go on; an OSError is the machine's.
        """


class LocalEngine:
    """Starts every job in a process of its own on this machine, none of which outlives this process.

    `program` is the application as a command line, which has to call `follow_parent` first, run in `folder`.
    """

    def __init__(self, program: Sequence[str] = APPLICATION, folder: Path | None = None) -> None:
        self.program, self.folder = tuple(program), folder

    def places(self, device: str) -> int:
        return 1 if device == "cuda" else available_cores()

    def start(self, arguments: Sequence[str], log: Path) -> LocalJob:
        roots = [str(Path(__file__).parents[2]), str(Path(esp_envs.__path__[0]).parent)]
        path = os.pathsep.join([*roots, *filter(None, [os.environ.get("PYTHONPATH")])])
        environment = os.environ | {
            "OMP_NUM_THREADS": "1",
            "PYTHONPATH": path,
            "PYTHONSAFEPATH": "1",  # nor by a process that the job starts, from Python 3.11 on
            "PYTHONUNBUFFERED": "1",
            _PARENT: str(os.getpid()),
        }
        with os.fdopen(open_own(log, os.O_WRONLY | os.O_APPEND), "ab") as file:
            file.write(f"$ {shlex.join(['esp', *arguments])}\n".encode())
            file.flush()
            process = subprocess.Popen(
                [*self.program, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                env=environment,
                cwd=self.folder,
                start_new_session=True,  # Ctrl-C reaches the study alone, which then asks its jobs to stop
            )
        return LocalJob(process, log)


class LocalJob:
    """A process of this machine that runs one command line."""

    def __init__(self, process: subprocess.Popen[bytes], log: Path) -> None:
        self._process, self.log, self.pid, self.poll = process, log, process.pid, process.poll

    def ask_to_stop(self) -> None:
        self._process.send_signal(signal.SIGTERM)  # nothing where it has ended

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def last_words(self) -> str:
        code = self.poll()
        if code is not None and code < 0:
            return f"ended by {signal.Signals(-code).name}"
        with self.log.open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - _TAIL_BYTES))
            written = file.read().decode(errors="replace")
        attempt = f"\n{written}".rpartition("\n$ esp")[2].partition("\n")[2]  # the log holds earlier attempts too
        lines = [line.strip() for line in attempt.splitlines() if line.strip()]
        errors = [line for line in lines if line.startswith("error: ")]
        return (errors or lines or ["it said nothing"])[-1].removeprefix("error: ")


def follow_parent() -> None:
    """Let this process stop cleanly when the one that started it ends; for the jobs of a LocalEngine.

    Only Linux tells; elsewhere it goes on to its own end, and a study that is started again waits for it.
    """
    parent = os.environ.get(_PARENT)
    if parent is None or sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGTERM)
    if os.getppid() != int(parent):  # it ended before this process asked to be told
        raise SystemExit(0)
