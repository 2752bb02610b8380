"""Tables of results that stand beside a reference, the hand-written policies or the paper: see fill_tables."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from esp_cli.files.formatting import NOTHING, format_count, format_exactly, format_interval, format_span
from esp_cli.policies.statistics import median_steps
from esp_cli.reporting.results import CellResult, Results
from esp_cli.reporting.tables import AHEAD, TABLES, Table, return_text
from esp_cli.studies import paper
from esp_cli.studies.catalogue import paired_name
from esp_cli.studies.kinds import Team, kind_of


def paper_table(results: Results) -> Table:
    """Return the study in its own layout with all that the paper's table has; what we did not run is marked so."""
    ours = {(cell.panel, cell.variant): cell for cell in results.cells}
    bare: dict[str, object] = {"status": "not run", "returns": {}, "summary": None, "convention": None}
    cells: list[CellResult] = []
    for panel, variant, key in paper_cells(results.kind):
        theirs = {"panel": panel, "variant": variant, "paper": paper.reported(key)}
        cells.append(
            ours.pop((panel, variant))
            if (panel, variant) in ours
            else results.cells[0].model_copy(update=bare | theirs)
        )
    return TABLES["returns"](results.model_copy(update={"cells": (*cells, *ours.values())}))


def paper_cells(name: str) -> Iterator[tuple[str, str, tuple[str, ...]]]:
    """Yield panel, variant and place of every number that the paper's table of this kind has; none for ablations."""
    kind = kind_of(name)
    if kind.rows == "variants":
        return
    for task in kind.tasks:
        teams = [team for team in kind.teams if team.settings["task.num_landmarks"] is None]
        for team in teams or (Team(task, {}, ("table1", task)),):
            for steps in paper.horizons(task):
                for algorithm in kind.algorithms:
                    for settings in kind.variants.values():
                        key = (*team.place, str(steps), algorithm, str(settings["prior.kind"]))
                        yield f"{team.label}, {format_exactly(steps)}", paired_name(algorithm, key[-1]), key


def pairs_table(results: Results) -> Table:
    """Return one row for each run that has a reference: who is ahead, both returns, and the steps that both need."""
    rows = []
    for cell in results.cells:
        reference = results.reference_of(cell)
        if reference is None or not (cell.summary and reference.summary and cell.summary.gap):
            continue
        gap = cell.summary.gap
        ends = tuple(None if s.normalised is None else s.normalised.mean for s in (reference.summary, cell.summary))
        normalised = NOTHING if None in ends else f"{ends[0]:.2f}, {ends[1]:.2f}"
        apart = f"{gap.difference.value:+.2f} {format_interval(gap.difference.ci95)}"
        returns = (return_text(cell), return_text(reference), apart)
        rows.append(
            (
                f"{cell.panel}: {cell.variant}",
                AHEAD[gap.ahead],
                *returns,
                normalised,
                *(_steps(cell, reference) if results.mode == "greedy" else (NOTHING, NOTHING)),
            )
        )
    seeds = {len(cell.seeds) for cell in results.cells}
    episodes = {cell.episodes or results.episodes for cell in results.cells}
    drawn = " with drawn actions" if results.mode == "stochastic" else ""
    caption = f"Returns{drawn} over {format_span(seeds)} seeds, {format_span(episodes)} episodes a seed."
    numbers = ("return>", "reference>", "difference [95 %]>", "normalised: reference, run>")
    return Table("Pairs", ("run", "ahead", *numbers, "steps: reference, run>", "ratio>"), tuple(rows), caption)


def _steps(cell: CellResult, reference: CellResult) -> tuple[str, str]:
    """Return the median steps of reference and run to what the reference ends with, and their ratio."""
    last = reference.summary.returns.mean if reference.summary else None
    theirs = {passing.threshold: passing for passing in reference.steps_to}
    ours = {passing.threshold: passing for passing in cell.steps_to if passing.threshold in theirs}
    if last is None or not ours:
        return NOTHING, NOTHING
    level = min(ours, key=lambda threshold: abs(threshold - last))
    steps = [median_steps(side[level].per_seed)[0] for side in (theirs, ours)]
    known = [np.isfinite(value) for value in steps]
    texts = [
        format_count(value) if finite else f"> {format_count(run.step)}"
        for value, finite, run in zip(steps, known, (reference, cell), strict=True)
    ]
    return ", ".join(texts), f"{steps[1] / steps[0]:.2f}" if all(known) and steps[0] else NOTHING


def references_table(results: Results) -> Table:
    """Return the mean returns of the random and the hand-written policies of each panel."""
    panels = {cell.panel: cell.anchors for cell in results.cells if cell.anchors}
    rows = [
        (panel, f"{found['random']:.1f}", ", ".join(f"{k} {v:.1f}" for k, v in found.items() if k != "random"))
        for panel, found in panels.items()
    ]
    return Table("Reference policies", ("task", "random>", "hand-written"), tuple(rows))
