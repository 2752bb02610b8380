"""The only place that prints: results on standard output, progress and errors on standard error.

What a program may read (tables, JSON) goes to standard output; what only a person at the screen wants (progress,
notes, errors) goes to standard error, so that `esp eval RUN --json - | jq` sees nothing but JSON.
"""

from __future__ import annotations

import json
import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from operator import methodcaller
from pathlib import Path

from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from esp_cli.console.progress import TrainingProgress, live_progress, watching
from esp_cli.console.streams import SafeConsole, err, error, fit_encoding, note, out, say, text
from esp_cli.files.formatting import escaped, format_count, format_duration, format_interval, format_mean, format_span
from esp_cli.files.writing import write_file

__all__ = ["TrainingProgress", "err", "error", "fit_encoding", "format_count", "format_duration", "format_interval"]
__all__ += ["format_mean", "format_span", "live_progress", "note", "out", "say", "text"]  # of its parts
__all__ += ["lay_out", "result", "table", "watching", "write_json"]

_LEAST_TEXT = 14  # columns that a longer text gets at least; narrower ones are hard to read
PIPE_WIDTH = 200  # columns of a table written to a file or a pipe, which has no width of its own


def table(
    columns: Sequence[str], rows: Iterable[Sequence[object]], title: str | None = None, caption: str | None = None
) -> None:
    """Print a table on standard output; a heading that ends in ">" (which is cut off) is aligned to the right."""
    target = out if out.is_terminal else SafeConsole(highlight=False, width=PIPE_WIDTH)
    laid = lay_out(columns, [[escaped(str(cell)) for cell in row] for row in rows], target)
    if title:  # outside the grid, which would wrap it to its own width
        target.print(Text(title, style="bold"), soft_wrap=not out.is_terminal)
    for part in laid:
        target.print(part)
    if caption:
        target.print(Text(caption, style="dim"), soft_wrap=not out.is_terminal)


def lay_out(columns: Sequence[str], rows: Sequence[Sequence[str]], console: Console) -> list[Table | Text]:
    """Return what to print so that no line is longer than the console is wide and no name or number is cut.

    A heading that ends in ">" is of numbers; the first column holds names. Where no table fits, each cell has a line.
    """
    plain = {"box": box.SIMPLE_HEAD, "show_edge": False, "padding": (0, 1, 0, 0), "pad_edge": False}
    for style in ({}, plain):
        table = Table(header_style="bold", **style)  # type: ignore[arg-type] # of several kinds
        for k, heading in enumerate(columns):
            name, fixed = heading.removesuffix(">"), heading.endswith(">") or k == 0
            natural = max(map(len, (*([] if fixed else [name]), *(row[k] for row in rows))), default=1)
            least = natural if fixed else min(_LEAST_TEXT, natural)
            right = heading.endswith(">")
            table.add_column(
                Text(name), justify="right" if right else "left", min_width=least, no_wrap=fixed, overflow="fold"
            )
        for row in rows:
            table.add_row(*map(Text, row))
        if Measurement.get(console, console.options.update_width(10_000), table).minimum <= console.width:
            return [table]
    return list(_blocks([heading.removesuffix(">") for heading in columns], rows, console.width))


def _blocks(headings: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> list[Text]:
    lines, label = [], max(map(len, headings[1:]), default=0)
    for name, *cells in rows:
        lines.append(Text(name, style="bold"))
        for heading, cell in zip(headings[1:], cells, strict=True):
            text, indent = f"  {heading:<{label}}  {cell}", " " * (label + 4)
            wrapped = textwrap.wrap(
                text, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
            )
            lines += map(Text, wrapped)
    return lines


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

    Numbers that JSON does not know (NaN, infinities) become null; arrays, tensors, dataclasses, models and paths are
    taken too. See `write_file` for links and devices.
    """
    from pydantic_core import to_jsonable_python  # noqa: PLC0415 - which no help needs

    plain = to_jsonable_python(value, inf_nan_mode="null", fallback=methodcaller("tolist"))
    shown = str(path) == "-"  # in ASCII, which every terminal shows and no control character leaves
    text = json.dumps(plain, indent=2, ensure_ascii=shown, allow_nan=False) + "\n"
    if shown:
        sys.stdout.write(text)
        sys.stdout.flush()
        return
    write_file(path, text.encode())
