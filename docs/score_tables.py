"""Tables from what `esp eval --json` writes, one or several under names, and from learning curves: see fill_tables."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

from esp_cli.files.formatting import NOTHING, format_count, format_mean
from esp_cli.policies.statistics import mean_and_sem
from esp_cli.reporting.tables import Table

METRICS = {"arrival_rate": "arrival>", "risky_rate": "risky states>", "collisions": "collisions>"}
"""Of a task, those that a table shows."""


def scores_table(files: list[Path]) -> Table:
    """Return one row for each policy, or for each run of learning curves."""
    documents = {file.stem.removesuffix("-eval"): json.loads(file.read_text(encoding="utf-8")) for file in files}
    if all("runs" in document for document in documents.values()):
        return _curves([run for document in documents.values() for run in document["runs"]])
    several: dict[str, dict[str, Any]] = {}
    for name, document in documents.items():
        several |= {name: document} if "greedy" in document else document
    shown = [name for name in METRICS if all("arrival_rate" in document["metrics"] for document in several.values())]
    headings = ("policy", "greedy return>", "drawn actions>", *(METRICS[name] for name in shown))
    rows = []
    for alike in _groups(several):
        rows += [_row(name, several[name], shown) for name in alike]
        rows.append(_best_heuristic(alike, several[alike[0]], shown))
    return Table("Scores", headings, tuple(rows))


def _groups(several: dict[str, dict[str, Any]]) -> Iterator[list[str]]:
    """Yield the names that stand beside the same reference policies, those that follow each other."""
    for _, names in groupby(several, lambda name: several[name]["anchors"]):
        yield list(names)


def _row(name: str, document: dict[str, Any], shown: list[str]) -> tuple[str, ...]:
    modes = (document[mode] for mode in ("greedy", "stochastic"))
    returns = (format_mean(score["mean"], score["sem"]) if score else NOTHING for score in modes)
    return name, *returns, *(_metric(document, metric) for metric in shown)


def _best_heuristic(names: list[str], document: dict[str, Any], shown: list[str]) -> tuple[str, ...]:
    """Return the row of the hand-written policy of the highest return; the first one is filed as `heuristic`."""
    called = dict(zip(["heuristic", *document["heuristics"][1:]], document["heuristics"], strict=True))
    key = max(called, key=lambda one: document["anchors"][one])
    conditions = {name.partition(", ")[2] for name in names}
    label = ", ".join(filter(None, (called[key], *(conditions if len(conditions) == 1 else ()))))
    found = document.get("anchor_metrics", {}).get(key, {})
    metrics = (f"{found[metric]:.3f}" if metric in found else NOTHING for metric in shown)
    return label, f"{document['anchors'][key]:.2f}", "", *metrics


def _metric(document: dict[str, Any], name: str) -> str:
    known = [value for value in document.get("metrics_per_seed", {}).get(name, ()) if value is not None]
    if len(known) < 2:
        return f"{document['metrics'][name]:.3f}"
    mean, error = mean_and_sem(known)
    return f"{mean:.3f} ± {error:.3f}"


def _curves(runs: list[dict[str, Any]]) -> Table:
    """Return the returns of runs at the steps that all of them have, and how long they took."""
    steps = [step for step in runs[0]["returns"] if all(step in run["returns"] for run in runs)]
    headings = ("run", "seeds>", *(f"{format_count(int(step))}>" for step in steps), "mean over the run>", "minutes>")
    rows = tuple(
        (
            run["label"],
            str(len(run["seeds"])),
            *(format_mean(run["returns"][step]["mean"], run["returns"][step]["sem"]) for step in steps),
            format_mean(run["area_under_curve"]["mean"], run["area_under_curve"]["sem"]),
            f"{run['seconds'] / 60:.1f}",
        )
        for run in runs
    )
    return Table("Curves", headings, rows)
