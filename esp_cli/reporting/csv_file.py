"""Every logged number of some runs as one CSV table: a row per run, seed and update."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from esp_cli.files.writing import write_file
from esp_cli.training.metrics import read_metrics
from esp_cli.training.run_folder import RunFolder

_KEYS = ("run", "seed", "step")


def write_csv(path: Path, runs: Mapping[str, Path]) -> int:
    """Write the metrics of runs; a cell without a number is empty, a number of the whole run stands with every seed.

    Args:
        path: of the file.
        runs: run folders by name; those that have not begun are left out.

    Returns:
        The number of rows.

    Raises:
        UserError: a metrics file is damaged.
    """
    rows = [row for name, folder in runs.items() for row in _rows(name, folder)]
    names = sorted({key for row in rows for key in row} - set(_KEYS))
    text = io.StringIO()
    writer = csv.DictWriter(text, (*_KEYS, *names), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_file(path, text.getvalue().encode())
    return len(rows)


def _rows(name: str, folder: Path) -> Iterable[dict[str, Any]]:
    opened = RunFolder.open(folder) if folder.is_dir() else None
    if opened is None or not opened.metrics_path.is_file():
        return
    seeds = opened.config["seeds"]
    for row in read_metrics(opened.metrics_path):
        for index, seed in enumerate(seeds):
            cells = {key: _of_seed(value, index) for key, value in row.items() if key != "step"}
            yield {"run": name, "seed": seed, "step": row["step"], **cells}


def _of_seed(value: Any, index: int) -> Any:
    if not isinstance(value, list):
        return value
    return value[index] if index < len(value) else None
