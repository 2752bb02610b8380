"""The results of a study as one small JSON document: every seed's numbers, the configuration and version behind them.

Everything that tables state is computed from this document by `summary`, so the file alone gives the tables again.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue

from esp_cli.defaults import Mode
from esp_cli.files.documents import DocumentFormat
from esp_envs.errors import UserError

RESULTS_FORMAT = DocumentFormat("esp-results", 1, "the results of a study")
Numbers = tuple[float | None, ...]
"""One number per seed; None where the seed stopped."""


class Passing(BaseModel):
    """When a curve is first at or above a threshold: environment steps per seed, None for never."""

    model_config = ConfigDict(frozen=True)

    threshold: float
    of_mean: int | None
    per_seed: tuple[int | None, ...]


class CellResult(BaseModel):
    """What came out of one run of a study; fields at their default are left out of the document.

    Attributes:
        name: of the cell, as are panel and variant.
        reference: name of the cell that it is compared with; None for such a cell itself.
        paper: mean and standard error of the paper; the latter is None where it was read off a figure.
        status: "unfinished" also says that a run put together by hand did not reach the step in question.
        step: environment steps per seed at which the run stands.
        at: step at which runs put together by hand are compared; None for the final evaluation.
        steps: that the run is to take.
        seeds: of the run.
        config: settings by dotted name, those that not all cells share.
        seconds: of training.
        esp_version: of the program that evaluated.
        episodes: per seed, where they are not those of all cells.
        returns: by mode, of the final evaluation, or of the evaluation at `at`.
        anchors: mean returns of the reference policies.
        metrics: the task's measures of the greedy policy.
        evaluations: on the way.
        early: returns by seed at the evaluation nearest to a fifth of the run, in a study of broken symmetry.
        area_under_curve: mean height of the learning curve, by seed.
        steps_to: first steps at thresholds.
        parameters: weights by network, of one seed.
        flops_per_action: of the policy.
    """

    model_config = ConfigDict(frozen=True)

    name: str
    panel: str
    variant: str
    reference: str | None
    paper: tuple[float, float | None] | None
    status: Literal["finished", "unfinished", "not run"]
    step: int
    at: int | None = None
    steps: int
    seeds: tuple[int, ...]
    config: dict[str, JsonValue]
    seconds: float | None = None
    esp_version: str | None = None
    task_version: int | None = None
    convention: str | None = None
    episodes: int | None = None
    returns: dict[Mode, Numbers] = {}
    anchors: dict[str, float] = {}
    metrics: dict[str, float | None] = {}
    evaluations: int | None = None
    early: Numbers | None = None
    area_under_curve: Numbers | None = None
    steps_to: tuple[Passing, ...] = ()
    parameters: dict[str, int] = {}
    flops_per_action: float | None = None


class Results(BaseModel):
    """The results of a study, finished or not.

    Attributes:
        kind: of the study, as are title, command, rows and episodes.
        esp_version: of the program that planned the study.
        mode: which evaluations tables state.
        config: settings by dotted name that all cells share.
        cells: in the study's order.
    """

    model_config = ConfigDict(frozen=True)

    kind: str
    title: str
    command: str
    esp_version: str
    mode: Mode
    rows: Literal["panels", "variants"]
    episodes: int
    config: dict[str, JsonValue]
    cells: tuple[CellResult, ...] = Field(min_length=1)

    def reference_of(self, cell: CellResult) -> CellResult | None:
        """Return the cell that one is compared with."""
        return next((other for other in self.cells if other.name == cell.reference), None)

    def content(self) -> dict[str, JsonValue]:
        """Return the content of the document."""
        return self.model_dump(mode="json", exclude_defaults=True)

    def document(self) -> dict[str, JsonValue]:
        """Return the document as `esp report --json` and `--results` write it."""
        return RESULTS_FORMAT.document(self.content())


def read_results(path: Path) -> Results:
    """Read a results file.

    Raises:
        UserError: it is missing, damaged, foreign, or of a newer version.
    """
    return RESULTS_FORMAT.parse(path, Results)


def join(several: Sequence[Results]) -> Results:
    """Return the results of studies of one kind as those of one study, the cells in their order.

    A cell that two of them have with the same returns, as a run and its repetition do, counts once; of a cell that one
    of them has not finished, the other one's returns count.

    Raises:
        UserError: kinds or evaluations that do not go together, or a cell that two of them have with other returns.
    """
    first = several[0]
    if any((r.kind, r.mode, r.rows) != (first.kind, first.mode, first.rows) for r in several):
        raise UserError("results of studies of different kinds, or of different evaluations, have no table in common")
    cells: dict[str, CellResult] = {}
    for results in several:
        for cell in results.cells:
            there = cells.get(cell.name)
            if there is None or (cell.returns and not there.returns):
                whole = {"config": results.config | cell.config, "episodes": cell.episodes or results.episodes}
                cells[cell.name] = cell.model_copy(update=whole)
            elif cell.returns and (there.returns, there.seeds, there.step) != (cell.returns, cell.seeds, cell.step):
                raise UserError(f"{cell.name} stands in two of the results files, with different returns")
    command = "\n".join(dict.fromkeys(results.command for results in several))
    return first.model_copy(update={"command": command, "config": {}, "cells": tuple(cells.values())})
