"""The only place that prints: results on standard output, progress and errors on standard error.

What a program may read (tables, JSON) goes to standard output; what only a person at the screen wants (progress,
notes, errors) goes to standard error, so that `esp eval RUN --json - | jq` sees nothing but JSON.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from pathlib import Path

from rich.text import Text

from esp_cli.console.progress import TrainingProgress as TrainingProgress
from esp_cli.console.progress import live_progress as live_progress
from esp_cli.console.streams import SafeConsole
from esp_cli.console.streams import err as err
from esp_cli.console.streams import error as error
from esp_cli.console.streams import fit_encoding as fit_encoding
from esp_cli.console.streams import note as note
from esp_cli.console.streams import out as out
from esp_cli.console.streams import paged as paged
from esp_cli.console.streams import say as say
from esp_cli.console.streams import text as text
from esp_cli.console.tables import lay_out
from esp_cli.files.formatting import escaped
from esp_cli.files.formatting import format_count as format_count  # also console's
from esp_cli.files.formatting import format_duration as format_duration  # also console's
from esp_cli.files.formatting import format_interval as format_interval  # also console's
from esp_cli.files.formatting import format_mean as format_mean  # also console's
from esp_cli.files.formatting import format_span as format_span  # also console's
from esp_cli.files.writing import write_file

PIPE_WIDTH = 200  # columns of a table written to a file or a pipe, which has no width of its own


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
    target = out if out.is_terminal else SafeConsole(highlight=False, width=PIPE_WIDTH)
    laid = lay_out(columns, [[escaped(str(cell)) for cell in row] for row in rows], target)
    if title:  # outside the grid, which would wrap it to its own width
        target.print(Text(title, style="bold"), soft_wrap=not out.is_terminal)
    for part in laid:
        target.print(part)
    if caption:
        target.print(Text(caption, style="dim"), soft_wrap=not out.is_terminal)


def result(json: str | None, value: object, show: Callable[[], object]) -> None:
    """Show a result and, where `--json` was given, write it as JSON; "-" leaves nothing else on standard output."""
    if json != "-":
        show()
    if json is not None:
        write_json(json, value)
        if json != "-":
            note(f"json -> {json}")


def write_json(path: str | Path, value: object) -> None:
    """Write a value as JSON, to standard output where `path` is "-".

    Numbers that JSON does not know (NaN, infinities) become null. See `write_file` for links and devices.

    Args:
        path: a file (missing folders are created) or "-".
        value: dicts, sequences, numbers, texts; also arrays, tensors, dataclasses, pydantic models and paths.

    Raises:
        OSError: the file cannot be written.
    """
    shown = str(path) == "-"  # in ASCII, which every terminal shows and no control character leaves
    text = json.dumps(_plain(value), indent=2, ensure_ascii=shown, allow_nan=False) + "\n"
    if shown:
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
