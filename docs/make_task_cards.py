"""Write what `esp tasks` says of built-in tasks and robots to a file beside it: python docs/make_task_cards.py."""

from __future__ import annotations

import json

from esp_cli.commands.tasks import CARDS, describe
from esp_envs.errors import UserError
from esp_envs.installed import FURTHER
from esp_envs.registry import TASKS

NAMES = (*(name for name in TASKS if TASKS.ships(name)), *FURTHER["esp.tasks"])


def text() -> str:
    """Return the content of the file."""
    before = json.loads(CARDS.read_text(encoding="utf-8"))
    return json.dumps({name: _card(name, before) for name in NAMES}, indent=1) + "\n"


def _card(name: str, before: dict[str, object]) -> object:
    """Describe a task; one whose package is missing stays as it was."""
    try:
        return describe(name)
    except UserError:
        return before[name]


if __name__ == "__main__":
    CARDS.write_text(text(), encoding="utf-8")
