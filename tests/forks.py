"""Forks of this process, which has imported everything, so that a job costs no import; signals are real."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

import scipy.stats  # noqa: F401 - the end of a run needs it, and importing takes longer than the run
import torch.profiler  # noqa: F401 - so does the first step of an optimizer

from esp_cli import app
from esp_cli.algorithms.presets import ALGORITHMS
from esp_cli.networks.build import NETWORKS
from esp_cli.studies import engine
from esp_envs.registry import TASKS
from tests import faults

PATIENCE_S = 240.0

Job = Callable[[Path], None]
"""Trains a run or a study in this folder, or goes on with it."""


def fork(job: Callable[[], None], path: Path, log: Path | None = None, errors: Path | None = None) -> int:
    """Run a job in a fork that leads a group of its own; what it says goes to a file beside the path."""
    log = log or path.with_name("said.txt")
    sys.stdout.flush()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # until the child can answer it
    pid = os.fork()
    if pid:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        return pid
    code = 1
    try:
        os.setsid()
        for number, file in ((1, log), (2, errors or log)):
            os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666), number)
        sys.stdout, sys.stderr = (os.fdopen(fd, "w", 1, closefd=False) for fd in (1, 2))  # pytest has its own
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # this process may be under nohup
        try:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            job()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        except (ValueError, OSError) as failure:
            code = app.report(failure) or 1
        except KeyboardInterrupt:
            code = app.EXIT_INTERRUPTED
        sys.stdout.flush()
    except BaseException:  # a bug; the parent looks for the word Traceback
        os.write(2, traceback.format_exc().encode())
    finally:
        os._exit(code)


def wait(pid: int) -> int:
    """Return the exit code of a fork, negative for a signal; end it if it does not end by itself."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        found, status = os.waitpid(pid, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    os.killpg(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return -999


def killed(job: Callable[[], None], path: Path, rows: Callable[[], int], least: int) -> None:
    """Run a job in a fork and kill it as soon as it has written this many rows."""
    process, deadline = fork(job, path), time.monotonic() + 300
    while rows() < least and time.monotonic() < deadline:
        time.sleep(0.005)
    os.kill(process, signal.SIGKILL)
    assert wait(process) == -signal.SIGKILL, said(path)
    assert rows() >= least


def said(path: Path) -> str:
    """Return what the last process beside a path said."""
    file = path.with_name("said.txt")
    return file.read_text(errors="replace") if file.exists() else ""


def forget_own_code(folder: Path) -> None:
    """Let this process be as one that has imported nothing from a folder."""
    for name, module in sys.modules.copy().items():  # a copy: collecting garbage can remove modules
        if Path(getattr(module, "__file__", None) or "/").parent == folder:
            del sys.modules[name]
    sys.path[:] = [entry for entry in sys.path if entry != str(folder)]
    for table in (ALGORITHMS, NETWORKS, TASKS):
        table._registered.clear()


def forked_esp(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run the application in a folder, in a fork of this process that knows nothing of the code there."""
    out, err = folder / "stdout.txt", folder / "stderr.txt"

    def job() -> None:
        os.chdir(folder)
        forget_own_code(folder)
        engine.LocalEngine = ForkEngine
        app.app(list(words))

    code = wait(fork(job, folder, out, err))
    return subprocess.CompletedProcess(words, code, out.read_text(), err.read_text())


class ForkEngine:
    """Starts the jobs of a study as forks of its process, which take a tenth of the time of a `LocalEngine`'s."""

    def places(self, device: str) -> int:
        """Return how many jobs run side by side by default."""
        return 2

    def start(self, arguments: Sequence[str], log: Path) -> ForkJob:
        """Start one; it is told to stop when its parent ends."""
        os.environ["ESP_PARENT_PROCESS"] = str(os.getpid())

        def job() -> None:
            os.closerange(3, 256)  # the lock of the study is not theirs
            engine.follow_parent()
            forget_own_code(Path.cwd())
            faults.forget()
            app.app(list(arguments))

        return ForkJob(fork(job, log.parent, log), log)


class ForkJob:
    """A fork that runs one command line; see `LocalJob`."""

    def __init__(self, pid: int, log: Path) -> None:
        self.pid, self.log, self._code = pid, log, None

    def poll(self) -> int | None:
        """Return the exit code, or None while it runs."""
        if self._code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self._code = os.waitstatus_to_exitcode(status) if pid else None
        return self._code

    def ask_to_stop(self) -> None:
        """Ask it to end after its iteration."""
        if self.poll() is None:
            os.kill(self.pid, signal.SIGTERM)

    def kill(self) -> None:
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)
            self._code = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])

    def last_words(self) -> str:
        return self.log.read_text(errors="replace")[-300:]
