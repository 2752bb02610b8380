"""What a shell offers, beside commands and options, when the user presses Tab: names, which cost no import of torch."""

from __future__ import annotations

from collections.abc import Callable

import typer

from esp_cli.commands.options import installed_tasks

TASKS = ("navigation", "predator-prey", "formation", "wildlife")
ALGORITHMS = ("mappo", "maddpg", "qmix")
NETWORKS = ("mlp", "gru", "mpn", "empn", "equivariant")
PRESETS = ("default", "fast", "paper")
TRACKERS = ("tensorboard", "wandb", "mlflow")


def policies() -> tuple[str, ...]:
    """Return the bundled policies by task and by name; where none fits, the shell offers files."""
    from esp_cli.policies.bundled import read_bundled

    bundled = read_bundled()
    return tuple(dict.fromkeys([*(entry.task for entry in bundled), *(entry.name for entry in bundled)]))


_NAMES: dict[str, Callable[[], tuple[str, ...]]] = {
    "task": lambda: (*TASKS, *installed_tasks()),
    "tasks": lambda: (*TASKS, *installed_tasks()),
    "algo": lambda: ALGORITHMS,
    "algos": lambda: ALGORITHMS,
    "network": lambda: NETWORKS,
    "preset": lambda: PRESETS,
    "track": lambda: TRACKERS,
    "policy": policies,
    "beside": policies,
    "of": lambda: (*ALGORITHMS, *TASKS, *NETWORKS, "prior", "evaluation"),
}
"""What is offered for an option or argument, by the name of its parameter."""


def offers(parameter: str) -> Callable[[typer.Context, object, str], list[str]] | None:
    """Return what completes a parameter, in the form that click asks for; None where its type does."""
    names = _NAMES.get(parameter)
    if names is None:
        return None
    return lambda _context, _of, incomplete: [name for name in names() if name.startswith(incomplete)]
