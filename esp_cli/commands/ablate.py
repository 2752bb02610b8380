"""`esp ablate`: what each part of the prior is worth."""

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
    esp ablate transforms --algo maddpg --task navigation\n
    esp ablate coefficient --steps 500k --dry-run\n
    esp ablate modules --algo maddpg,mappo --seeds 10 --steps 500k --out runs/modules\n
    esp ablate modules --reuse runs/table1 --reuse runs/transforms"""


def ablate(
    part: Annotated[
        Literal["transforms", "coefficient", "modules"],
        typer.Argument(
            help="Number and type of transforms (figures 5a, 5b), weight of the consistency loss (5c), or loss and "
            "augmentation apart (6a).",
            metavar="PART",
        ),
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
    """Vary one part of the prior and hold all else fixed; called again, it goes on where it was."""
    choices = StudyChoices(
        tasks, algos, steps, seeds, out, preset, settings, device, episodes, jobs, dry_run, reuse, json
    )
    run_study(f"ablate-{part}", ("ablate", part), choices)
