"""The reference pages that come from the application itself: its commands, its settings, its tasks."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator
from typing import Any, get_args

import typer
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from esp_cli.algorithms.presets import PRESETS, TUNED
from esp_cli.algorithms.registry import ALGORITHMS
from esp_cli.app import app
from esp_cli.networks.build import NETWORKS
from esp_cli.prior import PriorConfig
from esp_cli.symmetry import carried_groups
from esp_cli.training.config import EvaluationConfig
from esp_envs.registry import make, task_class, task_names

_BOUNDS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}


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
    shown = "" if default in (None, False, ()) or callable(default) else f"`{default}`"
    return " ".join(f"`{name}`" for name in names), shown, parameter.help or ""


def settings() -> str:
    """Return the page of all settings with default, the paper's value, bounds and meaning."""
    text = (
        "# Settings\n\n`--set SECTION.NAME=VALUE` changes one setting; `--preset paper` takes the paper's values."
        " A cell of *paper* is empty where the paper's value is the default.\n"
    )
    for name, algorithm in ALGORITHMS.items():
        text += _section(name, algorithm.config_class, name, {name})
        changed = [
            (task, f"`{section}.{key}`", written(value))
            for task, sections in TUNED.get(name, {}).items()
            for section, values in sections.items()
            for key, value in values.items()
        ]
        if changed:
            text += "\nOn these tasks the preset `default` differs:\n\n"
            text += "\n".join(_table(("task", "setting", "default"), changed))
    for name, network in NETWORKS.items():
        text += _section(f"network `{name}`", network, "network", set(ALGORITHMS))
    text += _section("prior", PriorConfig, "prior", set(ALGORITHMS))
    text += _section("evaluation", EvaluationConfig, "evaluation", set(ALGORITHMS))
    for name in task_names():
        text += _section(f"task `{name}`", task_class(name).Settings, "task", set())
    return text


def _section(title: str, model: type[BaseModel], section: str, algorithms: set[str]) -> str:
    rows = []
    for name, field in model.model_fields.items():
        papers = {PRESETS[algorithm]["paper"].get(section, {}).get(name, field.default) for algorithm in algorithms}
        paper = ", ".join(sorted(written(value) for value in papers)) if papers - {field.default} else ""
        rows.append((f"`{section}.{name}`", written(field.default), paper, _allowed(field), field.description or ""))
    header = ("setting", "default", "paper", "allowed", "meaning")
    return f"\n## {title}\n\n" + "\n".join(_table(header, rows))


def written(value: object) -> str:
    """Return a value as `--set` takes it."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ",".join(map(written, value)) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _allowed(field: FieldInfo) -> str:
    """Return the choices of a setting, or its bounds."""
    choices = [choice for choice in get_args(field.annotation) if isinstance(choice, str)]
    bounds = [
        f"{sign} {getattr(m, name):g}" for m in field.metadata for name, sign in _BOUNDS.items() if hasattr(m, name)
    ]
    return ", ".join([f"`{choice}`" for choice in choices] + bounds)


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
