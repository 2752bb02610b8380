"""The tasks of docs/own-tasks.md and docs/adapters.md, taken from the pages as a reader would."""

import re
from pathlib import Path

PAGES = [Path(__file__).parents[1] / "docs" / name for name in ("own-tasks.md", "adapters.md")]
_SAVED_BLOCK = re.compile(r"[Ss]ave this as `([\w.]+)`.*?```python\n(.*?)```", re.DOTALL)


def page_files() -> dict[str, str]:
    """Return the files that the pages tell their reader to save."""
    return dict(block for page in PAGES for block in _SAVED_BLOCK.findall(page.read_text(encoding="utf-8")))


def save_page_files(folder: Path) -> None:
    for name, text in page_files().items():
        (folder / name).write_text(text, encoding="utf-8")


def lines_of(text: str) -> int:
    """Lines of a file that are not blank."""
    return sum(bool(line.strip()) for line in text.splitlines())
