"""Progress of one long computation: a live line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import math
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from types import FrameType

from rich.console import RenderableType
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Column
from rich.text import Text

from esp_cli.console.streams import err, note
from esp_cli.files.formatting import format_standing

LINE_INTERVAL_S = 10.0  # seconds between two plain progress lines where standard error is no terminal
RATE_WINDOW_S = 30.0  # seconds over which the shown rate is averaged


class LiveProgress(Progress):
    """A live display with a line per task."""

    above: RenderableType = Text(end="")
    """What is shown above the lines."""

    def get_renderables(self) -> Iterable[RenderableType]:
        yield self.above
        yield from super().get_renderables()


def live_progress() -> LiveProgress | None:
    """Return a live display of each task's field `status` and a bar, or None where standard error is no terminal.

    On a narrow terminal the bar shrinks first, then the status loses its end.
    """
    status = TextColumn("{task.fields[status]}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis"))
    return LiveProgress(status, BarColumn(), console=err) if err.is_terminal else None


class TrainingProgress:
    """Show how far a long computation is: a live bar on a terminal, elsewhere a plain line every ten seconds.

        with TrainingProgress(total=500_000, num_seeds=10) as progress:
            ...
            progress.update(step, {"return": -131.4})

    Steps (or another `unit`) are counted per seed, as `--steps` is; the rate counts those of all seeds together.
    """

    def __init__(
        self,
        total: int,
        num_seeds: int = 1,
        start: int = 0,
        description: str = "train",
        clock: Callable[[], float] = time.monotonic,
        unit: str = "steps",
    ) -> None:
        """Prepare to show progress from `start` (where a resumed run goes on) to `total` steps per seed."""
        self.total = total
        self.num_seeds = num_seeds
        self.description = description
        self.unit = unit
        self._clock = clock
        self._done = start
        self._metrics: dict[str, float] = {}
        self._history: deque[tuple[float, int]] = deque()
        self._last_line_s = -math.inf
        self._shown: int | None = None
        self._live: Progress | None = None

    def __enter__(self) -> TrainingProgress:
        self._history.append((self._clock(), self._done))
        self._live = live_progress()
        if self._live is not None:
            self._task = self._live.add_task("", total=self.total, completed=self._done, status=self.description)
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()
        elif self._shown not in (None, self._done):
            self._print_line()

    def update(self, done: int, metrics: Mapping[str, float] | None = None) -> None:
        """Tell that `done` of the `total` steps per seed are done, and the latest values to show beside the bar."""
        now = self._clock()
        self._done = done
        self._metrics.update(metrics or {})
        self._history.append((now, done))
        while len(self._history) > 2 and now - self._history[1][0] >= RATE_WINDOW_S:
            self._history.popleft()
        if self._live is not None:
            self._live.update(self._task, completed=done, status="  ".join([self.description, *self.parts()]))
        elif now - self._last_line_s >= LINE_INTERVAL_S:
            self._last_line_s = now
            self._print_line()

    def rate(self) -> float:
        """Return the steps of all seeds per second over the last half minute (0 before the first update)."""
        (first_s, first), (last_s, last) = self._history[0], self._history[-1]
        return (last - first) * self.num_seeds / (last_s - first_s) if last_s > first_s else 0.0

    def parts(self) -> list[str]:
        """Return steps, rate and time left together, then each metric."""
        standing = format_standing(self._done, self.total, self.rate(), self.num_seeds, self.unit)
        return [standing, *(f"{name} {value:.4g}" for name, value in self._metrics.items())]

    def _print_line(self) -> None:
        self._shown = self._done
        share = self._done / self.total if self.total else 1.0
        note(f"{self.description}  {share:4.0%}  {'  '.join(self.parts())}")


@contextmanager
def watching(description: str, unit: str) -> Iterator[Callable[..., None]]:
    """Yield what shows how many parts of how many are done, from the first one on: `watch(done, total, unit)`.

    Parts of another unit or total get a bar of their own.
    """
    with ExitStack() as stack:
        bars: list[TrainingProgress] = []

        def watch(done: int, total: int, unit: str = unit) -> None:
            if not bars or (bars[-1].total, bars[-1].unit) != (total, unit):
                stack.close()
                bars.append(stack.enter_context(TrainingProgress(total, description=description, unit=unit)))
            bars[-1].update(done)

        yield watch


@contextmanager
def stop_requests(sentence: str) -> Iterator[list[int]]:
    """Turn the first Ctrl-C (or SIGTERM, or the SIGHUP of a closed terminal) into a request; a second one interrupts.

    A SIGHUP that `nohup` ignores stays ignored. The list that is yielded is empty until the request comes, which is
    answered with the sentence.
    """
    requests: list[int] = []

    def handler(number: int, _frame: FrameType | None) -> None:
        if requests:
            raise KeyboardInterrupt
        requests.append(number)
        with suppress(RuntimeError):  # in the middle of a write to standard error nothing else is written there
            note(f"{sentence} (press Ctrl-C again to stop at once)")

    heard = [signal.SIGINT, signal.SIGTERM]
    heard += [signal.SIGHUP] if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN else []
    previous = {number: signal.signal(number, handler) for number in heard}
    try:
        yield requests
    finally:
        for number, old in previous.items():
            signal.signal(number, old)
