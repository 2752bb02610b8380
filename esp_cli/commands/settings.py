"""`esp settings`: every setting with its default, its bounds, its unit and what it does."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated

from typer import Argument

from esp_cli import console
from esp_cli.commands.options import JsonOption, installed_tasks
from esp_cli.files.formatting import did_you_mean
from esp_envs.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from esp_cli.training.settings import Section, Setting

EPILOG = """Examples:\n
    esp settings mappo\n
    esp settings formation\n
    esp settings gru --json -"""


def settings(
    of: Annotated[
        str | None,
        Argument(
            help="Algorithm, task or network (also module:Class), 'prior' or 'evaluation'; by default all but tasks "
            "of robots, from ant to quadruped, and of other packages.",
            metavar="[ALGO|TASK|NETWORK]",
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """List the settings that --set and --config change: default, values, unit and meaning."""
    found = _sections(of)
    console.result(json, found, lambda: _print(found))


def _sections(of: str | None) -> Sequence[Section]:
    from esp_cli.training.settings import own_section, section_of, sections

    if of is not None and ":" in of:
        return [own_section(of)]
    built_in = list(sections())
    found = [section for section in built_in if of in (None, section.name)]
    if found or of is None:
        return found
    installed = installed_tasks()
    if of in installed:
        return [section_of("task", of)]
    names = [*(section.name for section in built_in), *installed]
    hint = did_you_mean(of, names) or f"; there is {', '.join(names)}"
    raise UserError(f"nothing with settings is called '{of}'{hint}")


def _print(sections: Sequence[Section]) -> None:
    for section in sections:
        prefix = section.settings[0].name.rpartition(".")[0] if section.settings else section.name
        option = {"task": "--task", "algorithm": "--algo", "network": "--network"}.get(section.kind)
        title = f"{section.name}: --set {prefix}.NAME=VALUE" + (f", with {option} {section.name}" if option else "")
        rows = [
            (one.name.rpartition(".")[2], _written(one.default), one.bounds or one.type, one.unit, _meaning(one))
            for one in section.settings
        ]
        console.table(("setting", "default", "values", "unit", "meaning"), rows, title=title)


def _meaning(setting: Setting) -> str:
    told = "paper" if "paper:" in setting.description else None
    changed = {name: value for name, value in setting.presets.items() if name.split()[-1] != told}
    texts = [f"{name} {_written(value)}" for name, value in {**changed, **setting.tasks}.items()]
    return f"{setting.description} ({'; '.join(texts)})" if texts else setting.description


def _written(value: object) -> str:
    if value is None or isinstance(value, str):
        return value or "-"
    return f"{value:g}" if isinstance(value, float) else json.dumps(value, separators=(",", ":"))
