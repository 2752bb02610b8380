"""`--dry-run` of the study commands: what would be run, how long it takes, and what it needs on the disk."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from esp_cli import console
from esp_cli.commands.options import note_without_effect
from esp_cli.commands.study_options import StudyChoices
from esp_cli.commands.studying import open_resources
from esp_cli.machine import busy_with

if TYPE_CHECKING:
    from esp_cli.studies.catalogue import Request
    from esp_cli.studies.forecast import Forecast, SearchForecast
    from esp_cli.studies.tuning import Tuning

BUSY = 0.5  # load per core from which a forecast is called unreliable
_MEBIBYTE = 2**20


def forecast_study(kind: str, request: Request, choices: StudyChoices) -> None:
    """Plan a study and print its runs, how long each takes by a probe on this machine, and what they need on the disk.

    Args:
        kind: of `studies.kinds`.
        request: what the user asks for.
        choices: how it would be run.
    """
    from esp_cli.studies import forecast
    from esp_cli.studies.catalogue import plan, without_effect
    from esp_cli.studies.study import StudyFolder

    out, study = choices.folder(kind), plan(kind, request)
    note_without_effect(without_effect(kind, request))
    with open_resources(choices, out, study.cells[0].config.device) as resources:
        StudyFolder.planned(out, study)  # refuses the folders that the run would refuse
        with _measuring(len(study.cells)) as listener:
            found = forecast.forecast_study(StudyFolder(out, study), resources.reused, resources.jobs, listener)
    console.result(choices.json, found, lambda: _print_study(found))


def forecast_search(tuning: Tuning, request: Request, choices: StudyChoices, out: Path) -> None:
    """Print what a search costs at most, what it costs as others did, and what it needs on the disk.

    Args:
        tuning: what is asked for.
        request: has the seeds and episodes of the runs that judge the best settings.
        choices: how it would be run.
        out: its folder.
    """
    from esp_cli.studies import forecast
    from esp_cli.studies.tuning_space import space_of

    with open_resources(choices, out, tuning.device) as resources:
        jobs = resources.jobs
    with _measuring(sum(len(space_of(tuning.space, prior)) for prior in tuning.priors)) as listener:
        done = itertools.count(1)
        searches = [
            forecast.forecast_search(tuning, prior, request.seeds, request.episodes, lambda: listener(next(done)))
            for prior in tuning.priors
        ]
    found = {name: sum(getattr(one, name) for one in searches) for name in ("likely_s", "at_most_s", "disk_bytes")}
    found["disk_peak_bytes"] = found["disk_bytes"] + jobs * max(one.peak_bytes for one in searches)
    document = {"command": tuning.command, "searches": searches, **found, "jobs": jobs}
    console.result(choices.json, document, lambda: _print_search(searches, found, tuning.command, jobs, out))


@contextmanager
def _measuring(total: int) -> Iterator[Callable[[int], object]]:
    """Yield a progress callback; say afterwards if the machine was too busy to measure."""
    with console.TrainingProgress(total, description="measure") as progress:
        busy = busy_with()  # before the measurement, which keeps a core busy itself
        yield progress.update
    if busy > BUSY:
        console.note(
            f"this machine was busy (load {busy:.1f} per core) while this was measured, so the times are unreliable; "
            "ask again when it is idle"
        )


def _print_study(found: Forecast) -> None:
    rows = [
        (
            run.name,
            f"{console.format_count(run.config.steps)} x {len(run.config.seeds)}",
            run.status if run.status == "finished" else f"at {console.format_count(run.step)}" if run.step else "new",
            console.format_duration(run.seconds_left),
        )
        for run in found.runs
    ]
    console.table(("run", "steps x seeds>", "state", "time left>"), rows, title=found.title)
    console.say(
        f"{sum(run.status != 'finished' for run in found.runs)} runs to do: "
        f"{console.format_duration(found.core_seconds)} on one core, "
        f"{console.format_duration(found.seconds)} with {found.jobs} side by side, if nothing else runs here"
    )
    _say_disk(found.disk_bytes, found.disk_peak_bytes, found.out)


def _print_search(
    searches: Sequence[SearchForecast], found: Mapping[str, Any], title: str, jobs: int, out: Path
) -> None:
    rows = [
        (
            one.prior,
            str(one.trials),
            *(console.format_duration(seconds) for seconds in (one.default_s, one.mean_s, one.longest_s)),
            ", ".join(one.settings),
        )
        for one in searches
    ]
    console.table(("prior", "trials>", "default>", "mean>", "longest>", "settings"), rows, title=title)
    console.say(
        f"on one core about {console.format_duration(found['likely_s'])} if pruning saves half of the steps, at most "
        f"{console.format_duration(found['at_most_s'])}, the best settings on fresh seeds included; {jobs} runs side "
        "by side"
    )
    _say_disk(found["disk_bytes"], found["disk_peak_bytes"], out)


def _say_disk(done: int, peak: int, out: Path) -> None:
    """Say what bytes a folder needs when all is done and on the way, and whether the disk has them."""
    free = shutil.disk_usage(next(p for p in (out, *out.absolute().parents) if p.exists())).free
    console.say(
        f"disk: {done / _MEBIBYTE:.0f} MiB when done, at most {peak / _MEBIBYTE:.0f} MiB on the way; "
        f"{free / _MEBIBYTE:.0f} MiB are free -> {out}"
    )
    if peak > free:
        console.note("the disk is too small for that; choose another --out, or fewer --jobs")
