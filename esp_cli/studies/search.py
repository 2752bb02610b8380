"""A search of settings: the runs of its trials in one folder, and what came out.

Layout::

    tuning.json         what is asked for
    journal.jsonl       Optuna's record of all trials
    trials/PRIOR-NUMBER/    a run folder per trial
    preset-PRIOR.json   the best settings, for esp train --config
    fresh/              the study that evaluates them on seeds that no trial had
    report/             table and figures
    study.lock          held by the process that works on it
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optuna.trial import TrialState

from esp_cli.files.writing import remove_file, replace_file
from esp_cli.studies.run_set import Cell, RefusedError, RunSet, StudyError
from esp_cli.studies.trials import Trials
from esp_cli.studies.tuning import TUNING_FORMAT, Point, Tuning, curve_of, score
from esp_cli.training.build import build_learner
from esp_cli.training.folder_names import JOURNAL, METRICS, TUNING
from esp_cli.training.metrics import elapsed_s, read_last_row
from esp_cli.training.run_folder import checkpoints_in
from esp_envs.errors import UserError


@dataclass(frozen=True)
class Outcome:
    """What came out for one prior."""

    prior: str  # its kind
    trials: int  # that were begun
    completed: int  # trials with a score
    pruned: int  # trials that were ended early, broke, or did not reach the return
    refused: tuple[str, ...]  # why settings did not go together, one text for each such trial; they count as pruned
    env_steps: int  # environment steps of all seeds of all trials
    seconds: float  # of training, all trials added up
    best: int | None  # number of the best trial; None where no trial has a score
    best_score: float | None  # of its curve, on the seeds of the trials
    # of the default settings, where trial 0 had them; None where the space does not hold them all
    default_score: float | None
    settings: Mapping[str, object]  # of the best trial


class Search(RunSet):
    """The folder of a search, whose runs are its trials: those of all priors in turn, each prior with the same budget.

    Args:
        path: the folder, held by the caller's lock.
        tuning: what is asked for.

    Attributes:
        cells: of all trials. The settings of one are proposed when it begins; until then it has the default ones.
        trials: the record.

    Raises:
        StudyError: its journal is damaged.
    """

    document, runs, noun = TUNING, "trials", "tuning"

    def __init__(self, path: Path, tuning: Tuning) -> None:
        super().__init__(path, f"Tuning of {tuning.algorithm.upper()} on {tuning.task}")
        self.tuning, self.trials = tuning, Trials(path / JOURNAL, tuning)
        keys = [(prior, number) for number in range(tuning.budget) for prior in tuning.priors]
        self._keys = {f"{prior}-{number:03d}": (prior, number) for prior, number in keys}
        self.cells = [self._cell(name, {}) for name in self._keys]
        self._begun: dict[str, Any] = {}

    @classmethod
    def create(cls, path: Path, tuning: Tuning) -> Search:
        """Make the folder, or go on with the one that is there, whose budget may grow.

        Raises:
            StudyError: the folder holds another tuning, or something foreign.
        """
        cls.refuse_foreign(path)
        path.mkdir(parents=True, exist_ok=True)
        file = path / cls.document
        if cls.is_one(path):
            there = TUNING_FORMAT.parse(file, Tuning)
            same = {"budget": there.budget, "command": there.command}
            if tuning.model_copy(update=same) != there or tuning.budget < there.budget:
                raise StudyError(
                    f"{path} holds another tuning; go on with it by '{there.command}', or choose another --out"
                )
        TUNING_FORMAT.write(file, tuning.model_dump(mode="json"))
        return cls(path, tuning)

    def _cell(self, name: str, settings: Mapping[str, object]) -> Cell:
        prior = self._keys[name][0]
        return Cell(name=name, panel=prior, variant=name, config=self.tuning.config(prior, settings))

    def is_finished(self, cell: Cell) -> bool:
        """Return whether the record has the end of a trial."""
        return self.trials.is_done(*self._keys[cell.name])

    def begin(self, cell: Cell) -> Cell:
        """Make the run folder of a trial with the settings that are proposed for it; return what it runs.

        Raises:
            RefusedError: they do not go together; the record has that as its end.
            UserError: what is there is damaged or another run.
        """
        if cell.name not in self._begun:
            prior, number = self._keys[cell.name]
            trial = self._begun[cell.name] = self.trials.trial(prior, number)
            try:
                cell = self._cell(cell.name, self.trials.settings(prior, trial))
                build_learner(cell.config.of_one_seed())
            except UserError as error:
                self.trials.end(trial, None, refused=str(error))
                raise RefusedError(str(error)) from None
        self.prepare(cell)
        return cell

    def goes_on(self, cell: Cell) -> bool:
        """Record the curve of a trial; return False once it is complete, broken, or does not keep up."""
        if self.is_finished(cell):
            return False
        trial, curve, complete = self._begun[cell.name], self.curve(cell), self.is_trained(cell)
        keeps_up = self.trials.keeps_up(trial, curve)
        value, broken = score(curve, self.tuning), bool(curve) and not math.isfinite(curve[-1].mean)
        if broken or not (complete or self.tuning.goal != "return"):
            value = None
        if value is None and keeps_up and not (broken or complete):
            return True
        self.trials.end(trial, value)
        return False

    def end(self, cell: Cell) -> None:
        """Remove what a trial that has ended would go on from; a replay is large."""
        for file in checkpoints_in(self.run_path(cell)):
            remove_file(file)

    def curve(self, cell: Cell) -> list[Point]:
        """Return the evaluations of a trial; none before it has begun.

        Raises:
            MetricsError: its metrics are damaged.
        """
        return curve_of(self.run_path(cell) / METRICS)

    def outcome(self, prior: str) -> Outcome:
        """Return what came out for one prior."""
        trials = self.trials.all(prior)
        done = [t for t in trials if t.state == TrialState.COMPLETE]
        best = max(done, key=lambda t: (t.value, -t.number), default=None)
        rows = [read_last_row(self.path / self.runs / f"{prior}-{t.number:03d}" / METRICS) for t in trials]
        return Outcome(
            prior=prior,
            trials=sum(t.state != TrialState.WAITING for t in trials),
            completed=len(done),
            pruned=sum(t.state == TrialState.PRUNED for t in trials),
            refused=self.trials.refused(prior),
            env_steps=len(self.tuning.trial_seeds) * sum(int(row.get("step", 0)) for row in rows),
            seconds=sum(map(elapsed_s, rows)),
            best=None if best is None else best.number,
            best_score=None if best is None else best.value,
            default_score=next((t.value for t in done if t.number == 0 and self.trials.has_defaults(prior, t)), None),
            settings={} if best is None else self.trials.settings(prior, best),
        )

    def write_presets(self, outcomes: Sequence[Outcome]) -> list[Path]:
        """Write the best settings of each prior as a file for `esp train --config`; return the files."""
        tuning, written = self.tuning, []
        for found in outcomes:
            if found.best is None:
                continue
            path = self.path / f"preset-{found.prior}.json"
            whole = {"task": tuning.task, "algorithm": tuning.algorithm, "preset": tuning.preset, "steps": tuning.steps}
            document = {**whole, **tuning.overrides, "prior.kind": found.prior, **found.settings}
            replace_file(path, (json.dumps(document, indent=2) + "\n").encode())
            written.append(path)
        return written
