"""`esp reproduce`: the paper's tables, from training to the numbers."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from esp_cli.commands.study_options import StudyChoices, study_command
from esp_cli.commands.studying import run_or_forecast

EPILOG = """Examples:\n
    esp reproduce table1 --dry-run\n
    esp reproduce table1 --steps 500k --seeds 10 --out runs/table1\n
    esp reproduce table1 --tasks navigation,predator-prey --algos mappo --steps 500k,3M\n
    esp reproduce agents --algos qmix"""


@study_command
def reproduce(
    table: Annotated[
        Literal["table1", "agents"],
        typer.Argument(help="Table 1, or the supplement's table for 2, 3 and 4 agents.", metavar="TABLE"),
    ],
    choices: StudyChoices,
) -> None:
    """Train, evaluate and tabulate what a table of the paper shows; called again, it goes on where it was."""
    run_or_forecast(table, choices.request(), choices)
