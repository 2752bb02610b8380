"""`esp compare-homomorphic`: symmetry in the network against symmetry in the data and the loss."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from typer import Option

from esp_cli.commands.options import check_finite
from esp_cli.commands.study_options import StudyChoices, parse_names, study_command
from esp_cli.commands.studying import run_or_forecast
from esp_cli.defaults import Mode
from esp_envs.errors import UserError

EPILOG = """Examples:\n
    esp compare-homomorphic --dry-run\n
    esp compare-homomorphic --methods mpn,empn --steps 100k --seeds 3 --out runs/quick\n
    esp compare-homomorphic --grid 9 --drones 4 --group d4"""


@study_command
def compare_homomorphic(
    choices: StudyChoices,
    drones: Annotated[int, Option("--drones", min=2, help="N, drones.")] = 3,
    grid: Annotated[int, Option("--grid", min=3, help="Cells along each side, an odd number.")] = 7,
    methods: Annotated[
        str | None, Option("--methods", help="Which of mpn, mpn-esp, empn, mpn-ensemble, in this order.")
    ] = None,
    group: Annotated[str, Option("--group", help="The symmetry in question: c4 or d4.")] = "c4",
    mode: Annotated[
        Mode | None, Option("--mode", help="Which evaluations the tables state; by default stochastic.")
    ] = None,
    threshold: Annotated[
        float | None, Option("--threshold", help="State when this return is first reached; by default 2.")
    ] = None,
) -> None:
    """Train standard, ESP, equivariant and averaged message passing networks on wildlife, and compare them (Fig. 6b).

    Called again, it goes on where it was.
    """
    names = parse_names([methods]) if methods is not None else None
    choices.mode, choices.thresholds = mode, () if threshold is None else (threshold,)
    check_finite("--threshold", *choices.thresholds)
    request = choices.request()
    board = {"task.num_agents": drones, "task.width": grid, "task.height": grid}
    if twice := sorted(board.keys() & request.overrides.keys()):
        raise UserError(f"--drones and --grid say what {twice[0]} is; leave --set {twice[0]} out")
    request = replace(request, overrides={**board, **request.overrides}, variants=names, group=group)
    run_or_forecast("homomorphic", request, choices)
