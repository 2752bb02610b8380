"""`esp discover`: which symmetries does a task have, or the transitions that somebody recorded?"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from esp_cli import console
from esp_cli.commands.check import print_elements
from esp_cli.commands.options import (
    JsonOption,
    SecondsOption,
    TaskSetOption,
    note_idle_settings,
    parse_task_settings,
    refuse_unused,
    register_named,
)
from esp_envs.errors import UserError

if TYPE_CHECKING:
    from esp_cli.checking import SymmetryReport

EPILOG = """Examples:\n
    esp discover navigation --set task.wind=0.3\n
    esp discover runs/navigation --json found.json\n
    esp discover transitions.npz --task rendezvous:Rendezvous\n
    esp train --task navigation --transforms discovered"""


def discover(
    what: Annotated[
        str, Argument(help="A task, a run folder, or an .npz file of transitions.", metavar="TASK|RUN|FILE")
    ],
    task: Annotated[
        str | None,
        Option("--task", "-t", help="Task whose layout the transitions of a file have, or a run's own module:Class."),
    ] = None,
    transforms: Annotated[str | None, Option("--transforms", help="Elements to try, as d8; by default many.")] = None,
    settings: TaskSetOption = None,
    logs: Annotated[bool, Option("--logs", help="Judge from transitions alone, also where states can be set.")] = False,
    seconds: SecondsOption = 100.0,
    json: JsonOption = None,
) -> None:
    """Find symmetries that nobody declared, and print the --transforms that use them.

    An element is accepted only if the data would have shown a breaking of the tolerance's size. Where they could not,
    it is "not covered".
    """
    found = _discovery(what, task, transforms, parse_task_settings(settings or []), logs, seconds)
    tried = [
        {"element": e.element, "outcome": e.outcome, "accepted": e.outcome == "holds", "p_value": e.p_value}
        | ({"field": e.worst.field, "gap": e.worst.gap, "error": e.worst.error} if e.worst else {"field": e.reason})
        for e in found.elements
    ]
    told = {"source": found.task, "method": found.method, "group": found.found, "transforms": found.transforms}
    console.result(json, {**told, "tried": tried}, lambda: _print(found))


def _discovery(
    what: str, task: str | None, transforms: str | None, settings: dict[str, object], logs: bool, seconds: float
) -> SymmetryReport:
    from esp_cli.checking import check_recorded, check_symmetry
    from esp_cli.checking.recorded import read_transitions
    from esp_cli.training.config import resolve_task_settings
    from esp_cli.training.folder_names import CONFIG
    from esp_envs.registry import make, task_names

    path = Path(what)
    register_named([task, None if path.exists() else what])
    if path.suffix == ".npz" or path.is_file():
        if not path.exists():
            raise UserError(f"there is no file {what}; name one, a run folder, or a task")
        if task is None:
            raise UserError(f"{what} does not say what its numbers are; add --task")
        if logs:
            raise UserError(f"{what} is a file, of which nothing but transitions is known; leave --logs out")
        spec = make(task, 1, [0], resolve_task_settings(task, settings)).spec
        data = read_transitions(path, spec)
        with console.watching("check", "elements") as watch:
            return check_recorded(what, spec, data, transforms, watch, seconds)
    name, whole = what, settings
    is_run = path.is_dir() and (what not in task_names() or (path / CONFIG).is_file())
    if task is not None and not is_run:
        raise UserError(f"--task is for a run, or a file of transitions, and there is no {what}; leave it out")
    if is_run:
        from esp_cli.training.run_folder import RunFolder
        from esp_cli.training.settings import parse_config

        config = parse_config(RunFolder.open(path).config, path)
        name, whole = config.task, config.task_settings | settings
        refuse_unused([config], [task])
    whole = resolve_task_settings(name, whole)
    note_idle_settings(name, settings, whole)
    worlds = partial(make, name, settings=whole)
    with console.watching("check", "elements") as watch:
        return check_symmetry(worlds, transforms, logs, watch, seconds)


def _print(report: SymmetryReport) -> None:
    print_elements(report, f"found {report.found}")
    if report.transforms:
        console.note(f"use it with: --transforms {report.transforms}")
    elif any(element.outcome == "holds" for element in report.elements):
        console.note("what was found has no name that --transforms takes")
    else:
        console.note("nothing that --transforms can name was found: train with --prior none, or with prior.compass")
