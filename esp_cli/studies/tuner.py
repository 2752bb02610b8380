"""The search: Optuna proposes settings, an engine trains them, and successive halving ends what does not keep up."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import optuna
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from esp_cli.files.documents import shortened
from esp_cli.files.opening import require_held
from esp_cli.files.writing import mend_last_line, remove_file, replace_file
from esp_cli.studies.engine import Engine
from esp_cli.studies.scheduler import Run, Scheduler
from esp_cli.studies.study import StudyError
from esp_cli.studies.tuning import REDUCTION, RUNGS, Point, TuningFolder, score
from esp_cli.studies.tuning_space import space_of
from esp_cli.training.build import build_learner
from esp_cli.training.folder_names import JOURNAL, METRICS
from esp_cli.training.metrics import elapsed_s, read_last_row
from esp_cli.training.run_folder import RunFolder

_REFUSED = "refused"
_SEED = 0


@dataclass(frozen=True)
class Outcome:
    """What came out for one prior.

    Attributes:
        prior: its kind.
        trials: that were begun.
        completed: trials with a score.
        pruned: trials that were ended early, broke, or did not reach the return.
        refused: why settings did not go together, one text for each such trial; they count as pruned.
        env_steps: environment steps of all seeds of all trials.
        seconds: of training, all trials added up.
        best: number of the best trial; None where no trial has a score.
        best_score: of its curve, on the seeds of the trials.
        default_score: of the default settings, where trial 0 had them; None where the space does not hold them all.
        settings: of the best trial.
    """

    prior: str
    trials: int
    completed: int
    pruned: int
    refused: tuple[str, ...]
    env_steps: int
    seconds: float
    best: int | None
    best_score: float | None
    default_score: float | None
    settings: Mapping[str, object]


class Trials:
    """The record of all trials, which Optuna keeps in the tuning's folder.

    Args:
        folder: of the tuning, held by the caller's lock.
    """

    def __init__(self, folder: TuningFolder) -> None:
        self.folder, self.tuning = folder, folder.tuning
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        path = folder.path / JOURNAL
        mend_last_line(path)
        try:
            storage = optuna.storages.JournalStorage(JournalFileBackend(str(path), lock_obj=_HeldLock(path)))
            self.studies = {prior: self._study(storage, prior) for prior in self.tuning.priors}
        except (ValueError, KeyError, TypeError, AttributeError) as error:  # whatever Optuna stumbles over
            raise StudyError(f"{path} is damaged: {shortened(str(error))}; choose another --out") from None

    def _study(self, storage: Any, prior: str) -> Any:
        pruner = optuna.pruners.SuccessiveHalvingPruner(
            min_resource="auto" if self.tuning.goal == "seconds" else max(1, self.tuning.steps // REDUCTION**RUNGS),
            reduction_factor=REDUCTION,
        )
        study = optuna.create_study(
            storage=storage, study_name=prior, direction="maximize", pruner=pruner, load_if_exists=True
        )
        begun = len(study.get_trials(deepcopy=False))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            study.sampler = optuna.samplers.TPESampler(seed=_SEED + begun, multivariate=True, constant_liar=True)
        if not begun:
            study.enqueue_trial(self._defaults(prior))
        return study

    def _defaults(self, prior: str) -> dict[str, object]:
        """Return the default settings, as far as they are in the space."""
        config = self.tuning.config(prior, {}).model_dump(mode="json")
        sections = {"task": "task_settings", self.tuning.algorithm: "algorithm_settings"}
        found = {}
        for name, dimension in space_of(self.tuning.space, prior).items():
            section, _, key = name.partition(".")
            value = dimension.encoded(config[sections.get(section, section)].get(key))
            if value is not None:
                found[name] = value
        return found

    def _has_defaults(self, prior: str, trial: Any) -> bool:
        """Return whether a trial has the default settings: where the space lacks one, another value was proposed."""
        return self.tuning.config(prior, self.settings(prior, trial)) == self.tuning.config(prior, {})

    def trial(self, prior: str, number: int) -> Any:
        """Return a trial that was begun, or begin it."""
        study = self.studies[prior]
        known = study.get_trials(deepcopy=False)
        if number < len(known) and known[number].state != TrialState.WAITING:
            return optuna.trial.Trial(study, known[number]._trial_id)
        return study.ask()

    def settings(self, prior: str, trial: Any) -> dict[str, object]:
        """Return the settings of a trial; those that it does not have yet are proposed."""
        return {name: d.suggest(trial, name) for name, d in space_of(self.tuning.space, prior).items()}

    def is_done(self, prior: str, number: int) -> bool:
        """Return whether a trial has come to its end."""
        known = self.studies[prior].get_trials(deepcopy=False)
        return number < len(known) and known[number].state.is_finished()

    def keeps_up(self, trial: Any, points: Sequence[Point]) -> bool:
        """Record evaluations of a trial that are not recorded yet; return whether the trial may go on after each.

        The first trial may always go on, and so may one that has all its steps.
        """
        known = trial.study.get_trials(deepcopy=False)[trial.number].last_step
        for point in points:
            resource = int(point.seconds) if self.tuning.goal == "seconds" else point.step
            if (known is None or resource > known) and math.isfinite(point.value):
                trial.report(point.value, resource)
                known = resource
                if trial.number > 0 and point.step < self.tuning.steps and trial.should_prune():
                    return False
        return True

    def outcome(self, prior: str) -> Outcome:
        """Return what came out for one prior."""
        trials = self.studies[prior].get_trials(deepcopy=False)
        done = [t for t in trials if t.state == TrialState.COMPLETE]
        best = max(done, key=lambda t: (t.value, -t.number), default=None)
        rows = [read_last_row(self.folder.trial_path(prior, t.number) / METRICS) for t in trials]
        seeds = len(self.tuning.trial_seeds)
        return Outcome(
            prior=prior,
            trials=sum(t.state != TrialState.WAITING for t in trials),
            completed=len(done),
            pruned=sum(t.state == TrialState.PRUNED for t in trials),
            refused=tuple(t.user_attrs[_REFUSED] for t in trials if _REFUSED in t.user_attrs),
            env_steps=seeds * sum(int(row.get("step", 0)) for row in rows),
            seconds=sum(map(elapsed_s, rows)),
            best=None if best is None else best.number,
            best_score=None if best is None else best.value,
            default_score=next((t.value for t in done if t.number == 0 and self._has_defaults(prior, t)), None),
            settings={} if best is None else self.settings(prior, best),
        )


class Tuner(Scheduler):
    """Runs the trials of a tuning side by side: those of all priors in turn, each prior with the same budget.

    Args:
        trials: the record.
        jobs: at once.
        engine: starts them.
    """

    folder: TuningFolder

    def __init__(self, trials: Trials, jobs: int, engine: Engine) -> None:
        folder = trials.folder
        self.trials, self.tuning = trials, folder.tuning
        keys = [(prior, number) for number in range(folder.tuning.budget) for prior in folder.tuning.priors]
        # the settings of a trial are proposed when there is room for it; until then its run has the default ones
        super().__init__(folder, [folder.cell(*key, {}) for key in keys], jobs, engine)
        self._keys = {run.cell.name: key for run, key in zip(self.runs, keys, strict=True)}
        self._begun: dict[str, Any] = {}
        self._ended: set[str] = set()
        for run in self.runs:
            run.status = "finished" if trials.is_done(*self._keys[run.cell.name]) else "waiting"
            if run.status == "finished" and folder.run_path(run.cell).is_dir():  # a kill may have left them
                self._remove_checkpoints(run)

    def _start(self, run: Run) -> None:
        """Begin the trial of a run, or go on with it; record one that is trained to its end."""
        prior, number = self._keys[run.cell.name]
        if run.cell.name in self._ended:  # while a process that a killed search left went on with it
            run.status = "finished"
            return
        if run.cell.name not in self._begun:
            trial = self._begun[run.cell.name] = self.trials.trial(prior, number)
            try:
                run.cell = self.folder.cell(prior, number, self.trials.settings(prior, trial))
                build_learner(run.cell.config.of_one_seed())
            except ValueError as error:  # these settings do not go together
                trial.set_user_attr(_REFUSED, str(error))
                self._tell(run, trial, None)
                run.status, run.message = "finished", str(error)
                return
        super()._start(run)
        if run.status == "finished":
            self._judge(run)

    def _follow(self, run: Run, going: bool) -> None:
        """Look at a trial: end it where it does not keep up."""
        name, step = run.cell.name, run.step
        super()._follow(run, going)
        if name in self._begun and (run.step != step or run.job is None) and name not in self._ended:
            self._judge(run)
        if name in self._ended and run.status in ("failed", "stopped"):  # on purpose
            run.status, run.message = "finished", ""
        if name in self._ended and run.status == "finished":
            self._remove_checkpoints(run)

    def _judge(self, run: Run) -> None:
        """Record the curve of a trial; end the trial where it is complete, broken, or does not keep up."""
        trial, tuning = self._begun[run.cell.name], self.tuning
        if self.trials.is_done(*self._keys[run.cell.name]):
            self._ended.add(run.cell.name)
            return
        curve = self.folder.curve(run.cell)
        if not curve:
            return
        keeps_up = self.trials.keeps_up(trial, curve)
        value, complete = score(curve, tuning), self.folder.is_trained(run.cell)
        broken = not math.isfinite(curve[-1].mean)
        if not broken and value is not None and (complete or tuning.goal != "return"):
            self._tell(run, trial, value)
        elif broken or complete or not keeps_up:
            self._tell(run, trial, None)

    def _tell(self, run: Run, trial: Any, value: float | None) -> None:
        state = TrialState.PRUNED if value is None else TrialState.COMPLETE
        trial.study.tell(trial.number, value, state=state)
        self._ended.add(run.cell.name)
        if run.job is not None:
            run.job.ask_to_stop()

    def _remove_checkpoints(self, run: Run) -> None:
        """Remove what a trial that has ended would go on from; a replay is large."""
        for file in RunFolder.open(self.folder.run_path(run.cell)).checkpoints():
            remove_file(file)


class _HeldLock:
    """No lock: that of the tuning's folder is held, and no kill leaves a file behind."""

    def __init__(self, journal: Path) -> None:
        self._journal = journal

    def acquire(self) -> bool:
        require_held(self._journal)
        return True

    def release(self) -> None:
        pass


def write_presets(folder: TuningFolder, outcomes: list[Outcome]) -> list[Path]:
    """Write the best settings of each prior as a file for `esp train --config`; return the files."""
    tuning, written = folder.tuning, []
    for found in outcomes:
        if found.best is None:
            continue
        path = folder.path / f"preset-{found.prior}.json"
        chosen = {**tuning.overrides, "prior.kind": found.prior, **found.settings}
        whole = {"task": tuning.task, "algorithm": tuning.algorithm, "preset": tuning.preset, "steps": tuning.steps}
        document = {**whole, **chosen}
        replace_file(path, (json.dumps(document, indent=2) + "\n").encode())
        written.append(path)
    return written
