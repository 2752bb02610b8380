"""`esp tasks`: the tasks, their cards and their symmetries."""

from __future__ import annotations

import inspect
from typing import Annotated

import typer

from esp_cli import console
from esp_cli.commands.options import JsonOption, register_tasks

EPILOG = """Examples:\n
    esp tasks\n
    esp tasks navigation"""


def tasks(
    task: Annotated[str | None, typer.Argument(help="Print the card of this task.", metavar="[TASK]")] = None,
    json: JsonOption = None,
) -> None:
    """List the tasks with their symmetries, or print the card of one task."""
    from esp_cli.symmetry import carried_groups
    from esp_envs.registry import make, task_class, task_names
    from esp_envs.spec import describe_action

    register_tasks([task] if task else None)
    found = []
    for name in (task,) if task else task_names():
        spec = make(name, 1, [0]).spec
        cls = task_class(name)
        found.append(
            {
                "task": name,
                "version": spec.version,
                "convention": spec.convention,
                "agents": spec.num_agents,
                "horizon": spec.horizon,
                "observation": [
                    dict(zip(("index", "field", "kind", "unit"), r, strict=True)) for r in spec.observation.table()
                ],
                "actions": [" ".join(pair) for pair in describe_action(spec.action)],
                "symmetries": list(carried_groups(spec)),
                "heuristics": list(cls.heuristics),
                "settings": {
                    key: {"default": field.default, "description": field.description or ""}
                    for key, field in cls.Settings.model_fields.items()
                },
            }
        )
    if json != "-":
        if task:
            _print_card(task_class(task), found[0])
        else:
            _print_list(found)
    if json is not None:
        console.write_json(json, found[0] if task else found)


def _print_list(found: list[dict]) -> None:  # type: ignore[type-arg]
    rows = [
        (t["task"], t["version"], t["agents"], t["horizon"], ", ".join(t["symmetries"]), t["convention"]) for t in found
    ]
    console.table(("task", "version>", "agents>", "horizon>", "symmetries", "reward convention"), rows)
    console.note("esp tasks NAME prints a task's card")


def _print_card(cls: type, card: dict) -> None:  # type: ignore[type-arg]
    console.say(inspect.cleandoc(cls.__doc__ or ""))
    console.say("")
    rows = [tuple(row.values()) for row in card["observation"]]
    console.table(("index>", "field", "kind", "unit"), rows, title="Observation of one agent")
    settings = [(name, s["default"], s["description"]) for name, s in card["settings"].items()]
    console.table(("setting", "default", "meaning"), settings, title="Settings (--set task.NAME=VALUE)")
    console.say(f"Symmetries: {', '.join(card['symmetries'])}")
