"""Forks of this process, which has imported everything, so that a kill costs no import; signals are real."""

from __future__ import annotations

import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import scipy.stats  # noqa: F401 - the end of a run needs it, and importing takes longer than the run
import torch.profiler  # noqa: F401 - so does the first step of an optimizer

from esp_cli import app

PATIENCE_S = 240.0

Job = Callable[[Path], None]
"""Trains a run or a study in this folder, or goes on with it."""


def fork(job: Callable[[], None], path: Path, log: Path | None = None) -> int:
    """Run a job in a fork that leads a group of its own; what it says goes to a file beside the path."""
    log = log or path.with_name("said.txt")
    sys.stdout.flush()
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        os.setsid()
        descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        os.dup2(descriptor, 1)
        os.dup2(descriptor, 2)
        sys.stdout, sys.stderr = (os.fdopen(fd, "w", 1, closefd=False) for fd in (1, 2))  # pytest has its own
        signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
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


def said(path: Path) -> str:
    """Return what the last process beside a path said."""
    file = path.with_name("said.txt")
    return file.read_text(errors="replace") if file.exists() else ""
