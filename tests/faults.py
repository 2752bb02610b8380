"""Faults on purpose: what a kill or a full disk leaves, at the places where something is asked of the operating system.

`Fault("replace", 3, "KILL").plan()` ends this process with SIGKILL at its third renaming of a file;
`Fault("write", 1, "ENOSPC")` fails in the middle of the first write as a full disk does.
"""

import errno
import os
import signal
from dataclasses import dataclass
from typing import Any

import pytest

PLACES = ("write", "fsync", "replace", "replaced", "unlink", "mkdir")
"""Functions of `os`: a fault comes before what they do, of "write" in the middle, of "replaced" behind it."""

_planned = pytest.MonkeyPatch()


def forget() -> None:
    """Let no planned fault come any more, as in a fork that another process is disturbed by."""
    _planned.undo()


@dataclass
class Fault:
    """What to do when a place is reached for the `left`-th time: send a signal (KILL) or raise an error (ENOSPC)."""

    place: str
    left: int
    action: str

    def plan(self, monkeypatch: pytest.MonkeyPatch | None = None) -> None:
        """Let the fault come, in this process; for a test that goes on in it, until its end."""
        name = {"replaced": "replace"}.get(self.place, self.place)
        real = getattr(os, name)

        def function(*args: Any, **kwargs: Any) -> Any:
            if self.place == "replaced":
                real(*args, **kwargs)
                return self._count()
            if self.place == "write" and self.left == 1 and len(args[1]) > 1:
                written = real(args[0], args[1][: len(args[1]) // 2])
                self._count()  # a signal may only be noted, and the call then says that it wrote a part
                return written
            self._count()
            return real(*args, **kwargs)

        (monkeypatch or _planned).setattr(os, name, function)

    def _count(self) -> None:
        self.left -= 1
        if self.left == 0:
            if self.action.startswith("E"):
                number = getattr(errno, self.action)
                raise OSError(number, os.strerror(number))
            os.kill(os.getpid(), getattr(signal, f"SIG{self.action}"))
