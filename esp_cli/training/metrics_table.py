"""The metrics of a run as arrays by name."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from esp_envs.errors import UserError

if TYPE_CHECKING:
    import pandas

Floats = NDArray[np.float64]


class Metrics(Mapping[str, Floats]):
    """Metrics by name: one row per update, one column per seed, [U, S]; [U, 1] of what the run has as a whole.

    Example:
        Run("runs/cn").metrics["eval/return_greedy"][-1]  # the last evaluation of each seed

    A number is NaN where it was not measured, or its seed had stopped. The first row is the evaluation before training.

    Args:
        rows: as `esp_cli.training.metrics.read_metrics` returns them.
        seeds: of the run.

    Attributes:
        steps: environment steps per seed at each row, [U].
        seeds: of the columns, [S].
    """

    def __init__(self, rows: Sequence[Mapping[str, Any]], seeds: Sequence[int]) -> None:
        self.seeds = tuple(seeds)
        self.steps: NDArray[np.int64] = np.array([row["step"] for row in rows], dtype=np.int64)
        self._arrays: dict[str, Floats] = {}
        self._whole: set[str] = set()
        for index, row in enumerate(rows):
            for name, value in row.items():
                if name != "step":
                    if name not in self._arrays:
                        columns = len(self.seeds) if isinstance(value, list) else 1
                        self._arrays[name] = np.full((len(rows), columns), math.nan)
                        self._whole |= set() if isinstance(value, list) else {name}
                    self._arrays[name][index] = np.array(value, dtype=np.float64)

    def __getitem__(self, name: str) -> Floats:
        """Return one metric [U, S]."""
        return self._arrays[name]

    def __iter__(self) -> Iterator[str]:
        """Return the names."""
        return iter(self._arrays)

    def __len__(self) -> int:
        """Return the number of metrics."""
        return len(self._arrays)

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
            for name, array in self._arrays.items()
            for column, seed in enumerate(("run",) if name in self._whole else self.seeds)
        }
        table = pd.DataFrame(columns, index=pd.Index(self.steps, name="step"))
        table.columns = table.columns.set_names(["metric", "seed"])
        return table
