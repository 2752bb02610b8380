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

from esp_cli.files.formatting import NOTHING, format_count, format_duration, format_mean
from esp_cli.files.writing import replace_file
from esp_cli.reporting.tables import Columns, Table, table
from esp_cli.studies.search import Search
from esp_cli.studies.tuning import NAMES, REDUCTION, RUNGS, Outcome, Tuning

_MEANING = {
    "return": "mean of the last three greedy evaluations",
    "steps": "environment steps to the return {reach:g}, as a negative number",
    "seconds": "seconds of training to the return {reach:g}, as a negative number",
}


def budget_table(tuning: Tuning, outcomes: Sequence[Outcome], title: str = "Budgets and scores") -> Table:
    """Return what each prior was given, and what its best trial scored on the trials' seeds."""
    columns: Columns[Outcome] = {
        "prior": lambda one: NAMES[one.prior],
        "trials>": lambda one: str(one.trials),
        "complete>": lambda one: str(one.completed),
        "pruned>": lambda one: str(one.pruned),
        "steps>": lambda one: format_count(one.env_steps),
        "time>": lambda one: format_duration(one.seconds),
        "default>": lambda one: format_mean(one.default_score),
        "best>": lambda one: format_mean(one.best_score),
        "trial>": lambda one: NOTHING if one.best is None else str(one.best),
    }
    return table(title, columns, outcomes, budget_sentence(tuning))


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
    """Write `tuning.md`, the same numbers as `tuning.json`, and Optuna's figures into a folder; return the page."""
    tuning = search.tuning
    out.mkdir(parents=True, exist_ok=True)
    document = {"tuning": tuning.model_dump(mode="json"), "outcomes": [asdict(outcome) for outcome in outcomes]}
    replace_file(out / "tuning.json", (json.dumps(document, indent=2) + "\n").encode())
    lines = [f"# {search.title}", "", f"`{tuning.command}`", ""]
    for made in (budget_table(tuning, outcomes), settings_table(outcomes)):
        lines += [f"## {made.title}", "", made.markdown(), ""]
    for one in outcomes:  # the most frequent reason first
        if count := len(one.refused):
            trials = "1 of the pruned trials was" if count == 1 else f"{count} of the pruned trials were"
            lines += ["", f"{NAMES[one.prior]}: {trials} refused, as the settings do not go together:", ""]
            lines += [f"- {times} x {reason}" for reason, times in Counter(one.refused).most_common()]
    lines += ["", "Chosen and scored on the seeds of the trials; the study in `fresh` evaluates them on others."]
    for prior, study in search.studies.items():
        for name, title in _draw(study, out, prior):
            lines += ["", f"## {NAMES[prior]}: {title}", "", f"![{title}]({name})"]
    page = out / "tuning.md"
    replace_file(page, ("\n".join(lines) + "\n").encode())
    return page


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


def _setting(value: object) -> str:
    return NOTHING if value is None else f"{value:.3g}" if isinstance(value, float) else json.dumps(value)
