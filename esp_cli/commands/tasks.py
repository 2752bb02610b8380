"""`esp tasks`: the tasks, their cards and their symmetries."""

from __future__ import annotations

import inspect
import json as json_text
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any

from typer import Argument

from esp_cli import console
from esp_cli.commands.options import JsonOption, installed_tasks, register_named

CARDS = Path(__file__).with_name("task_cards.json")
"""What `describe` returns for the built-in tasks: the command imports no torch. docs/make_task_cards.py writes it."""
EPILOG = """Examples:\n
    esp tasks\n
    esp tasks navigation"""


def tasks(
    task: Annotated[str | None, Argument(help="Print the card of this task.", metavar="[TASK]")] = None,
    json: JsonOption = None,
) -> None:
    """List the tasks with their symmetries, or print the card of one task."""
    built_in = json_text.loads(CARDS.read_text(encoding="utf-8"))
    names = [task] if task else list(dict.fromkeys((*built_in, *installed_tasks())))
    found = [built_in[name] if name in built_in else describe(name) for name in names]
    shown = [{key: value for key, value in card.items() if key != "card"} for card in found]
    console.result(json, shown[0] if task else shown, lambda: _print_card(found[0]) if task else _print_list(found))


def describe(name: str) -> dict[str, Any]:
    """Return what the command says of a task, which is imported and made."""
    from esp_cli.symmetry import carried_groups
    from esp_envs.registry import make, task_class
    from esp_envs.spec import describe_action

    register_named([name])
    spec, cls = make(name, 1, [0]).spec, task_class(name)
    return {
        "task": name,
        "version": spec.version,
        "convention": spec.convention,
        "agents": spec.num_agents,
        "horizon": spec.horizon,
        "observation": [
            {"index": where, "field": f"{role.name}.{name}" if spec.roles else name, "kind": kind, "unit": unit}
            for role, _ in spec.parts
            for where, name, kind, unit in role.observation.table()
        ],
        "actions": [
            (f"{role.name}: " if spec.roles else "") + " ".join(pair)
            for role, _ in spec.parts
            for pair in describe_action(role.action)
        ],
        "symmetries": list(dict.fromkeys(name for role, _ in spec.parts for name in carried_groups(role))),
        "heuristics": list(cls.heuristics),
        "settings": {
            key: {"default": field.get_default(call_default_factory=True), "description": field.description or ""}
            for key, field in cls.Settings.model_fields.items()
        },
        "card": inspect.cleandoc(cls.__doc__ or ""),
    }


def _print_list(found: list[dict[str, Any]]) -> None:
    rows = [
        (t["task"], t["version"], t["agents"], t["horizon"], ", ".join(t["symmetries"]), t["convention"]) for t in found
    ]
    console.table(("task", "version>", "agents>", "horizon>", "symmetries", "reward convention"), rows)
    console.note("esp tasks NAME prints a task's card")


def _print_card(card: dict[str, Any]) -> None:
    _print_text(card["card"], {row["field"]: row["kind"] for row in card["observation"]})
    if "| index" not in card["card"]:  # a card of others may lack the table
        rows = [tuple(row.values()) for row in card["observation"]]
        console.table(("index>", "field", "kind", "unit"), rows, title="Observation of one agent")
    settings = [(name, s["default"], s["description"]) for name, s in card["settings"].items()]
    console.table(("setting", "default", "meaning"), settings, title="Settings (--set task.NAME=VALUE)")
    console.text(f"Symmetries: {', '.join(card['symmetries'])}")


def _print_text(card: str, kinds: dict[str, str]) -> None:
    """Print the text of a card; its table of the observation gets the kind of each field, and fits the terminal."""
    for is_table, lines in groupby(card.splitlines(), lambda line: line.lstrip().startswith("|")):
        if not is_table:
            console.text("\n".join(lines))
            continue
        heading, _, *rows = ([cell.strip() for cell in line.strip().strip("|").split("|")] for line in lines)
        told = [(row[0], row[1], kinds.get(row[1], ""), *row[2:]) for row in rows]
        console.table((f"{heading[0]}>", heading[1], "kind", *heading[2:]), told)
