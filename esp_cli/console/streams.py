"""Standard output for results, standard error for the person at the screen.

Whatever a file or a command line brought into a text, no control character of it reaches the terminal.
"""

from __future__ import annotations

import io
import os
import sys
import textwrap
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.segment import Segment
from rich.text import Text

from esp_cli.files.formatting import escaped


class SafeConsole(Console):
    """A console that shows the control characters of texts and obeys only those of rich itself."""

    def render(self, *args: Any, **kwargs: Any) -> Iterable[Segment]:
        """Render as rich does; the place through which all that is printed goes."""
        for segment in super().render(*args, **kwargs):
            shown = segment.text if segment.control else escaped(segment.text)
            yield segment if shown == segment.text else Segment(shown, segment.style)


class _StandardError:
    """Standard error of the moment, which nobody has to read: long work goes on where it cannot be written to."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @property
    def rich_proxied_file(self) -> _StandardError:
        """What rich writes to while its live line stands in for standard error."""
        return self

    @property
    def _stream(self) -> Any:
        return getattr(sys.stderr, "rich_proxied_file", sys.stderr)

    def write(self, text: str) -> int:
        """Write a text; after a failure (a closed pipe, a full disk, a terminal that has gone) say no more."""
        self._attempt(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        self._attempt(self._stream.flush)

    def _attempt(self, action: Callable[..., object], *arguments: str) -> None:
        try:
            action(*arguments)
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())


out = SafeConsole(highlight=False)
err = SafeConsole(file=_StandardError(), highlight=False)  # type: ignore[arg-type] # a stream in all that rich asks


def fit_encoding() -> None:
    """Let standard output and error write a question mark for what their encoding lacks, or nowhere where closed."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115 - it stays open
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


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
