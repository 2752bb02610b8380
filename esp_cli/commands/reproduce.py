"""`esp reproduce`: the paper's tables, from training to the numbers."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from esp_cli.commands.options import DeviceOption, EpisodesOption, JsonOption, SeedsOption, SetOption
from esp_cli.commands.study_options import (
    DEFAULT_EPISODES,
    DEFAULT_PRESET,
    DEFAULT_SEEDS,
    AlgosOption,
    DryRunOption,
    JobsOption,
    PresetOption,
    ReuseOption,
    StudyChoices,
    StudyOutOption,
    StudyStepsOption,
    TasksOption,
)
from esp_cli.commands.studying import run_study

EPILOG = """Examples:\n
    esp reproduce table1 --dry-run\n
    esp reproduce table1 --steps 500k --seeds 10 --out runs/table1\n
    esp reproduce table1 --tasks navigation,predator-prey --algos mappo --steps 500k,3M\n
    esp reproduce agents --algos qmix"""


def reproduce(
    table: Annotated[
        Literal["table1", "agents"],
        typer.Argument(help="Table 1, or the supplement's table for 2, 3 and 4 agents.", metavar="TABLE"),
    ],
    tasks: TasksOption = None,
    algos: AlgosOption = None,
    steps: StudyStepsOption = None,
    seeds: SeedsOption = DEFAULT_SEEDS,
    out: StudyOutOption = None,
    preset: PresetOption = DEFAULT_PRESET,
    settings: SetOption = None,
    device: DeviceOption = "cpu",
    episodes: EpisodesOption = DEFAULT_EPISODES,
    jobs: JobsOption = None,
    dry_run: DryRunOption = False,
    reuse: ReuseOption = None,
    json: JsonOption = None,
) -> None:
    """Train, judge and tabulate what a table of the paper shows; called again, it goes on where it was."""
    choices = StudyChoices(
        tasks, algos, steps, seeds, out, preset, settings, device, episodes, jobs, dry_run, reuse, json
    )
    run_study(table, ("reproduce", table), choices)
