"""Write what `esp tasks` says of the built-in tasks to a file beside the command: python docs/make_task_cards.py."""

from __future__ import annotations

import json

from esp_cli.commands.tasks import CARDS, describe
from esp_envs.registry import TASKS

BUILT_IN = tuple(name for name in TASKS if TASKS.ships(name))


def text() -> str:
    """Return the content of the file."""
    return json.dumps({name: describe(name) for name in BUILT_IN}, indent=1) + "\n"


if __name__ == "__main__":
    CARDS.write_text(text(), encoding="utf-8")
