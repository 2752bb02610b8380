"""A search: each candidate is tried with the same draws of settings on equal steps, and fresh seeds judge its best one.

Layout of its folder::

    study.json, runs/   the trials, a study whose runs have no final evaluation
    trials.json         the draws, and the score of each trial
    fresh/              the study that judges, on seeds that no trial had
"""

from __future__ import annotations

import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
from pydantic import BaseModel, JsonValue

from esp_cli.files.documents import MAX_DOCUMENT_BYTES, parse_object, validate
from esp_cli.files.opening import read_regular
from esp_cli.files.writing import replace_file
from esp_cli.studies.catalogue import Request, idle_settings, planned_cells
from esp_cli.studies.kinds import TRIALS
from esp_cli.studies.plan import Cell, Study
from esp_cli.studies.study import StudyFolder
from esp_cli.training.folder_names import FRESH, METRICS
from esp_cli.training.metrics import RETURN, column, read_metrics
from esp_envs.errors import UserError

FIRST_TRIAL_SEED = 100  # further trial seeds follow it
_SCORES = "trials.json"
_SCORED = 2  # greedy evaluations at the end of a trial whose mean is its score

Candidate = tuple[str, str]  # the name of its task, and its own


def score(run: Path) -> float:
    """Return the mean of a trial's last two greedy evaluations over its seeds, -inf where one is not finite."""
    _, returns = column(read_metrics(run / METRICS), RETURN)
    return float(np.nan_to_num(returns[-_SCORED:], nan=-np.inf).mean())


class Trials(StudyFolder):
    """The trials of a search: runs without a final evaluation, in whose folder `fresh` is the study that judges."""

    def is_finished(self, cell: Cell) -> bool:
        """Return whether a trial has ended."""
        return (self.is_trained(cell) or self.has_stopped(cell)) and self.is_own(cell)

    @classmethod
    def planned(cls, path: Path, study: Study, keep: bool = True) -> tuple[Self, bool]:
        """Return what `create` makes of the folder; what is judged there keeps its trials.

        Where those that judge are kept, all of a panel have equally many trials; else a search may grow alone.
        """
        if StudyFolder.is_one(path / FRESH) and cls.is_one(path):
            there, done = cls.open(path).study.cells, {c.name for c in StudyFolder.open(path / FRESH).study.cells}
            for panel in dict.fromkeys(cell.panel for cell in study.cells):
                asked, old = (_draws(cells, panel) for cells in (study.cells, there))
                budget = min((len(own) for name, own in old.items() if not keep or name in done), default=0)
                alike = all(len(own) == budget or own == old.get(name) for name, own in asked.items())
                grown = all(own <= asked.get(name, set()) for name, own in old.items())
                if budget and not (alike if keep else grown):
                    raise UserError(
                        f"{path} has trials on {panel}, {budget} each, and {FRESH} judges them; keep its --budget"
                        f"{'' if keep else ' or more, and all its kinds of --prior'}, or choose another --out"
                    )
        return super().planned(path, study)


class Scores(BaseModel):
    """What trials came to."""

    draws: tuple[dict[str, JsonValue], ...]  # settings that were tried
    seeds: tuple[int, ...]  # of each trial
    scores: dict[str, list[float | None]]  # by "PANEL: CANDIDATE" of its trials; None where a seed stopped


class Search(ABC):
    """What is asked for.

    Attributes:
        draws: settings to try, the same for every candidate; the first are none, so that it has its own.
        trial_seeds: of every trial; none of them judges.
        candidates: that are tried.
        left_out: by "TASK: CANDIDATE" why others are not.
    """

    title: ClassVar[str]  # of its trials
    keeps: ClassVar[bool] = True  # whether the study that judges keeps runs that are no longer asked for

    request: Request
    judges: tuple[str, str]  # kind and title of the study that judges
    draws: Sequence[Mapping[str, object]]
    trial_seeds: tuple[int, ...]
    candidates: tuple[Candidate, ...]
    left_out: Mapping[str, str]

    @abstractmethod
    def trial(self, candidate: Candidate, draw: int) -> Cell:
        """Return a candidate's run with the settings of a draw, by its number, before it is planned."""

    @abstractmethod
    def fresh(self, best: Mapping[Candidate, int]) -> list[Cell]:
        """Return the runs that judge, before they are planned, by the number of each candidate's best draw.

        A candidate without one is out.
        """

    def refuse_trial_seeds(self) -> None:
        """Refuse a seed that judges and belongs to the trials."""
        if shared := set(self.request.seeds) & set(self.trial_seeds):
            raise UserError(f"seed {min(shared)} belongs to the trials; choose seeds that no trial has")

    def _study(self, kind: str, title: str, cells: Iterable[Cell], left_out: Mapping[str, str]) -> Study:
        same = {"command": self.request.command, "episodes": self.request.episodes, "left_out": dict(left_out)}
        return Study(kind=kind, title=title, rows="variants", cells=tuple(cells), **same)

    @cached_property
    def trials_of(self) -> dict[Candidate, list[Cell]]:
        """The trials of each candidate, one for each draw."""
        draws = range(len(self.draws))
        return {
            one: list(planned_cells((self.trial(one, draw) for draw in draws), self.request)) for one in self.candidates
        }

    def without_effect(self) -> list[str]:
        """Return the settings that the user asked for and that change nothing in any trial."""
        trials = (self.trial(one, draw) for one in self.candidates for draw in range(len(self.draws)))
        return idle_settings(self.request.overrides, trials)

    @property
    def trials(self) -> Study:
        """The plan of all trials."""
        cells = sum(self.trials_of.values(), list[Cell]())
        return self._study(self.judges[0] + TRIALS, self.title, cells, self.left_out)

    def forecast(self, trials: Trials) -> Study:
        """Plan the runs that judge; for a candidate with trials to do, its last draw stands in for the best."""
        ended = {one: cells for one, cells in self.trials_of.items() if all(map(trials.is_finished, cells))}
        waiting = dict.fromkeys(self.trials_of.keys() - ended.keys(), len(self.draws) - 1)
        return self._judged(trials, _best(_scores(trials, ended)) | waiting)

    def judged(self, trials: Trials) -> Study:
        """Plan the runs that judge, with each candidate's best trial, the first of equals, and record the scores."""
        scores = _scores(trials, self.trials_of)
        best = _best(scores)
        self.record(trials.path, scores, best)
        return self._judged(trials, best)

    def record(self, path: Path, scores: Mapping[Candidate, Sequence[float]], best: Mapping[Candidate, int]) -> None:
        """Write the draws and all scores into the folder of the search, those of candidates of earlier calls too."""
        finite = {one: [value if math.isfinite(value) else None for value in own] for one, own in scores.items()}
        named = {f"{self.trials_of[one][0].panel}: {one[1]}": own for one, own in finite.items()}
        found, file = Scores(draws=tuple(map(dict, self.draws)), seeds=self.trial_seeds, scores=named), path / _SCORES
        with contextlib.suppress(OSError, UserError):
            known = validate(Scores, parse_object(read_regular(file, MAX_DOCUMENT_BYTES) or b"", "text"))
            if all(one == other for one, other in zip(known.draws, found.draws, strict=False)):
                draws = max(known.draws, found.draws, key=len)
                earlier = {name: own for name, own in known.scores.items() if name not in map(": ".join, scores)}
                found = Scores(draws=draws, seeds=found.seeds, scores=earlier | found.scores)
        replace_file(file, (found.model_dump_json(indent=1) + "\n").encode())

    def _judged(self, trials: Trials, best: Mapping[Candidate, int]) -> Study:
        if not best:
            raise UserError(f"a seed stopped in every trial in {trials.path}, so there is nothing to judge")
        failed = {": ".join(one): "a seed stopped in each of its trials" for one in self.candidates if one not in best}
        return self._study(*self.judges, planned_cells(self.fresh(best), self.request), {**self.left_out, **failed})


def _draws(cells: Iterable[Cell], panel: str) -> dict[str, set[str]]:
    """Return the numbers of the trials of a panel by whose they are."""
    found = dict[str, set[str]]()
    for cell in cells:
        name, _, draw = cell.name.rpartition("-")
        if cell.panel == panel:
            found.setdefault(name, set()).add(draw)
    return found


def _scores(trials: Trials, cells: Mapping[Candidate, Sequence[Cell]]) -> dict[Candidate, list[float]]:
    return {one: [score(trials.run_path(cell)) for cell in own] for one, own in cells.items()}


def _best(scores: Mapping[Candidate, Sequence[float]]) -> dict[Candidate, int]:
    """Return the number of the best trial of each candidate that has one with a score."""
    return {one: int(np.argmax(own)) for one, own in scores.items() if max(own) > -math.inf}
