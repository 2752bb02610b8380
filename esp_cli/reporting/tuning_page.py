"""The report of a tuning: budgets and best settings, as tables and as a Markdown page."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from esp_cli.files.formatting import NOTHING, format_count, format_duration, format_mean
from esp_cli.files.writing import replace_file
from esp_cli.reporting.tables import Columns, Table, table
from esp_cli.studies.search import Search
from esp_cli.studies.tuning import NAMES, REDUCTION, RUNGS, Outcome, Tuning


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
    return (
        f"Budget: {tuning.budget} trials{each} of {seeds} and at most "
        f"{format_count(tuning.steps)} steps per seed; successive halving looks {RUNGS} times before the end, and "
        f"one of {REDUCTION} trials goes on. Trial 0 has the default settings, as far as the space holds "
        f"them. Score: mean of the last three greedy evaluations."
    )


def write_page(search: Search, outcomes: Sequence[Outcome], out: Path) -> Path:
    """Write `tuning.md` and the same numbers as `tuning.json` into a folder; return the page."""
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
    page = out / "tuning.md"
    replace_file(page, ("\n".join(lines) + "\n").encode())
    return page


def _setting(value: object) -> str:
    return NOTHING if value is None else f"{value:.3g}" if isinstance(value, float) else json.dumps(value)
