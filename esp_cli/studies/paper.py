"""What the paper reports, from one data file: table 1, the supplement's rows for other numbers of agents, figure 5c."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

NUM_SEEDS = 10  # seeds behind every number of the paper
_FILE = Path(__file__).with_name("paper.json")


def reported(key: tuple[str, ...] | None) -> tuple[float, float | None] | None:
    """Return a number of the paper by its place, as ("table1", "navigation", "500000", "mappo", "esp"); or None.

    It is the mean episode reward over ten seeds and its standard error, None where it was read off a figure.
    """
    place: Any = _content()
    for part in key or ():
        place = place.get(part) if isinstance(place, dict) else None
    return (place[0], place[1]) if isinstance(place, list) else None


def horizons(task: str) -> tuple[int, ...]:
    """Return the numbers of steps at which table 1 states a task's returns, ascending; none where it does not."""
    return tuple(sorted(int(steps) for steps in _content()["table1"].get(task, {})))


def tasks() -> tuple[str, ...]:
    """Return the tasks of table 1 in its order."""
    return tuple(_content()["table1"])


@cache
def _content() -> dict[str, Any]:
    return json.loads(_FILE.read_text(encoding="utf-8"))
