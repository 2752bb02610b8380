"""The reference pages that come from the application itself: its commands, its settings, its tasks."""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterable, Iterator
from typing import Any

import typer

from esp_cli.app import app
from esp_cli.settings_index import Setting, read_index
from esp_cli.symmetry import carried_groups
from esp_envs.registry import make, task_class, task_names


def pages() -> dict[str, str]:
    """Return path -> Markdown of every generated page."""
    return {"reference/commands.md": commands(), "reference/settings.md": settings(), "reference/tasks.md": tasks()}


def commands() -> str:
    """Return the page of all commands with their options, as `--help` says them."""
    text = "# Commands\n\nEvery command says the same in the terminal: `esp COMMAND --help`.\n"
    group: Any = typer.main.get_command(app)
    with group.make_context("esp", ["--help"], resilient_parsing=True) as context:
        for name in group.list_commands(context):
            text += "\n".join(_command(name, group.get_command(context, name)))
    return text


def _command(name: str, command: Any) -> Iterator[str]:
    yield f"\n## esp {name}\n\n{command.help}\n"
    shown = [parameter for parameter in command.params if not getattr(parameter, "hidden", False)]
    yield from _table(("option", "default", "meaning"), [_option(parameter) for parameter in shown])
    if command.epilog:
        lines = [line.strip() for line in command.epilog.splitlines() if line.strip()]
        yield "\n```sh\n" + "\n".join(line for line in lines if line.startswith("esp")) + "\n```\n"


def _option(parameter: Any) -> tuple[str, str, str]:
    # an argument has a name alone; an option has its spellings
    names = (
        [*parameter.opts, *parameter.secondary_opts] if parameter.opts[0].startswith("-") else [parameter.name.upper()]
    )
    default = parameter.default
    default = ",".join(map(str, default)) if isinstance(default, tuple) else default
    shown = "" if default in (None, False, "") or callable(default) else f"`{default}`"
    return " ".join(f"`{name}`" for name in names), shown, parameter.help or ""


def settings() -> str:
    """Return the page of all settings, as `esp settings` lists them."""
    text = (
        "# Settings\n\n`--set NAME=VALUE` changes one setting, `--preset paper` takes the paper's values."
        " `esp settings` prints the same. [Configuration](../configuration.md) says which source of a value wins.\n"
    )
    for section in read_index():
        title = section.name if section.kind in (section.name, "algorithm") else f"{section.kind} {section.name}"
        rows = [
            (
                f"`{s.name}`",
                _written(s.default),
                _elsewhere(s),
                " ".join(filter(None, (s.bounds, s.unit))),
                s.description,
            )
            for s in section.settings
        ]
        header = ("setting", "default", "presets and tasks", "values", "meaning")
        text += f"\n## {title}\n\n" + "\n".join(_table(header, rows))
    return text


def _elsewhere(setting: Setting) -> str:
    """Return what presets and tasks set instead of the default."""
    return ", ".join(f"{name}: {_written(value)}" for name, value in [*setting.presets.items(), *setting.tasks.items()])


def _written(value: object) -> str:
    return "" if value is None else f"`{json.dumps(value)}`".replace('"', "")


def tasks() -> str:
    """Return the page of task cards: the class docstring, the observation and the symmetries of every task."""
    text = "# Tasks\n\nThese are the cards that `esp tasks NAME` prints.\n"
    for name in task_names():
        spec = make(name, 1, [0]).spec
        text += f"\n## {name}\n\n~~~~~~ {{.text .card}}\n{inspect.cleandoc(task_class(name).__doc__ or '')}\n~~~~~~\n\n"
        text += "\n".join(_table(("index", "field", "kind", "unit"), spec.observation.table()))
        text += f"\nSymmetries: {', '.join(carried_groups(spec))}\n"
    return text


def _table(header: tuple[str, ...], rows: Iterable[Iterable[object]]) -> Iterator[str]:
    for row in (header, ("---",) * len(header), *rows):
        yield "| " + " | ".join(str(cell).replace("|", "\\|").replace("\n", " ") for cell in row) + " |"
    yield ""
