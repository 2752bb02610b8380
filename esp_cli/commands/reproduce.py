"""`esp reproduce`: the paper's tables, and a benchmark of methods for symmetry, from training to the numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

from typer import Argument, Option

from esp_cli.commands import studying
from esp_cli.commands.study_options import StudyChoices, parse_names, study_command
from esp_envs.errors import UserError

EPILOG = """Examples:\n
    esp reproduce table1 --dry-run\n
    esp reproduce table1 --steps 500k --seeds 10 --out runs/table1\n
    esp reproduce table1 --tasks navigation,predator-prey --algos mappo --steps 500k,3M\n
    esp reproduce agents --algos qmix\n
    esp reproduce symmetry --tasks navigation,navigation-region --methods 'plain,ESP,sets, ESP,auto'"""


@study_command(tasks="Tasks, as navigation,formation; by default the paper's, or those of the benchmark.")
def reproduce(
    table: Annotated[
        Literal["table1", "agents", "symmetry"],
        Argument(
            help="Table 1, the supplement's table for 2, 3 and 4 agents, or methods for symmetry, each tuned alike.",
            metavar="TABLE",
        ),
    ],
    choices: StudyChoices,
    methods: Annotated[
        list[str] | None,
        Option("--methods", help="For symmetry: what is compared, by the names in the table; by default all."),
    ] = None,
    budget: Annotated[
        int | None,
        Option("--budget", min=1, max=1000, help="For symmetry: trials of each method on each task; default 5."),
    ] = None,
) -> None:
    """Train, evaluate and tabulate what a table shows; called again, it goes on where it was."""
    if table == "symmetry":
        from esp_cli.studies.symmetry import METHODS, Benchmark

        request = replace(choices.request(), variants=parse_names(methods, METHODS))
        studying.search_or_forecast(Benchmark(request, budget or 5), "symmetry", choices)
        return
    if methods or budget:
        raise UserError("--methods and --budget are for esp reproduce symmetry; leave them out")
    studying.run_or_forecast(table, choices.request(), choices)
