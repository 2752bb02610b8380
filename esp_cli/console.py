"""The only place that prints: results on standard output, progress and errors on standard error.

What a program may read (tables, JSON) goes to standard output; what only a person at the screen wants (progress,
notes, errors) goes to standard error, so that `esp eval RUN --json - | jq` sees nothing but JSON.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table
from rich.text import Text

from esp_cli.files.writing import write_file
from esp_cli.formatting import format_count as format_count  # noqa: PLC0414 # also console's
from esp_cli.formatting import format_duration as format_duration  # noqa: PLC0414 # also console's
from esp_cli.formatting import format_interval as format_interval  # noqa: PLC0414 # also console's
from esp_cli.formatting import format_mean as format_mean  # noqa: PLC0414 # also console's
from esp_cli.formatting import format_span as format_span  # noqa: PLC0414 # also console's

out = Console(highlight=False)
err = Console(stderr=True, highlight=False)

PIPE_WIDTH = 200
"""Columns of a table written to a file or a pipe, which has no width of its own."""
LINE_INTERVAL_S = 10.0
"""Seconds between two plain progress lines where standard error is no terminal."""
RATE_WINDOW_S = 30.0
"""Seconds over which the shown rate is averaged."""


def say(text: str) -> None:
    """Print one line of result on standard output, as it is (no markup, no wrapping)."""
    out.print(Text(text), soft_wrap=True)


def note(text: str) -> None:
    """Print one line for the person at the screen on standard error."""
    err.print(Text(text), soft_wrap=True)


def error(text: str) -> None:
    """Print what went wrong as one line on standard error, whatever line breaks the message came with."""
    err.print(Text.assemble(("error: ", "bold red"), " ".join(text.split())), soft_wrap=True)


def table(
    columns: Sequence[str], rows: Iterable[Sequence[object]], title: str | None = None, caption: str | None = None
) -> None:
    """Print a table on standard output.

    Args:
        columns: headings; a heading that ends in ">" (which is cut off) is aligned to the right.
        rows: one sequence of cells per row; each cell is printed as `str(cell)`.
        title: line above, such as what was measured.
        caption: line below, such as the reward convention.
    """
    grid = Table(header_style="bold")
    for heading in columns:
        grid.add_column(heading.removesuffix(">"), justify="right" if heading.endswith(">") else "left")
    for row in rows:
        grid.add_row(*(Text(str(cell)) for cell in row))
    target = out if out.is_terminal else Console(highlight=False, width=PIPE_WIDTH)
    if title:
        target.print(
            Text(title, style="bold"), soft_wrap=True
        )  # outside the grid, which would wrap it to its own width
    target.print(grid)
    if caption:
        target.print(Text(caption, style="dim"), soft_wrap=True)


def write_json(path: str | Path, value: object) -> None:
    """Write a value as JSON, to standard output where `path` is "-".

    Numbers that JSON does not know (NaN, infinities) become null. See `write_file` for links and devices.

    Args:
        path: a file (missing folders are created) or "-".
        value: dicts, sequences, numbers, texts; also arrays, tensors, dataclasses, pydantic models and paths.

    Raises:
        OSError: the file cannot be written.
    """
    text = json.dumps(_plain(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    if str(path) == "-":
        sys.stdout.write(text)
        sys.stdout.flush()
        return
    write_file(path, text.encode())


def _plain(value: object) -> object:
    """Turn a value into dicts, lists, numbers, texts and None."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    for method in ("model_dump", "tolist"):  # pydantic models; arrays and tensors
        convert = getattr(value, method, None)
        if callable(convert):
            return _plain(convert())
    raise TypeError(f"{type(value).__name__} has no place in JSON")


class TrainingProgress:
    """Show how far a long computation is: a live bar on a terminal, elsewhere a plain line every ten seconds.

        with TrainingProgress(total=500_000, num_seeds=10) as progress:
            ...
            progress.update(step, {"return": -131.4})

    Steps are counted per seed, as `--steps` is; the rate counts the steps of all seeds together.
    """

    def __init__(
        self,
        total: int,
        num_seeds: int = 1,
        start: int = 0,
        description: str = "train",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Prepare to show progress from `start` (where a resumed run goes on) to `total` steps per seed."""
        self.total = total
        self.num_seeds = num_seeds
        self.description = description
        self._clock = clock
        self._start = self._done = start
        self._metrics: dict[str, float] = {}
        self._history: deque[tuple[float, int]] = deque()
        self._last_line_s = -math.inf
        self._shown: int | None = None
        self._live: Progress | None = None

    def __enter__(self) -> TrainingProgress:
        self._begin_s = self._clock()
        self._history.append((self._begin_s, self._start))
        if err.is_terminal:
            self._live = Progress(
                TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[status]}"), console=err
            )
            self._task = self._live.add_task(self.description, total=self.total, completed=self._start, status="")
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()
        elif self._shown not in (None, self._done):
            self._print_line()

    def update(self, done: int, metrics: Mapping[str, float] | None = None) -> None:
        """Tell that `done` of the `total` steps per seed are behind us.

        Args:
            done: steps per seed so far, those before a resume included.
            metrics: the latest values to show beside the bar; earlier ones stay until a new value is told.
        """
        now = self._clock()
        self._done = done
        self._metrics.update(metrics or {})
        self._history.append((now, done))
        while len(self._history) > 2 and now - self._history[1][0] >= RATE_WINDOW_S:
            self._history.popleft()
        if self._live is not None:
            self._live.update(self._task, completed=done, status=self.status())
        elif now - self._last_line_s >= LINE_INTERVAL_S:
            self._last_line_s = now
            self._print_line()

    def rate(self) -> float:
        """Return the steps of all seeds per second over the last half minute (0 before the first update)."""
        (first_s, first), (last_s, last) = self._history[0], self._history[-1]
        return (last - first) * self.num_seeds / (last_s - first_s) if last_s > first_s else 0.0

    def status(self) -> str:
        """Return steps, rate, time left and metrics in one line."""
        rate = self.rate()
        left_s = (self.total - self._done) * self.num_seeds / rate if rate > 0 else math.inf
        parts = [
            f"{format_count(self._done)}/{format_count(self.total)}",
            f"{format_count(rate)} steps/s",
            f"{format_duration(left_s)} left",
            *(f"{name} {value:.4g}" for name, value in self._metrics.items()),
        ]
        return "  ".join(parts)

    def _print_line(self) -> None:
        self._shown = self._done
        share = self._done / self.total if self.total else 1.0
        note(f"{self.description}  {share:4.0%}  {self.status()}")
