"""A search of settings: the runs of its trials in one folder, and what came out.

Layout::

    tuning.json         what is asked for
    journal.jsonl       Optuna's record of all trials: it proposes their settings, keeps their scores, and prunes
    trials/PRIOR-NUMBER/    a run folder per trial
    preset-PRIOR.json   the best settings, for esp train --config
    fresh/              the study that evaluates them on seeds that no trial had
    report/             table and figures
    study.lock          held by the process that works on it
"""

from __future__ import annotations

import contextlib
import json
import math
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any

import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from esp_cli.files.documents import parse_value
from esp_cli.files.formatting import shortened
from esp_cli.files.writing import mend_last_line, replace_file
from esp_cli.studies.run_set import Cell, RefusedError, RunSet
from esp_cli.studies.tuning import REDUCTION, RUNGS, TUNING_FORMAT, Outcome, Point, Tuning, curve_of, score
from esp_cli.studies.tuning_space import Dimension, space_of
from esp_cli.training.build import build_learner
from esp_cli.training.folder_names import JOURNAL, METRICS, TUNING
from esp_cli.training.metrics import elapsed_s, read_last_row
from esp_cli.training.run_folder import checkpoints_in
from esp_envs.errors import UserError

_REFUSED = "refused"  # attribute of a trial: why its settings do not go together
_SEED = 0


class Search(RunSet):
    """The folder of a search, whose runs are its trials: those of all priors in turn, each prior with the same budget.

    Attributes:
        cells: of all trials. The settings of one are proposed when it begins; until then it has the default ones.
        studies: of Optuna, by prior.
    """

    document, runs, noun = TUNING, "trials", "tuning"

    def __init__(self, path: Path, tuning: Tuning, journal: Path | None = None) -> None:
        super().__init__(path, tuning.title)
        self.tuning = tuning
        keys = [(prior, number) for number in range(tuning.budget) for prior in tuning.priors]
        self._keys = {f"{prior}-{number:03d}": (prior, number) for prior, number in keys}
        self.cells = [self._cell(name, {}) for name in self._keys]
        self._begun: dict[str, Any] = {}
        self._spaces = {prior: space_of(tuning.space, prior) for prior in tuning.priors}
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        journal = journal or path / JOURNAL
        mend_last_line(journal)
        try:
            backend = JournalFileBackend(str(journal), lock_obj=Lock())  # no file that a kill would leave behind
            storage = optuna.storages.JournalStorage(backend)
            self.studies = {prior: self._study(storage, prior) for prior in tuning.priors}
        except Exception as error:  # whatever Optuna stumbles over
            raise self._damaged(shortened(str(error))) from None
        for prior in tuning.priors:
            self._refuse_forged(prior)
            if not self.trials(prior):
                self.studies[prior].enqueue_trial(self._defaults(prior))

    def _damaged(self, what: str) -> UserError:
        return UserError(f"{self.path / JOURNAL} is damaged: {what}; choose another --out")

    @classmethod
    def create(cls, path: Path, tuning: Tuning) -> Search:
        """Make the folder, or go on with the one that is there, whose budget may grow; refuse another one."""
        cls._refuse_other(path, tuning)
        path.mkdir(parents=True, exist_ok=True)
        TUNING_FORMAT.write(path / cls.document, tuning.model_dump(mode="json"))
        return cls(path, tuning)

    @classmethod
    @contextlib.contextmanager
    def looked_at(cls, path: Path, tuning: Tuning) -> Iterator[Search]:
        """Yield what `create` makes of a folder, in which nothing is written: a copy of its record is read."""
        cls._refuse_other(path, tuning)
        with TemporaryDirectory() as scratch:
            copy = Path(scratch) / JOURNAL
            if (path / JOURNAL).is_file():
                shutil.copy(path / JOURNAL, copy)
            yield cls(path, tuning, copy)

    @classmethod
    def _refuse_other(cls, path: Path, tuning: Tuning) -> None:
        cls.refuse_foreign(path)
        if cls.is_one(path):
            there = TUNING_FORMAT.parse(path / cls.document, Tuning)
            same = {"budget": there.budget, "command": there.command}
            if tuning.model_copy(update=same) != there or tuning.budget < there.budget:
                raise UserError(
                    f"{path} holds another tuning; go on with it by '{there.command}', or choose another --out"
                )

    def _study(self, storage: Any, prior: str) -> Any:
        pruner = optuna.pruners.SuccessiveHalvingPruner(
            min_resource=max(1, self.tuning.steps // REDUCTION**RUNGS), reduction_factor=REDUCTION
        )
        study = optuna.create_study(
            storage=storage, study_name=prior, direction="maximize", pruner=pruner, load_if_exists=True
        )
        begun = len(study.get_trials(deepcopy=False))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            study.sampler = optuna.samplers.TPESampler(seed=_SEED + begun, multivariate=True, constant_liar=True)
        return study

    def _refuse_forged(self, prior: str) -> None:
        """Refuse trials that no search with this space leaves behind, before anything is computed from them."""
        space = {name: _distribution(d) for name, d in self._spaces[prior].items()}
        if [direction.name for direction in self.studies[prior].directions] != ["MAXIMIZE"]:
            raise self._damaged("it maximises something else")
        for trial in self.trials(prior):
            try:
                sound = _is_sound(trial, space)
            except (TypeError, AttributeError):  # a part of it is no dictionary, or a number is none
                sound = False
            if not sound:
                raise self._damaged(
                    f"trial {trial.number} of {prior} has settings or scores that no trial of this search has"
                )

    def _defaults(self, prior: str) -> dict[str, object]:
        values = self.tuning.default_values(prior, self._spaces[prior])
        found = {name: self._spaces[prior][name].encoded(value) for name, value in values.items()}
        return {name: value for name, value in found.items() if value is not None}

    def _cell(self, name: str, settings: Mapping[str, object]) -> Cell:
        prior = self._keys[name][0]
        return Cell(name=name, panel=prior, variant=name, config=self.tuning.config(prior, settings))

    def trials(self, prior: str) -> Sequence[Any]:
        return self.studies[prior].get_trials(deepcopy=False)

    def trial(self, prior: str, number: int) -> Any:
        """Return a trial that was begun, or begin it."""
        study, known = self.studies[prior], self.trials(prior)
        if number < len(known) and known[number].state != TrialState.WAITING:
            return optuna.trial.Trial(study, known[number]._trial_id)
        trial = study.ask()
        if trial.number != number:
            raise self._damaged(f"trial {number} of {prior} is missing")
        return trial

    def _settings(self, prior: str, trial: Any) -> dict[str, object]:
        drawn = {name: trial._suggest(name, _distribution(d)) for name, d in self._spaces[prior].items()}
        return {name: parse_value(v) if isinstance(v, str) else v for name, v in drawn.items()}  # choices are JSON

    def is_finished(self, cell: Cell) -> bool:
        prior, number = self._keys[cell.name]
        known = self.trials(prior)
        return number < len(known) and known[number].state.is_finished()

    def begin(self, cell: Cell) -> Cell:
        """Make the run folder of a trial with the settings that are proposed for it; return what it runs."""
        if cell.name not in self._begun:
            prior, number = self._keys[cell.name]
            trial = self._begun[cell.name] = self.trial(prior, number)
            try:
                cell = self._cell(cell.name, self._settings(prior, trial))
                build_learner(cell.config.of_one_seed())
            except UserError as error:
                trial.set_user_attr(_REFUSED, str(error))
                trial.study.tell(trial.number, state=TrialState.PRUNED)
                raise RefusedError(str(error)) from None
        self.prepare(cell)
        return cell

    def goes_on(self, cell: Cell) -> bool:
        """Record the curve of a trial; return False once it is complete, broken, or does not keep up."""
        if self.is_finished(cell):
            return False
        trial, complete = self._begun[cell.name], self.is_trained(cell)
        curve = curve_of(self.run_path(cell) / METRICS)
        keeps_up, broken = self.keeps_up(trial, curve), bool(curve) and not math.isfinite(curve[-1].mean)
        if keeps_up and not (broken or complete):
            return True
        value = score(curve) if complete and not broken else None
        trial.study.tell(trial.number, value, state=TrialState.PRUNED if value is None else TrialState.COMPLETE)
        return False

    def keeps_up(self, trial: Any, points: Sequence[Point]) -> bool:
        """Record evaluations of a trial that are not recorded yet; return whether the trial may go on after each."""
        known = trial.study.get_trials(deepcopy=False)[trial.number].last_step
        for point in points:
            if (known is None or point.step > known) and math.isfinite(point.value):
                trial.report(point.value, point.step)
                known = point.step
                if point.step < self.tuning.steps and trial.should_prune() and trial.number > 0:  # it sets the rungs
                    return False
        return True

    def end(self, cell: Cell) -> None:
        """Remove what a trial that has ended would go on from; a replay is large."""
        for file in checkpoints_in(self.run_path(cell)):
            file.unlink(missing_ok=True)

    def outcome(self, prior: str) -> Outcome:
        trials, tuning = self.trials(prior), self.tuning
        done = [t for t in trials if t.state == TrialState.COMPLETE]
        best = max(done, key=lambda t: (t.value, -t.number), default=None)
        rows = [read_last_row(self.path / self.runs / f"{prior}-{t.number:03d}" / METRICS) for t in trials]
        default = tuning.config(prior, {})
        defaults = (t for t in done[:1] if t.number == 0 and tuning.config(prior, self._settings(prior, t)) == default)
        return Outcome(
            prior=prior,
            trials=sum(t.state != TrialState.WAITING for t in trials),
            completed=len(done),
            pruned=sum(t.state == TrialState.PRUNED for t in trials),
            refused=tuple(t.user_attrs[_REFUSED] for t in trials if _REFUSED in t.user_attrs),
            env_steps=len(tuning.trial_seeds) * sum(int(row.get("step", 0)) for row in rows),
            seconds=sum(map(elapsed_s, rows)),
            best=None if best is None else best.number,
            best_score=None if best is None else best.value,
            default_score=next((t.value for t in defaults), None),
            settings={} if best is None else self._settings(prior, best),
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


def _distribution(dimension: Dimension) -> BaseDistribution:
    if dimension.choices is not None:
        return CategoricalDistribution([json.dumps(value) for value in dimension.choices])
    low, high = dimension.low or 0, dimension.high or 0
    return (IntDistribution if dimension.is_whole else FloatDistribution)(low, high, log=dimension.log)


def _is_sound(trial: Any, space: Mapping[str, BaseDistribution]) -> bool:
    ended, names = trial.state in (TrialState.COMPLETE, TrialState.PRUNED), trial.params.keys()
    if (names != space.keys() if ended else names - space.keys()) or trial.state == TrialState.FAIL:
        return False
    inside = all(
        isinstance(d := space[name], CategoricalDistribution) or d.low <= value <= d.high
        for name, value in trial.params.items()
    )
    rungs = [value for name, value in trial.system_attrs.items() if name.startswith("completed_rung_")]
    values = [] if trial.values is None else list(trial.values)
    return (
        inside
        and all(trial.distributions[name] == space[name] for name in names)
        and (trial.state != TrialState.COMPLETE or len(values) == 1)
        and trial.system_attrs.get("fixed_params", {}).keys() <= space.keys()
        and all(math.isfinite(value) for value in (*trial.intermediate_values.values(), *rungs, *values))
        and isinstance(trial.user_attrs.get(_REFUSED, ""), str)
    )
