"""The settings by section, for people and for completion in a shell, without an import of what they configure.

`python docs/make_settings.py` writes the index from the models; a test holds that it is up to date.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

INDEX = Path(__file__).with_suffix(".json")
Value = bool | int | float | str | Sequence[int] | Mapping[str, float] | None


@dataclass(frozen=True)
class Setting:
    """One setting.

    Attributes:
        name: as `--set` takes it, "mappo.learning_rate".
        type: "integer", "number", "text", "flag", or "list of ...".
        default: where neither preset, task, file nor command line says something else.
        bounds: of its values in words: "from 1", "above 0 to 1", "relu, tanh"; empty for none.
        unit: of its value; empty for a bare number.
        description: what it does.
        presets: values that a preset sets instead, by preset; "fast on navigation" on this task alone.
        tasks: values that the preset default sets on a task instead, by task.
    """

    name: str
    type: str
    default: Value
    bounds: str
    unit: str
    description: str
    presets: Mapping[str, Value]
    tasks: Mapping[str, Value]


@dataclass(frozen=True)
class Section:
    """The settings of one task, algorithm or network, or of every run.

    Attributes:
        name: of the task, the algorithm or the network; "prior" or "evaluation".
        kind: what that is.
        settings: in the order of their model.
    """

    name: str
    kind: Literal["algorithm", "task", "network", "prior", "evaluation"]
    settings: tuple[Setting, ...]


def read_index() -> tuple[Section, ...]:
    """Return the sections of everything that is built in."""
    return tuple(
        Section(stored["name"], stored["kind"], tuple(Setting(**setting) for setting in stored["settings"]))
        for stored in json.loads(INDEX.read_text(encoding="utf-8"))
    )
