"""The reference pages that come from the application itself: its commands, settings, tasks and public API."""

from __future__ import annotations

import inspect
import json
import re
import runpy
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import typer

from esp_cli.app import app
from esp_cli.reporting.results import RESULTS_FORMAT, read_results, summarised
from esp_cli.reporting.tables import TABLES
from esp_cli.symmetry import carried_groups
from esp_cli.training.settings import Setting, sections
from esp_envs.registry import make, task_class, task_names

DOCS = Path(__file__).parents[1]
DATA = "measurements/data.md"  # outside the navigation; the page of results leads to it


def pages() -> dict[str, str]:
    """Return path -> Markdown of every generated page."""
    reference = {"commands": commands(), "settings": settings(), "tasks": tasks(), "api": api()}
    return {f"reference/{name}.md": page for name, page in reference.items()} | {DATA: measured()}


def measured() -> str:
    """Return the page of all results files: what made each, and its returns."""
    text = "# Data\n\nThe results files of `docs/measured`: what made each, how long it trained, and its returns.\n"
    for file in sorted((DOCS / "measured").glob("*.json")):
        if RESULTS_FORMAT.is_one(file):
            results = summarised(read_results(file))
            tables = (TABLES[name](results) for name in ("provenance", "returns"))
            text += f"\n## {file.stem}\n\n" + "\n\n".join(table.markdown() for table in tables if table.rows) + "\n"
    return text


def api() -> str:
    """Return the page of the public API."""
    return str(runpy.run_path(str(DOCS / "make_api.py"))["page"]())


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
    for section in sections():
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
    """Return the page of task cards: the class docstring and the symmetries of every task."""
    text = (
        "# Task cards\n\n`esp tasks NAME` prints these cards; [Settings](settings.md) has the settings of the tasks.\n"
    )
    for name in task_names():
        groups = ", ".join(f"`{group}`" for group in carried_groups(make(name, 1, [0]).spec))
        text += f"\n## {name}\n\n{_card(inspect.cleandoc(task_class(name).__doc__ or ''))}\n\n**Carries:** {groups}\n"
    return text


def _card(docstring: str) -> str:
    """Return a card as Markdown: its labels in bold, its indented items as lists, its tables as they are."""
    blocks = []
    for block in re.split(r"\n\s*\n", docstring):
        lines = block.splitlines()
        if lines[0].lstrip().startswith("|"):
            blocks.append("\n".join(line.strip() for line in lines))
            continue
        text = re.sub(r"^([A-Z][^:.`]{2,40}):", r"**\1:**", lines[0])
        for line in lines[1:]:
            item = re.match(r" {4}(?! )([^:]{2,45}):", line)
            start = "\n- " if "\n- " in text else "\n\n- "
            text += f"{start if item else ' '}{line.strip()}"
        blocks.append(text)
    return "\n\n".join(blocks)


def _table(header: tuple[str, ...], rows: Iterable[Iterable[object]]) -> Iterator[str]:
    for row in (header, ("---",) * len(header), *rows):
        yield "| " + " | ".join(str(cell).replace("|", "\\|").replace("\n", " ") for cell in row) + " |"
    yield ""
