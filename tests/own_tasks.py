"""The tasks of docs/own-tasks.md, taken from the page as a reader would."""

from __future__ import annotations

import re
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "own-tasks.md"
_SAVED_BLOCK = re.compile(r"[Ss]ave this as `([\w.]+)`.*?```python\n(.*?)```", re.DOTALL)


def page_files() -> dict[str, str]:
    """Return the files that the page tells its reader to save."""
    return dict(_SAVED_BLOCK.findall(PAGE.read_text(encoding="utf-8")))


def save_page_files(folder: Path) -> None:
    for name, text in page_files().items():
        (folder / name).write_text(text, encoding="utf-8")


def lines_of(text: str) -> int:
    """Lines of a file that are not blank."""
    return sum(bool(line.strip()) for line in text.splitlines())
