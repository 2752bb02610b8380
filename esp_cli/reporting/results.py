"""The results of a study or of runs as one typed document: every seed's numbers, configuration and version behind them.

Everything that tables state is computed from these numbers by `summary.summarised`, so a small file without it gives
the tables again.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue

from esp_cli.defaults import Mode
from esp_cli.files.documents import DocumentFormat
from esp_cli.policies.statistics import Estimate, Passing, SeedSummary

RESULTS_FORMAT = DocumentFormat("esp-results", 1, "the results of a study")
Numbers = tuple[float | None, ...]  # one number per seed; None where the seed stopped
Side = Literal["ahead", "behind", "level"]


@dataclass(frozen=True)
class Gap:
    """A run beside its reference."""

    difference: Estimate  # of the means
    paired: bool  # whether both have the same seeds, which are compared one by one
    # of improvement over the reference, seed by seed if `paired`; None for fewer than three seeds
    probability: Estimate | None
    over_all_pairs: Estimate | None  # the same with every seed against every seed, as Agarwal et al. define it
    # by whether the interval of the difference holds 0; None for fewer than three seeds, or no interval
    ahead: Side | None


@dataclass(frozen=True)
class CellSummary:
    """Statistics of one cell; None where its seeds do not allow one."""

    returns: SeedSummary  # over seeds
    iqm: Estimate | None = None  # interquartile mean
    normalised: SeedSummary | None = None  # 0 is the random policy, 1 the best of the task's heuristics
    area: SeedSummary | None = None  # mean height of the learning curve
    gap: Gap | None = None  # to the cell's reference
    # "first" where our mean is higher than the paper's, "second" where the paper's is
    leader: Literal["first", "second", "neither"] | None = None


@dataclass(frozen=True)
class Aggregate:
    """Numbers of one variant over all panels, of normalised returns."""

    iqm: Estimate  # interquartile mean
    mean: Estimate  # of all seeds of all panels
    # mean probability of improvement over the panel's reference, where every panel has one
    improvement: Estimate | None


class CellResult(BaseModel):
    """What came out of one run of a study; fields at their default are left out of the document."""

    model_config = ConfigDict(frozen=True)

    name: str  # of the cell, as are panel and variant
    panel: str
    variant: str
    reference: str | None  # name of the cell that it is compared with; None for such a cell itself
    # mean and standard error of the paper; the latter is None where it was read off a figure
    paper: tuple[float, float | None] | None
    # "unfinished" also says that a run put together by hand did not reach the step in question
    status: Literal["finished", "unfinished", "not run"]
    step: int  # environment steps per seed at which the run stands
    at: int | None = None  # step at which runs put together by hand are compared; None for the final evaluation
    steps: int  # that the run is to take
    seeds: tuple[int, ...]  # of the run
    config: dict[str, JsonValue]  # settings by dotted name, those that not all cells share
    seconds: float | None = None  # of training
    esp_version: str | None = None  # of the program that evaluated
    task_version: int | None = None
    convention: str | None = None
    episodes: int | None = None  # per seed, where they are not those of all cells
    returns: dict[Mode, Numbers] = {}  # by mode, of the final evaluation, or of the evaluation at `at`
    anchors: dict[str, float] = {}  # mean returns of the reference policies
    metrics: dict[str, float | None] = {}  # the task's measures of the greedy policy
    evaluations: int | None = None  # on the way
    # returns by seed at the evaluation nearest to a fifth of the run, in a study of broken symmetry
    early: Numbers | None = None
    area_under_curve: Numbers | None = None  # mean height of the learning curve, by seed
    steps_to: tuple[Passing, ...] = ()  # first steps at thresholds
    parameters: dict[str, int] = {}  # weights by network, of one seed
    flops_per_action: float | None = None  # of the policy
    # statistics of these numbers; None before `summary.summarised`, or where there are no returns yet
    summary: CellSummary | None = None


class Results(BaseModel):
    """The results of a study, finished or not."""

    model_config = ConfigDict(frozen=True)

    kind: str  # of the study, as are title, command, rows and episodes
    title: str
    command: str
    esp_version: str  # of the program that planned the study
    mode: Mode  # which evaluations tables state
    rows: Literal["panels", "variants"]
    episodes: int
    config: dict[str, JsonValue]  # settings by dotted name that all cells share
    cells: tuple[CellResult, ...] = Field(min_length=1)  # in the study's order
    aggregates: dict[str, Aggregate] = {}  # statistics over all panels by variant, where there are several panels

    def reference_of(self, cell: CellResult) -> CellResult | None:
        """Return the cell that one is compared with."""
        return next((other for other in self.cells if other.name == cell.reference), None)

    def content(self, statistics: bool = False) -> dict[str, Any]:
        """Return the content of the document, with its statistics or without what can be computed from it again."""
        computed: Any = None if statistics else {"aggregates": True, "cells": {"__all__": {"summary"}}}
        return self.model_dump(mode="json", exclude_defaults=True, exclude=computed)

    def document(self, statistics: bool = False) -> dict[str, Any]:
        """Return the document as `esp report --json` writes it with statistics, and `--results` without."""
        return RESULTS_FORMAT.document(self.content(statistics))


def read_results(path: Path) -> Results:
    """Read a results file.

    Raises:
        UserError: it is missing, damaged, foreign, or of a newer version.
    """
    return RESULTS_FORMAT.parse(path, Results)
