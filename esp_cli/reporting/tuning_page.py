"""The report of a tuning: budgets, best settings, and Optuna's figures, as tables and as a Markdown page."""

from __future__ import annotations

import io
import json
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import optuna.visualization.matplotlib as figures
from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances

from esp_cli.files.formatting import format_count, format_duration
from esp_cli.files.writing import replace_file
from esp_cli.reporting.tables import Table
from esp_cli.studies.search import Outcome, Search
from esp_cli.studies.tuning import NAMES, REDUCTION, RUNGS, Tuning

_MEANING = {
    "return": "mean of the last three greedy evaluations",
    "steps": "environment steps to the return {reach:g}, as a negative number",
    "seconds": "seconds of training to the return {reach:g}, as a negative number",
}


def budget_table(tuning: Tuning, outcomes: Sequence[Outcome], title: str = "Budgets and scores") -> Table:
    """Return what each prior was given, and what its best trial scored on the trials' seeds."""
    headings = ("prior", "trials>", "complete>", "pruned>", "steps>", "time>", "default>", "best>", "trial>")
    rows = [
        (
            NAMES[outcome.prior],
            str(outcome.trials),
            str(outcome.completed),
            str(outcome.pruned),
            format_count(outcome.env_steps),
            format_duration(outcome.seconds),
            _number(outcome.default_score),
            _number(outcome.best_score),
            "-" if outcome.best is None else str(outcome.best),
        )
        for outcome in outcomes
    ]
    return Table(title, headings, tuple(rows), budget_sentence(tuning))


def settings_table(outcomes: Sequence[Outcome]) -> Table:
    """Return the best settings of each prior; no rows where no trial has a score."""
    names = list(dict.fromkeys(name for outcome in outcomes for name in outcome.settings))
    headings = ("setting", *(f"{NAMES[outcome.prior]}>" for outcome in outcomes))
    rows = tuple((name, *(_setting(outcome.settings.get(name)) for outcome in outcomes)) for name in names)
    return Table("Best settings", headings, rows)


def budget_sentence(tuning: Tuning) -> str:
    """Say what budget each prior has, and what a score is."""
    each = " each" if len(tuning.priors) > 1 else ""
    seeds = f"{len(tuning.trial_seeds)} seed{'s' if len(tuning.trial_seeds) > 1 else ''}"
    looks = f"looks {RUNGS} times before the end"
    if tuning.goal == "seconds":
        looks = "compares trials after equal seconds, once the first has come to its end"
    return (
        f"Budget: {tuning.budget} trials{each} of {seeds} and at most "
        f"{format_count(tuning.steps)} steps per seed; successive halving {looks}, and "
        f"one of {REDUCTION} trials goes on. Trial 0 has the default settings, as far as the space holds "
        f"them. Score: {_MEANING[tuning.goal].format(reach=tuning.reach)}."
    )


def write_page(search: Search, outcomes: Sequence[Outcome], out: Path) -> Path:
    """Write `tuning.md`, the same numbers as `tuning.json`, and Optuna's figures.

    Args:
        search: with its record.
        outcomes: of each prior.
        out: folder, made if missing.

    Returns:
        The page.
    """
    tuning = search.tuning
    out.mkdir(parents=True, exist_ok=True)
    document = {"tuning": tuning.model_dump(mode="json"), "outcomes": [asdict(outcome) for outcome in outcomes]}
    replace_file(out / "tuning.json", (json.dumps(document, indent=2) + "\n").encode())
    lines = [f"# {search.title}", "", f"`{tuning.command}`", ""]
    for table in (budget_table(tuning, outcomes), settings_table(outcomes)):
        lines += [f"## {table.title}", "", table.markdown(), ""]
    lines += _refused_lines(outcomes)
    lines += ["", "Chosen and scored on the seeds of the trials; the study in `fresh` evaluates them on others."]
    for prior, study in search.studies.items():
        for name, title in _draw(study, out, prior):
            lines += ["", f"## {NAMES[prior]}: {title}", "", f"![{title}]({name})"]
    page = out / "tuning.md"
    replace_file(page, ("\n".join(lines) + "\n").encode())
    return page


def _refused_lines(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Yield how many of the pruned trials were refused, and why, the most frequent reason first."""
    for outcome in outcomes:
        if outcome.refused:
            count = len(outcome.refused)
            trials = "1 of the pruned trials was" if count == 1 else f"{count} of the pruned trials were"
            yield from ("", f"{NAMES[outcome.prior]}: {trials} refused, as the settings do not go together:", "")
            yield from (f"- {times} x {reason}" for reason, times in Counter(outcome.refused).most_common())


def _draw(study: Any, out: Path, prior: str) -> Iterator[tuple[str, str]]:
    """Draw the figures that the trials allow; yield file names and titles."""
    done = [trial for trial in study.get_trials(deepcopy=False) if trial.state.name == "COMPLETE"]
    drawings = {"intermediate values": figures.plot_intermediate_values}
    if done:
        drawings["optimization history"] = figures.plot_optimization_history
        drawings["slices"] = figures.plot_slice
    if len(done) > 3:
        drawings["parallel coordinates"] = figures.plot_parallel_coordinate
        drawings["importances"] = _importances
    for title, draw in drawings.items():
        name = f"{prior}-{title.replace(' ', '-')}.png"
        with warnings.catch_warnings(), plt.rc_context():
            warnings.simplefilter("ignore")
            draw(study)
            figure = plt.gcf()
            picture = io.BytesIO()
            figure.savefig(picture, dpi=110, bbox_inches="tight")
            replace_file(out / name, picture.getvalue())
            plt.close(figure)
        yield name, title


def _importances(study: Any) -> None:
    importances = get_param_importances(study, evaluator=PedAnovaImportanceEvaluator())
    _, axes = plt.subplots()
    axes.barh(list(importances), list(importances.values()))
    axes.invert_yaxis()
    axes.set_xlabel("importance (PED-ANOVA)")


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _setting(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else json.dumps(value)
