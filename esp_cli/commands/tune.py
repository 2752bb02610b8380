"""`esp tune`: search the settings of a learner, with the prior and without it, on equal steps."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

from typer import Option

from esp_cli import console
from esp_cli.commands import studying
from esp_cli.commands.study_options import StudyChoices, parse_names, study_command

EPILOG = """Examples:\n
    esp tune --task navigation --algo mappo --budget 30 --prior esp,none --dry-run\n
    esp tune --task predator-prey --algo qmix --budget 30 --prior esp,none --steps 500k --out runs/tune-qmix\n
    esp tune --task mine:Task --algo mappo --space space.toml\n
    esp train --config runs/tune-qmix/preset-esp.json --seeds 10"""


@study_command(
    tasks="The task; by default navigation.",
    algos="The algorithm; by default mappo.",
    steps="Environment steps per seed of a trial; by default 500k.",
)
def tune(
    choices: StudyChoices,
    budget: Annotated[int, Option("--budget", min=1, max=1000, help="Trials, for each prior.")] = 20,
    space: Annotated[
        Path | None, Option("--space", help="What to try, as JSON or TOML; by default a space for each algorithm.")
    ] = None,
    prior: Annotated[
        list[str] | None,
        Option(
            "--prior",
            help="esp (the default), none, auto, augment, consistency, or several as esp,none, tried alike.",
        ),
    ] = None,
    trial_seeds: Annotated[int, Option("--trial-seeds", min=1, max=100, help="Seeds of each trial.")] = 3,
) -> None:
    """Search for better settings; evaluate the best on fresh seeds. Called again, it goes on where it was."""
    from esp_cli.studies.tuning import Tuning

    tuning = Tuning(choices.request(), parse_names(prior) or ("esp",), budget, trial_seeds, space)
    if tuning.refused:
        console.note(f"{len(tuning.refused)} draws do not go together and are left out, the first: {tuning.refused[0]}")
    if len(tuning.draws) < budget:
        console.note(f"the space holds no more than {len(tuning.draws)} trials, the default settings included")
    studying.search_or_forecast(tuning, "tune", choices)
    for hint in tuning.hints:
        console.note(hint)
    if not choices.dry_run:
        own = tuning.config("none", {}, tuning.trial_seeds).own_words()
        for one in tuning.priors:
            path = choices.folder("tune") / f"preset-{one}.json"
            if path.is_file():
                console.note(f"next: {shlex.join(['esp', 'train', *own, '--config', str(path)])}")
