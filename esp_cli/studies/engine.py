"""What starts the runs of a study: the interface between the scheduler and this machine or any other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol


class Job(Protocol):
    """One command line of the application that an engine has started."""

    def poll(self) -> int | None:
        """Return the exit code, or None while the job runs."""

    def ask_to_stop(self) -> None:
        """Ask the job to end after its iteration, with a checkpoint."""

    def kill(self) -> None:
        """End the job at once and wait until it is gone."""

    def last_words(self) -> str:
        """Return why the job failed: its last error message, or its last line."""


class Engine(Protocol):
    """Starts jobs. The scheduler reads their progress from the run folders.

    A job that runs on another machine therefore copies what it writes into the folder here.
    """

    def places(self, device: str) -> int:
        """Return how many jobs run side by side by default.

        Args:
            device: on which they train, "cpu" or "cuda".
        """

    def start(self, arguments: Sequence[str], log: Path) -> Job:
        """Start the application with these arguments.

        Args:
            arguments: of the command line, without the program.
            log: file to which all that the job prints is appended.

        Raises:
            OSError: the machine failed.
            UserError: the job cannot be started; the run fails, and the others go on.
        """
