"""What a metrics sink is, and the guard that keeps a failing one from stopping a run."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

Row = Mapping[str, Any]
"""Metrics by name: a number, None, or a list with one of them per seed."""


class Sink(Protocol):
    """Takes the rows of a run's metrics as they come."""

    def write(self, step: int, values: Row) -> None:
        """Take one row at a step (environment steps per seed)."""

    def close(self) -> None:
        """Flush and close; nothing is written afterwards."""


@dataclass(frozen=True)
class TrackedRun:
    """What a tracker knows of a run.

    Attributes:
        folder: of the run; a tracker writes below it and nowhere else.
        seeds: of the run, in the order of the metrics.
        config: the resolved configuration.
        first_step: rows after this step are written again by a resumed run.
    """

    folder: Path
    seeds: tuple[int, ...]
    config: Mapping[str, Any]
    first_step: int = 0


class Guarded:
    """A sink that hands rows to a tracker until the tracker fails; the failure becomes one sentence for the user.

    Args:
        name: of the tracker.
        make: opens it.
        tell: takes the sentence.
    """

    def __init__(self, name: str, make: Callable[[], Sink], tell: Callable[[str], None]) -> None:
        self._name, self._tell = name, tell
        self._tracker: Sink | None = None
        self._attempt("open", lambda: setattr(self, "_tracker", make()))

    def write(self, step: int, values: Row) -> None:
        """Hand over one row, unless the tracker has failed before."""
        if (tracker := self._tracker) is not None:
            self._attempt("write", lambda: tracker.write(step, values))

    def close(self) -> None:
        """Close the tracker, unless it has failed before."""
        if (tracker := self._tracker) is not None:
            self._attempt("close", tracker.close)

    def _attempt(self, verb: str, action: Callable[[], None]) -> None:
        try:
            action()
        except Exception as error:  # a tracker is foreign code: whatever it raises, the run goes on
            failed, self._tracker = self._tracker, None
            if failed is not None and verb == "write":
                with contextlib.suppress(Exception):
                    failed.close()
            reason = next(iter(str(error).splitlines()), "") or type(error).__name__
            self._tell(f"tracking with {self._name} ended: it cannot {verb} ({reason[:200]}); the run goes on")


def scalars(values: Row, seeds: tuple[int, ...]) -> Iterator[tuple[str, int | None, float]]:
    """Yield name, seed and number of a row's metrics: the mean over seeds, where the seed is None, then each seed's.

    A metric is left out where any seed has no number, as the mean would be of other seeds than before.
    """
    for name, value in values.items():
        numbers = value if isinstance(value, list) else [value]
        if not numbers or any(number is None for number in numbers):
            continue
        yield name, None, sum(numbers) / len(numbers)
        if len(numbers) == len(seeds) > 1:
            yield from ((name, seed, number) for seed, number in zip(seeds, numbers, strict=True))
