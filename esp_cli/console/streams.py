"""Standard output for results, standard error for the person at the screen."""

from __future__ import annotations

import os
import pydoc
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.text import Text


class _Notes(Console):
    """Standard error, which nobody has to read: long work goes on where a pipe behind it has closed."""

    def on_broken_pipe(self) -> None:
        """Say no more."""
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


out = Console(highlight=False)
err = _Notes(stderr=True, highlight=False)


def say(text: str) -> None:
    """Print one line of result on standard output, as it is (no markup, no wrapping)."""
    out.print(Text(text), soft_wrap=True)


def text(content: str) -> None:
    """Print text on standard output; on a terminal, lines break between words and keep their indentation."""
    for line in content.splitlines():
        indent = " " * (len(line) - len(line.lstrip()))
        width = out.width if out.is_terminal else len(line)
        for part in textwrap.wrap(line, max(width, 1), subsequent_indent=indent + "  ", break_long_words=False) or [""]:
            say(part)


def note(text: str) -> None:
    """Print one line for the person at the screen on standard error."""
    err.print(Text(text), soft_wrap=True)


def error(text: str) -> None:
    """Print what went wrong as one line on standard error, whatever line breaks the message came with."""
    err.print(Text.assemble(("error: ", "bold red"), " ".join(text.split())), soft_wrap=True)


@contextmanager
def paged() -> Iterator[None]:
    """Show what is printed in it through the user's pager, on a terminal and where it is longer than the screen."""
    if not (out.is_terminal and sys.stdin.isatty()):
        yield
        return
    with out.capture() as captured:
        yield
    text = captured.get()
    if text.count("\n") < out.height:
        out.file.write(text)
    else:
        os.environ.setdefault("LESS", "-FRX")  # colours, and no empty screen behind it
        pydoc.pager(text)
