"""The files of exports that are text with gaps: `templates/NAME.jinja`."""

from __future__ import annotations

from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

RUNTIME = Path(__file__).parent  # of the files that exports bring along as they are
_TEMPLATES = Environment(
    loader=FileSystemLoader(RUNTIME / "templates"),
    undefined=StrictUndefined,
    trim_blocks=True,
    keep_trailing_newline=True,
)


def filled(name: str, **values: object) -> bytes:
    """Return a file whose gaps are filled with values."""
    return _TEMPLATES.get_template(f"{name}.jinja").render(values).encode()
