"""Metrics of a run: one JSON line per update, with one number per seed, written as it happens and read back as arrays.

A row is ``{"step": 12800, "train/policy_loss": [0.1, 0.2], "time/steps_per_second": 51000.0}``: ``step`` counts env
steps per seed, a list has one number per seed, a bare number belongs to the run as a whole. What is not finite is
``null``. A file that is missing, damaged elsewhere than at its end, or not to be written is a UserError.
"""

from __future__ import annotations

import contextlib
import difflib
import itertools
import json
import math
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from esp_cli.files.formatting import Shown, attempting
from esp_cli.files.opening import open_own, open_regular
from esp_cli.files.writing import replace_file, write_all
from esp_cli.training.trackers import Guarded
from esp_envs.errors import UserError

if TYPE_CHECKING:
    import pandas

Floats = NDArray[np.float64]
Value = float | None | list[float | None] | Tensor
"""What a row may hold under a name: a number, or one per seed; None where there is none, as for a stopped seed."""
RETURN = "eval/return_greedy"  # name of the returns of greedy evaluations
_MAX_LINE_BYTES = 16 * 2**20  # what is longer was not written by this program
_TAIL_BYTES = 2**18  # longer than most lines


class MetricsWriter:
    """Appends rows to a JSONL file that `truncate_metrics` has mended, and hands each to trackers, closed with it."""

    def __init__(self, path: str | os.PathLike[str], trackers: Sequence[Guarded] = ()) -> None:
        self._path, self._trackers = Path(path), trackers
        with attempting("write", self._path):
            self._descriptor = open_own(self._path, os.O_WRONLY | os.O_APPEND)

    def __enter__(self) -> MetricsWriter:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._descriptor)
        for tracker in self._trackers:
            tracker.close()

    def write(self, step: int, values: Mapping[str, Value], without: Collection[int] = ()) -> dict[str, Any]:
        """Append one row at a step: by name ("train/...", "eval/...", "time/...") a number, or one per seed [S].

        Return the row, in which the seeds at the places `without` have no numbers.
        """
        row: dict[str, Any] = {}
        for name, value in values.items():
            if name == "step":
                raise UserError("'step' is the row's own column; give the metric another name")
            row[name] = numbers = _plain(name, value)
            if isinstance(numbers, list):
                row[name] = [None if k in without else number for k, number in enumerate(numbers)]
        line = json.dumps({"step": int(step), **row}, allow_nan=False, separators=(",", ":")).encode() + b"\n"
        with attempting("write", self._path):
            write_all(self._descriptor, line)
        for tracker in self._trackers:
            tracker.write(int(step), row)
        return row


def read_metrics(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """Read the rows of a metrics file, leaving out a torn last line."""
    return [row for _, row in _rows(Path(path))]


def read_last_row(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the newest whole row of a metrics file that may be in use; empty where there is none yet."""
    size, row = _TAIL_BYTES, None
    with contextlib.suppress(OSError), open_regular(path) as file:
        end = start = file.seek(0, os.SEEK_END)
        while row is None and start > 0 and size <= 2 * _MAX_LINE_BYTES:
            start = file.seek(max(0, end - size))
            lines = reversed(file.read().split(b"\n"))
            row = next((row for row in map(_parse, lines) if row is not None), None)
            size *= 2
    return row or {}


def truncate_metrics(path: str | os.PathLike[str], last_step: int) -> None:
    """Rewrite a metrics file, or make it, without a torn last line and the rows past the step of a checkpoint."""
    path = Path(path)
    with attempting("write", path):
        os.close(open_own(path, os.O_WRONLY))
    kept = b"".join(line + b"\n" for line, row in _rows(path) if row["step"] <= last_step)
    with attempting("write", path):
        replace_file(path, kept)


def column(rows: Sequence[Mapping[str, Any]], name: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the steps [K] and values [K, S] of one metric in the rows of a run; a UserError says that there is none.

    Rows without it are left out, ``null`` is NaN, a bare number is a value of one seed.
    """
    found = [(row["step"], row[name]) for row in rows if name in row]
    if not found:
        names = sorted({key for row in rows for key in row if key != "step"})
        near = difflib.get_close_matches(name, names, 3, 0.4) or names[:3]
        hint = f"; there is {', '.join(near)}" if near else ", and no other metric either"
        raise UserError(f"no row has the metric '{name}'{hint}")
    lists = [value if isinstance(value, list) else [value] for _, value in found]
    if len({len(numbers) for numbers in lists}) > 1:
        raise UserError(f"the rows of '{name}' differ in the number of seeds")
    try:
        values = np.array([[math.nan if v is None else float(v) for v in numbers] for numbers in lists])
    except (TypeError, ValueError, OverflowError):
        raise UserError(f"the rows of '{name}' hold a value that is not a number") from None
    return np.array([step for step, _ in found], dtype=np.int64), values


class Metrics(Shown, dict[str, Floats]):
    """Metrics by name: one row per update, one column per seed, [U, S]; [U, 1] of what the run has as a whole.

    Example:
        Run("runs/cn").metrics["eval/return_greedy"][-1]  # the last evaluation of each seed

    A number is NaN where it was not measured, or its seed had stopped. The first row is the evaluation before training.

    Args:
        rows: as `read_metrics` returns them.
        seeds: of the run.

    Attributes:
        steps: environment steps per seed at each row, [U].
        seeds: of the columns, [S].
    """

    def __init__(self, rows: Sequence[Mapping[str, Any]], seeds: Sequence[int]) -> None:
        self.seeds = tuple(seeds)
        self.steps: NDArray[np.int64] = np.array([row["step"] for row in rows], dtype=np.int64)
        kinds = {name: type(value) for row in rows for name, value in row.items() if name != "step"}
        self._whole = {name for name, kind in kinds.items() if kind is not list}
        for name in kinds:
            _, values = column(rows, name)
            if name not in self._whole and values.shape[1] != len(self.seeds):
                raise UserError(
                    f"the metrics are damaged: '{name}' has {values.shape[1]} seeds, the run {len(self.seeds)}"
                )
            self[name] = np.full((len(rows), values.shape[1]), math.nan)
            self[name][[name in row for row in rows]] = values

    def _facts(self) -> Mapping[str, object]:
        """Return what there is, and the newest mean over seeds of what was evaluated."""
        last = {name: array[np.isfinite(array).all(1)][-1:] for name, array in self.items() if "eval/" in name}
        newest = {name: f"{rows.mean():.4g}" for name, rows in last.items() if rows.size}
        what = (
            f"{len(self.steps)} of {len(self)} names, steps {self.steps.min(initial=0)} to {self.steps.max(initial=0)}"
        )
        return {"rows": what, "seeds": ", ".join(map(str, self.seeds)), **newest}

    def to_pandas(self) -> pandas.DataFrame:
        """Return a table indexed by steps, with columns (metric, seed); "run" stands for what the run has as a whole.

        Raises:
            UserError: pandas is not installed.
        """
        try:
            import pandas as pd  # noqa: PLC0415 - not a dependency
        except ImportError:
            raise UserError("to_pandas needs pandas, which is not installed: pip install pandas") from None
        columns = {
            (name, seed): array[:, column]
            for name, array in self.items()
            for column, seed in enumerate(("run",) if name in self._whole else self.seeds)
        }
        table = pd.DataFrame(columns, index=pd.Index(self.steps, name="step"))
        table.columns = table.columns.set_names(["metric", "seed"])
        return table


def elapsed_s(row: Mapping[str, Any]) -> float:
    """Return the seconds of training up to a row; 0 where it states no number."""
    seconds = row.get("time/elapsed_s")
    return float(seconds) if isinstance(seconds, int | float) else 0.0


def _plain(name: str, value: Value) -> float | list[float | None] | None:
    """Return a number, or a list of numbers, with None where it is not finite."""
    plain = value.tolist() if isinstance(value, Tensor) else value
    numbers = plain if isinstance(plain, list) else [plain]
    if not all(number is None or isinstance(number, int | float) for number in numbers):
        raise UserError(f"the metric '{name}' is neither a number nor a list of one number per seed")
    finite = [None if number is None or not math.isfinite(number) else number for number in numbers]
    return finite if isinstance(plain, list) else finite[0]


def _rows(path: Path) -> Iterator[tuple[bytes, dict[str, Any]]]:
    if not path.is_file():
        raise UserError(f"{path} does not exist or is not a regular file; check the path")
    with attempting("read", path), open_regular(path) as file:
        for number in itertools.count(1):
            line = file.readline(_MAX_LINE_BYTES)
            row = _parse(line)
            if row is not None:
                yield line.removesuffix(b"\n"), row
            elif line.endswith(b"\n") or len(line) == _MAX_LINE_BYTES:
                raise UserError(f"{path} is damaged: line {number} is not a row of metrics; remove that line")
            else:  # the end, or a line that a killed process had not finished
                return


def _parse(line: bytes) -> dict[str, Any] | None:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    # a step beyond 64 bits could not be an array's element
    sound = isinstance(row, dict) and type(row.get("step")) is int and abs(row["step"]) < 2**63
    return row if sound else None
