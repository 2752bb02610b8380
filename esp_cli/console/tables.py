"""Tables that fit their width without cutting a name: columns wrap, then lines go, then each row is a block."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

_LEAST_TEXT = 14  # columns that a longer text gets at least; narrower ones are hard to read


def lay_out(columns: Sequence[str], rows: Sequence[Sequence[str]], console: Console) -> list[Table | Text]:
    """Return what to print so that no line is longer than the console is wide and no word is cut.

    Args:
        columns: headings; one that ends in ">" is of numbers. The first column holds names.
        rows: cells.
        console: on which it is printed.

    Returns:
        A table, or where no table fits a line per cell.
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
    """Return every row as a name with a line per cell below it."""
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
