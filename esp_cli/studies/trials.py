"""The record of a search: Optuna proposes the settings of trials, keeps what they scored, and prunes."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from esp_cli.files.documents import shortened
from esp_cli.files.opening import require_held
from esp_cli.files.writing import mend_last_line
from esp_cli.studies.run_set import StudyError
from esp_cli.studies.tuning import REDUCTION, RUNGS, Point, Tuning
from esp_cli.studies.tuning_space import Dimension, space_of
from esp_envs.errors import UserError

_REFUSED = "refused"
_FIXED = "fixed_params"
_RUNG = "completed_rung_"
_SEED = 0


class Trials:
    """The trials of a search, by prior; Optuna keeps them in a journal.

    Args:
        path: of the journal, in a folder that the caller's lock holds.
        tuning: what is asked for.

    Raises:
        StudyError: the journal is damaged, or no search with this space wrote it.
    """

    def __init__(self, path: Path, tuning: Tuning) -> None:
        self.path, self.tuning = path, tuning
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        mend_last_line(path)
        try:
            storage = optuna.storages.JournalStorage(JournalFileBackend(str(path), lock_obj=_HeldLock(path)))
            self.studies = {prior: self._study(storage, prior) for prior in tuning.priors}
        except UserError:  # the folder is lost
            raise
        except Exception as error:  # whatever Optuna stumbles over
            raise StudyError(f"{path} is damaged: {shortened(str(error))}; choose another --out") from None
        for prior in tuning.priors:
            self._refuse_forged(prior)
            if not self.all(prior):
                self.studies[prior].enqueue_trial(self._defaults(prior))

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
        return study

    def _refuse_forged(self, prior: str) -> None:
        """Refuse trials that no search with this space leaves behind, before anything is computed from them."""
        space = {name: _distribution(d) for name, d in space_of(self.tuning.space, prior).items()}
        if [direction.name for direction in self.studies[prior].directions] != ["MAXIMIZE"]:
            raise StudyError(f"{self.path} is damaged: it maximises something else; choose another --out")
        for trial in self.all(prior):
            if not _is_sound(trial, space):
                raise StudyError(
                    f"{self.path} is damaged: trial {trial.number} of {prior} has settings or scores that no trial of "
                    "this search has; choose another --out"
                )

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

    def all(self, prior: str) -> Sequence[Any]:
        """Return the trials of a prior, by number."""
        return self.studies[prior].get_trials(deepcopy=False)

    def trial(self, prior: str, number: int) -> Any:
        """Return a trial that was begun, or begin it.

        Raises:
            StudyError: the journal lacks one before it.
        """
        study, known = self.studies[prior], self.all(prior)
        if number < len(known) and known[number].state != TrialState.WAITING:
            return optuna.trial.Trial(study, known[number]._trial_id)
        trial = study.ask()
        if trial.number != number:
            raise StudyError(f"{self.path} is damaged: trial {number} of {prior} is missing; choose another --out")
        return trial

    def settings(self, prior: str, trial: Any) -> dict[str, object]:
        """Return the settings of a trial; those that it does not have yet are proposed."""
        return {name: d.suggest(trial, name) for name, d in space_of(self.tuning.space, prior).items()}

    def has_defaults(self, prior: str, trial: Any) -> bool:
        """Return whether a trial has the default settings: where the space lacks one, another value was proposed."""
        return self.tuning.config(prior, self.settings(prior, trial)) == self.tuning.config(prior, {})

    def is_done(self, prior: str, number: int) -> bool:
        """Return whether a trial has come to its end."""
        known = self.all(prior)
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

    def end(self, trial: Any, value: float | None, refused: str = "") -> None:
        """Record the score of a trial that has come to its end.

        Args:
            trial: of Optuna.
            value: its score; None where it was pruned, broke, or did not reach the return.
            refused: why its settings do not go together, if they do not.
        """
        if refused:
            trial.set_user_attr(_REFUSED, refused)
        trial.study.tell(trial.number, value, state=TrialState.PRUNED if value is None else TrialState.COMPLETE)

    def refused(self, prior: str) -> tuple[str, ...]:
        """Return why settings did not go together, one text for each such trial."""
        return tuple(trial.user_attrs[_REFUSED] for trial in self.all(prior) if _REFUSED in trial.user_attrs)


def _distribution(dimension: Dimension) -> BaseDistribution:
    """Return what Optuna draws the values of a setting from."""
    if dimension.choices is not None:
        return CategoricalDistribution([json.dumps(value) for value in dimension.choices])
    if isinstance(dimension.low, int) and isinstance(dimension.high, int):
        return IntDistribution(dimension.low, dimension.high, log=dimension.log)
    assert dimension.low is not None
    assert dimension.high is not None
    return FloatDistribution(dimension.low, dimension.high, log=dimension.log)


def _is_sound(trial: Any, space: Mapping[str, BaseDistribution]) -> bool:
    """Return whether a search of this space can have left a trial."""
    parts = (trial.params, trial.distributions, trial.system_attrs, trial.user_attrs, trial.intermediate_values)
    if not all(isinstance(part, dict) for part in parts) or not isinstance(trial.values, list | None):
        return False
    ended = trial.state in (TrialState.COMPLETE, TrialState.PRUNED)
    names = trial.params.keys()
    if (names != space.keys() if ended else names - space.keys()) or trial.state == TrialState.FAIL:
        return False
    inside = all(
        trial.distributions[name] == space[name] and _holds(space[name], value) for name, value in trial.params.items()
    )
    fixed = trial.system_attrs.get(_FIXED, {})
    rungs = [value for name, value in trial.system_attrs.items() if name.startswith(_RUNG)]
    scores = [*trial.intermediate_values.values(), *rungs, *(trial.values or ())]
    return (
        inside
        and (trial.state != TrialState.COMPLETE or len(trial.values or ()) == 1)
        and isinstance(fixed, dict)
        and fixed.keys() <= space.keys()
        and all(isinstance(score, float | int) and math.isfinite(score) for score in scores)
        and isinstance(trial.user_attrs.get(_REFUSED, ""), str)
    )


def _holds(distribution: BaseDistribution, value: object) -> bool:
    """Return whether a value of a trial is one of those that are drawn."""
    if isinstance(distribution, CategoricalDistribution):
        return value in distribution.choices
    assert isinstance(distribution, IntDistribution | FloatDistribution)
    kind = int if isinstance(distribution, IntDistribution) else float
    if not isinstance(value, int | kind) or isinstance(value, bool):
        return False
    return distribution.low <= value <= distribution.high


class _HeldLock:
    """No lock: that of the search's folder is held, and no kill leaves a file behind."""

    def __init__(self, journal: Path) -> None:
        self._journal = journal

    def acquire(self) -> bool:
        require_held(self._journal)
        return True

    def release(self) -> None:
        pass
