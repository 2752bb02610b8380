"""Faults on purpose, for tests of what a kill or a full disk leaves: nothing happens unless ESP_FAULT asks for it.

`ESP_FAULT=rename:3:KILL` ends the process with SIGKILL when it comes to the place "rename" for the third time;
`ESP_FAULT=write:1:ENOSPC` fails there as a full disk does.
"""

from __future__ import annotations

import errno
import os
import signal
from dataclasses import dataclass

PLACES = ("write", "fsync", "rename", "renamed", "unlink", "metrics", "evaluation", "policy", "study")
"""Where a process can be told to fail: before each of these, "renamed" is behind the rename."""


@dataclass
class Fault:
    """What to do when a place is reached for the `left`-th time: send a signal (KILL) or raise an error (ENOSPC)."""

    place: str
    left: int
    action: str

    @classmethod
    def parse(cls, text: str) -> Fault | None:
        """Read "place:count:action"; None for an empty text."""
        if not text:
            return None
        place, count, action = text.split(":")
        return cls(place, int(count), action)

    def strike(self) -> None:
        """Count a visit; act at the last one."""
        self.left -= 1
        if self.left == 0:
            if self.action.startswith("E"):
                number = getattr(errno, self.action)
                raise OSError(number, os.strerror(number))
            os.kill(os.getpid(), getattr(signal, f"SIG{self.action}"))


planned = Fault.parse(os.environ.get("ESP_FAULT", ""))
"""The fault of this process; a test that forks sets it in the child."""


def reach(place: str) -> None:
    """Fail here if that is planned."""
    if planned is not None and planned.place == place:
        planned.strike()
