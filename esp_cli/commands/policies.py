"""`esp policies`: the bundled policies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

from typer import Argument

from esp_cli import console
from esp_cli.commands.options import JsonOption
from esp_envs.errors import UserError

if TYPE_CHECKING:
    from esp_cli.policies.bundled import Entry

EPILOG = """Examples:\n
    esp policies\n
    esp policies formation"""


def policies(
    task: Annotated[str | None, Argument(help="List only the policies of this task.", metavar="[TASK]")] = None,
    json: JsonOption = None,
) -> None:
    """List the bundled policies, with the score of each and the command that trains such a run."""
    from esp_cli.policies.bundled import bundled_folder, read_bundled

    entries = [entry for entry in read_bundled() if task in (None, entry.task)]
    if not entries:
        raise UserError(f"{bundled_folder()} has no policy of {task or 'any task'}; 'esp policies' lists all")

    def show() -> None:
        _print(entries)
        for entry in entries if task else ():
            console.say(f"{entry.name}: {entry.command}")
        console.note("esp eval, esp render and esp export take a policy by its name, or by its task")

    console.result(json, entries, show)


def _print(entries: Sequence[Entry]) -> None:
    groups: dict[tuple[str, int, str, int], list[Entry]] = {}
    for entry in entries:
        groups.setdefault((entry.task, entry.task_version, entry.convention, entry.score.episodes), []).append(entry)
    for (task, version, convention, episodes), group in groups.items():
        rows = [
            (
                e.name,
                console.format_count(e.step),
                f"{e.seed} of {e.chosen_from}",
                f"{e.score.mean:.2f}",
                console.format_interval(e.score.ci95),
                console.format_mean(e.normalised),
            )
            for e in group
        ]
        title = f"{task} version {version}, {episodes} episodes; convention {convention}"
        console.table(("policy", "steps>", "seed>", "return>", "95 % interval>", "normalised>"), rows, title=title)
    console.text("Greedy, interval over episodes; the seed is the best of its run on other episodes.")
    console.text("Normalised: 0 the random policy, 1 the best hand-written one.")
