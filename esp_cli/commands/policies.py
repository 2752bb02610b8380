"""`esp policies`: the bundled policies."""

from __future__ import annotations

from typing import Annotated

import typer

from esp_cli import console
from esp_cli.commands.options import JsonOption

EPILOG = """Examples:\n
    esp policies\n
    esp policies formation"""


def policies(
    task: Annotated[str | None, typer.Argument(help="List only the policies of this task.", metavar="[TASK]")] = None,
    json: JsonOption = None,
) -> None:
    """List the bundled policies, with the score of each and the command that trains such a run."""
    from esp_cli.deploy.manifest import bundled_folder, read_bundled

    found = [entry for entry in read_bundled() if task in (None, entry.task)]
    if not found:
        raise ValueError(f"{bundled_folder()} has no policy of {task or 'any task'}; 'esp policies' lists all")
    if json != "-":
        rows = [
            (
                e.name,
                e.task_version,
                console.format_count(e.step),
                f"{e.seed} of {e.chosen_from}",
                f"{e.score.mean:.2f}",
                console.format_interval(e.score.ci95),
                e.score.episodes,
                e.convention,
            )
            for e in found
        ]
        numbers = ("version>", "steps>", "seed>", "return>", "95 % interval>", "episodes>")
        caption = "greedy, interval over episodes; the seed is the best of its run on other episodes"
        console.table(("policy", *numbers, "reward convention"), rows, caption=caption)
        for entry in found if task else ():
            console.say(f"{entry.name}: {entry.command}")
        console.note("esp eval, esp render and esp export take a policy by its name, or by its task")
    if json is not None:
        console.write_json(json, [entry.model_dump(mode="json") for entry in found])
