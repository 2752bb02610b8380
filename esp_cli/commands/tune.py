"""`esp tune`: search the settings of a learner, with the prior and without it, on equal budgets."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from esp_cli import console
from esp_cli.commands import studying
from esp_cli.commands.options import note_without_effect
from esp_cli.commands.study_options import StudyChoices, parse_names, study_command
from esp_cli.console.progress import stop_requests
from esp_cli.training.folder_names import FRESH
from esp_envs.errors import UserError
from esp_envs.installed import install

if TYPE_CHECKING:
    from esp_cli.studies.catalogue import Request
    from esp_cli.studies.search import Search
    from esp_cli.studies.tuning import Outcome, Tuning

EPILOG = """Examples:\n
    esp tune --task navigation --algo mappo --budget 30 --prior esp,none --dry-run\n
    esp tune --task predator-prey --algo qmix --budget 30 --prior esp,none --steps 500k --out runs/tune-qmix\n
    esp tune --task mine:Task --algo mappo --space space.toml\n
    esp train --config runs/tune-qmix/preset-esp.json --seeds 10"""

FIRST_TRIAL_SEED = 1000  # seed of the first trial; the best settings are evaluated on other seeds


@study_command(
    tasks="The task; by default navigation.",
    algos="The algorithm; by default mappo.",
    steps="Environment steps per seed of a whole trial; by default 500k.",
)
def tune(
    choices: StudyChoices,
    budget: Annotated[int, Option("--budget", min=1, max=100_000, help="Trials, for each prior.")] = 30,
    space: Annotated[
        Path | None, Option("--space", help="What to try, as JSON or TOML; by default a space for each algorithm.")
    ] = None,
    prior: Annotated[
        list[str] | None,
        Option(
            "--prior",
            help="esp (the default), none, auto, augment, consistency, or several as esp,none; a search each.",
        ),
    ] = None,
    trial_seeds: Annotated[int, Option("--trial-seeds", min=1, max=100, help="Seeds of each trial.")] = 3,
) -> None:
    """Search for better settings; evaluate the best on fresh seeds. Called again, it goes on where it was."""
    priors = parse_names(prior) or ("esp",)
    request = choices.request()
    tuning = _tuning(request, priors, space, trial_seeds, budget)
    idle = frozenset.intersection(*map(tuning.without_effect, priors))
    note_without_effect([name for name in tuning.overrides if name in idle])
    try:
        from esp_cli.studies.search import Search
    except ImportError:
        raise UserError(f"Optuna is not installed: {install('tune')}") from None
    (_forecast if choices.dry_run else _tune)(Search, tuning, request, choices)


def _tuning(request: Request, priors: Sequence[str], space: Path | None, trial_seeds: int, budget: int) -> Tuning:
    from esp_cli.algorithms.presets import ALGORITHMS
    from esp_cli.studies.catalogue import refuse_other_tasks, refuse_unknown_or_twice, task_setting
    from esp_cli.studies.tuning import NAMES, Tuning
    from esp_cli.studies.tuning_space import default_space, read_space

    for flag, names in (("--task", request.tasks), ("--algo", request.algorithms), ("--steps", request.steps)):
        if names is not None and len(names) != 1:
            raise UserError(f"esp tune takes one {flag}, not {len(names)}; run it once for each")
    refuse_unknown_or_twice("kind of prior", priors, NAMES)
    task, algorithm = (request.tasks or ("navigation",))[0], (request.algorithms or ("mappo",))[0]
    refuse_other_tasks(request.steps or (), (task,))
    ALGORITHMS[algorithm]  # refuses an unknown algorithm before the space that it lacks
    tried_settings = read_space(space) if space else default_space(algorithm)
    tuning = Tuning(
        task=task,
        algorithm=algorithm,
        preset=request.preset,
        priors=tuple(priors),
        budget=budget,
        steps=request.steps[0][1] if request.steps else 500_000,
        trial_seeds=tuple(range(FIRST_TRIAL_SEED, FIRST_TRIAL_SEED + trial_seeds)),
        overrides={task_setting(name, task): value for name, value in request.overrides.items()},
        space={task_setting(name, task): tried for name, tried in tried_settings.items()},
        device=request.device,
        command=request.command,
    )
    tuning = tuning if space else tuning.around_defaults()
    tuning.check(request.seeds)
    return tuning


def _forecast(search_type: type[Search], tuning: Tuning, request: Request, choices: StudyChoices) -> None:
    from esp_cli.studies.study import StudyFolder
    from esp_cli.studies.tuning import fresh_study
    from esp_cli.studies.tuning_space import space_of

    out, budget = choices.folder("tune"), tuning.budget
    with search_type.looked_at(out, tuning) as search:
        groups = {f"{budget} trials, prior {p}": [c for c in search.cells if c.panel == p] for p in tuning.priors}
        ended = StudyFolder.is_one(out / FRESH) and all(map(search.is_finished, search.cells))
        # for the best settings, which are not known yet, the first of the space stands in
        firsts = {} if ended else {p: next(iter(space_of(tuning.space, p).items())) for p in tuning.priors}
        best = {p: (budget, {name: tried.corners()[-1]}) for p, (name, tried) in firsts.items()}
        fresh, _ = StudyFolder.planned(out / FRESH, fresh_study(tuning, best, request.seeds, request.episodes))
        what = "all trials with the default settings, of which pruning saves about half"
        studying.forecast(fresh, choices, search, groups, what)


def _tune(search_type: type[Search], tuning: Tuning, request: Request, choices: StudyChoices) -> None:
    from esp_cli.studies.study import StudyFolder
    from esp_cli.studies.tuning import fresh_study

    out, fresh = choices.folder("tune"), None
    judged = out / FRESH
    with (
        studying.open_resources(choices, out, tuning.device) as resources,
        search_type.held(out),
        stop_requests("stopping every run after its iteration") as requests,
    ):
        if StudyFolder.is_one(judged):  # of a search that goes on: other seeds are refused before it does
            StudyFolder.planned(judged, fresh_study(tuning, {}, request.seeds, request.episodes))
        search = search_type.create(out, tuning)
        failed = studying.follow(search, search.cells, resources, requests)
        outcomes = [search.outcome(prior) for prior in tuning.priors]
        best = {found.prior: (found.best, found.settings) for found in outcomes if found.best is not None}
        _report(search, outcomes, quiet=choices.json == "-")
        if best and not (requests or failed):
            study = fresh_study(tuning, best, request.seeds, request.episodes)
            fresh = StudyFolder.create(judged, study, keep=False)  # a longer search may have found another winner
            failed = studying.run_cells(fresh, study, resources, requests)
    studying.conclude(fresh, failed, requests, out, choices)
    if not best:
        raise UserError("no trial has a score, so there is nothing to judge")


def _report(search: Search, outcomes: Sequence[Outcome], quiet: bool) -> None:
    from esp_cli.reporting.tuning_page import budget_table, settings_table, write_page

    if not quiet:
        for table in (budget_table(search.tuning, outcomes, search.title), settings_table(outcomes)):
            if table.rows:
                console.table(table.headings, table.rows, title=table.title, caption=table.caption)
    refused = [reason for found in outcomes for reason in found.refused]
    if refused:
        console.note(f"{len(refused)} trials had settings that do not go together, the first: {refused[0]}")
    presets = search.write_presets(outcomes)
    console.note(f"report -> {write_page(search, outcomes, search.path / 'report')}")
    own = search.tuning.config("none", {}).own_words()
    for path in presets:
        console.note(f"next: {shlex.join(['esp', 'train', *own, '--config', str(path)])}")
