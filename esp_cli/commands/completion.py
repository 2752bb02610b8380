"""What a shell offers when the user presses Tab: tasks, algorithms, networks, policies, and the names of settings.

All of it comes from files, so that an answer needs neither torch nor a task.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import typer

from esp_cli.commands.options import installed_tasks
from esp_cli.settings_index import read_index

_SHARED = ("prior", "evaluation")


def tasks(_: typer.Context, incomplete: str) -> list[str]:
    """Offer the tasks, those of other packages included."""
    return _starting(incomplete, [*_names("task"), *installed_tasks()])


def algorithms(_: typer.Context, incomplete: str) -> list[str]:
    """Offer the learning algorithms."""
    return _starting(incomplete, _names("algorithm"))


def networks(_: typer.Context, incomplete: str) -> list[str]:
    """Offer the networks."""
    return _starting(incomplete, _names("network"))


def configured(_: typer.Context, incomplete: str) -> list[str]:
    """Offer everything that has settings."""
    return _starting(incomplete, [section.name for section in read_index()])


def presets(_: typer.Context, incomplete: str) -> list[str]:
    """Offer the presets."""
    return _starting(incomplete, ["default", "fast", "paper"])


def settings(context: typer.Context, incomplete: str) -> list[str]:
    """Offer the settings of the task, the learner and the network that the command line names so far.

    A command that trains nothing takes settings of the task alone. Where it does not name one that is built in, all
    tasks' are offered.
    """
    given, sections = context.params, read_index()
    if "policy" in given or "what" in given:
        tasks = [section.name for section in sections if section.kind == "task"]
        names = [name for name in tasks if name in context.args] or tasks
    else:
        task, algo = given.get("task") or "navigation", given.get("algo") or "mappo"
        names = [*_SHARED, given.get("network") or "mlp", task, algo]
    found = [one.name for section in sections if section.name in names for one in section.settings]
    return [f"{name}=" for name in _starting(incomplete, found)]


def trackers(_: typer.Context, incomplete: str) -> list[str]:
    """Offer the trackers."""
    from esp_cli.training.trackers import TRACKERS

    return _starting(incomplete, [*TRACKERS])


def policies(_: typer.Context, incomplete: str) -> list[str]:
    """Offer the bundled policies by task and by name, and the files and folders here."""
    from esp_cli.policies.bundled import read_bundled

    bundled = read_bundled()
    names = [*(entry.task for entry in bundled), *(entry.name for entry in bundled)]
    return [*_starting(incomplete, names), *_paths(incomplete)]


Completer = Callable[[typer.Context, str], list[str]]
COMPLETERS: dict[str, Completer] = {
    "task": tasks,
    "tasks": tasks,
    "algo": algorithms,
    "algos": algorithms,
    "network": networks,
    "preset": presets,
    "settings": settings,
    "policy": policies,
    "beside": policies,
    "init_from": policies,
    "of": configured,
    "track": trackers,
}
"""What is offered for an option or argument, by its name."""


def _names(kind: str) -> list[str]:
    return [section.name for section in read_index() if section.kind == kind]


def _starting(incomplete: str, names: list[str]) -> list[str]:
    return [name for name in dict.fromkeys(names) if name.startswith(incomplete)]


def _paths(incomplete: str) -> Iterator[str]:
    folder, _, start = incomplete.rpartition("/")
    place = Path(folder or ("/" if incomplete.startswith("/") else "."))
    if place.is_dir():
        for entry in sorted(place.iterdir()):
            shown = f"{folder}/{entry.name}" if "/" in incomplete else entry.name
            if entry.name.startswith(start) and (start.startswith(".") or not entry.name.startswith(".")):
                yield f"{shown}/" if entry.is_dir() else shown
