"""`esp ablate`: what each part of the prior is worth."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

from typer import Argument, Option

from esp_cli.commands.study_options import StudyChoices, parse_names, study_command
from esp_cli.commands.studying import run_or_forecast
from esp_envs.errors import UserError

EPILOG = """Examples:\n
    esp ablate transforms --algo maddpg --task navigation\n
    esp ablate coefficient --steps 500k --dry-run\n
    esp ablate modules --algo maddpg,mappo --seeds 10 --steps 500k --out runs/modules\n
    esp ablate breaking --task navigation --seeds 3 --steps 300k --dry-run\n
    esp ablate prior --task rendezvous:Rendezvous --seeds 5 --steps 200k\n
    esp ablate modules --reuse runs/table1 --reuse runs/transforms"""


@study_command
def ablate(
    part: Annotated[
        Literal["transforms", "coefficient", "modules", "prior", "breaking"],
        Argument(
            help="Number and type of transforms (figures 5a, 5b), weight of the consistency loss (5c), loss and "
            "augmentation apart (6a), the learner with the whole prior and without it, or methods under broken "
            "symmetry.",
            metavar="PART",
        ),
    ],
    choices: StudyChoices,
    methods: Annotated[
        list[str] | None,
        Option("--methods", help="What is compared, as 'plain,ESP' of breaking and prior; by default all."),
    ] = None,
    broken_by: Annotated[
        list[str] | None,
        Option("--broken-by", help="For breaking: the settings that break symmetry, as wind,mud; by default all."),
    ] = None,
) -> None:
    """Vary one part of the prior and hold all else fixed; called again, it goes on where it was."""
    from esp_cli.studies.kinds import KINDS

    kind, settings = f"ablate-{part}", parse_names(broken_by)
    names = parse_names(methods, KINDS[kind].variants)
    if settings and part != "breaking":
        raise UserError("--broken-by is for esp ablate breaking; leave it out")
    run_or_forecast(kind, replace(choices.request(), variants=names, breakings=settings), choices)
