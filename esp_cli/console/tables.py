"""Tables that fit their width without cutting a name: columns wrap, then lines go, then each row is a block."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

from rich import box
from rich.table import Table
from rich.text import Text

_LEAST_TEXT = 14  # columns that a longer text gets at least; narrower ones are hard to read


@dataclass(frozen=True)
class Column:
    """A column: its heading, its cells, and how narrow it may become."""

    heading: str
    cells: tuple[str, ...]
    is_number: bool
    is_name: bool

    @property
    def natural(self) -> int:
        """Width without any line break."""
        return max(map(len, (self.heading, *self.cells)))

    @property
    def least(self) -> int:
        """Width that cuts no word; names and numbers never break."""
        heading = _longest_word(self.heading)
        if self.is_number or self.is_name:
            return max(heading, *map(len, self.cells), 1)
        return max(heading, *map(_longest_word, self.cells), min(self.natural, _LEAST_TEXT))


def lay_out(columns: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> Table | list[Text]:
    """Return what to print so that no line is longer than `width` and no word is cut.

    Args:
        columns: headings; one that ends in ">" is of numbers. The first column holds names.
        rows: cells.
        width: of the terminal or the pipe.

    Returns:
        A table, or where no table fits a line per cell.
    """
    parts = [
        Column(heading.removesuffix(">"), tuple(row[k] for row in rows), heading.endswith(">"), k == 0)
        for k, heading in enumerate(columns)
    ]
    least = sum(part.least for part in parts)
    if least <= (room := width - 3 * len(parts) - 1):
        return _table(parts, Table(header_style="bold"), room)
    if least <= (room := width - 2 * (len(parts) - 1)):
        plain = Table(header_style="bold", box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0), pad_edge=False)
        return _table(parts, plain, room)
    return _blocks(parts, width)


def _table(parts: Sequence[Column], grid: Table, room: int) -> Table:
    """Fill a table whose columns share what is left beyond the least widths."""
    widths = [part.least for part in parts]
    wanted = [part.natural - part.least for part in parts]
    left = max(0, room - sum(widths))
    for k in sorted(range(len(parts)), key=lambda k: wanted[k]):
        open_columns = sum(want > 0 for want in wanted)
        share = min(wanted[k], left // max(open_columns, 1))
        widths[k], wanted[k], left = widths[k] + share, 0, left - share
    for part, width in zip(parts, widths, strict=True):
        grid.add_column(part.heading, justify="right" if part.is_number else "left", width=width)
    for row in zip(*(part.cells for part in parts), strict=True):
        grid.add_row(*map(Text, row))
    return grid


def _blocks(parts: Sequence[Column], width: int) -> list[Text]:
    """Return every row as a name with a line per cell below it."""
    lines = []
    label = max((len(part.heading) for part in parts[1:]), default=0)
    for number in range(len(parts[0].cells)):
        lines.append(Text(parts[0].cells[number], style="bold"))
        for part in parts[1:]:
            indent = " " * (label + 4)
            text = f"  {part.heading:<{label}}  {part.cells[number]}"
            wrapped = textwrap.wrap(
                text, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
            )
            lines += [Text(line) for line in wrapped]
    return lines


def _longest_word(text: str) -> int:
    return max((len(word) for word in re.split(r"\s+", text)), default=0)
