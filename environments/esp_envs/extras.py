"""The optional packages: what to install where one is missing."""

from __future__ import annotations

from importlib.metadata import requires

_DISTRIBUTION = "esp-marl"


def install(extra: str) -> str:
    """Return the command that installs what an extra needs, from any index: "pip install 'optuna>=4.2'"."""
    rows = (row.replace('"', "'").split(";") for row in requires(_DISTRIBUTION) or [])
    needed = [row[0].strip() for row in rows if row[-1].strip() == f"extra == '{extra}'"]
    return " ".join(["pip install", *(f"'{package}'" for package in needed)])
