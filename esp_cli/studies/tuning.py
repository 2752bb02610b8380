"""Tuning: what is asked for, what a trial runs, how its curve is scored, and the study that evaluates the best."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import Field, JsonValue

from esp_cli.checking.measured import planned
from esp_cli.files.documents import DocumentFormat, Strict
from esp_cli.files.formatting import file_name, format_count
from esp_cli.studies.run_set import Cell
from esp_cli.studies.study import Study
from esp_cli.studies.tuning_space import Dimension, space_of
from esp_cli.training.config import RunConfig, resolve_config
from esp_cli.training.metrics import column, read_metrics
from esp_envs.errors import UserError

SMOOTHED = 3  # evaluations, up to the newest, whose mean is the score of a curve
RUNGS = 2  # times that successive halving looks at a trial before its end
REDUCTION = 3  # one of so many trials goes on at each rung, and trains so many times as long
_GIVEN = ("task", "evaluation")  # varied, a search would take the easiest task, or the best-scoring evaluation
NAMES = {"none": "plain", "esp": "ESP", "auto": "auto", "augment": "augmentation", "consistency": "loss"}


class Tuning(Strict):
    """What is asked for."""

    task: str  # its name
    algorithm: str  # its name
    preset: str = "default"  # of every run
    priors: tuple[str, ...]  # kinds of prior; each has a search of its own with the same budget
    budget: int = Field(ge=1)  # trials for each prior
    steps: int = Field(ge=1)  # environment steps per seed of a trial that is not pruned
    trial_seeds: tuple[int, ...]  # of every trial
    overrides: dict[str, JsonValue] = Field({})  # settings of all runs, as `--set` takes them
    space: dict[str, Dimension]  # what is tried
    device: str = "cpu"  # of every run
    command: str = ""  # the command line behind it

    @property
    def title(self) -> str:
        return f"Tuning of {self.algorithm.upper()} on {self.task}"

    def config(self, prior: str, settings: Mapping[str, object], seeds: Sequence[int] | None = None) -> RunConfig:
        """Resolve the run of a prior with these settings over those of all runs."""
        config = planned(self._asked(prior, settings, self.trial_seeds if seeds is None else seeds))
        return RunConfig.model_validate_json(config.model_dump_json())  # a tuple becomes a list, as when read again

    def _asked(self, prior: str, settings: Mapping[str, object], seeds: Sequence[int]) -> RunConfig:
        """Return a run before anything is measured for it."""
        chosen = {**self.overrides, "prior.kind": prior, **settings}
        return resolve_config(self.task, self.algorithm, self.preset, self.steps, seeds, self.device, chosen)

    def default_values(self, prior: str, names: Iterable[str]) -> dict[str, JsonValue]:
        """Return what these settings are where nothing is tried; None of one that a run does not have."""
        config = self.config(prior, {}).model_dump(mode="json")
        sections = {"task": "task_settings", self.algorithm: "algorithm_settings"}
        places = {name: name.partition(".")[::2] for name in names}
        return {name: config[sections.get(section, section)].get(key) for name, (section, key) in places.items()}

    def around_defaults(self) -> Tuning:
        """Return a search whose space holds the default settings too, which trial 0 then has, and no others."""
        values = self.default_values(self.priors[0], self.space)
        own = {name: d.holding(values[name]) for name, d in self.space.items() if values[name] is not None}
        return self.model_copy(update={"space": own})

    def without_effect(self, prior: str) -> frozenset[str]:
        """Return the settings that change nothing with a prior, at the defaults and at each value that is checked."""
        space = space_of(self.space, prior)
        tried: list[dict[str, object]] = [{name: value} for name, d in space.items() for value in d.corners()]
        configs = (self._asked(prior, settings, self.trial_seeds) for settings in ({}, *tried))
        return frozenset.intersection(*(config.without_effect() for config in configs))

    def check(self, seeds: Sequence[int]) -> None:
        """Refuse what cannot be run; `seeds` are those of the runs that judge the best settings."""
        shared = set(seeds) & set(self.trial_seeds)
        if shared:
            raise UserError(f"seed {min(shared)} belongs to the trials; choose --seeds that no trial has")
        if "prior.kind" in self.overrides or "prior.kind" in self.space:
            raise UserError("a tuning takes the kinds of prior by --prior, not by --set or --space")
        effective, searched = set[str](), set[str]()
        for prior in self.priors:
            space = space_of(self.space, prior)
            if not space:
                raise UserError(
                    f"with --prior {prior} no setting of the space changes anything, so its trials would be equal; add "
                    "a setting of the learner, or leave this prior out"
                )
            for name, dimension in space.items():
                self._check_setting(prior, name, dimension)
            searched |= space.keys()
            effective |= space.keys() - self.without_effect(prior)
        if idle := sorted(searched - effective):
            raise UserError(
                f"the space varies '{idle[0]}', which is without effect beside the other settings; leave it out"
            )

    def _check_setting(self, prior: str, name: str, dimension: Dimension) -> None:
        """Refuse a setting that is not the learner's, that --set fixes, or that does not take each value."""
        if name.partition(".")[0] in _GIVEN:
            raise UserError(
                f"the space varies '{name}', and then trials are not scored alike; leave it out, and fix it by "
                f"--set {name}=VALUE"
            )
        if name in self.overrides:
            raise UserError(f"--set {name} fixes what the space varies; leave it out, or use another --space")
        for value in dimension.corners():
            self.config(prior, {name: value})


TUNING_FORMAT = DocumentFormat("esp-tuning", 1, "a tuning of settings")


@dataclass(frozen=True)
class Outcome:
    """What came out for one prior."""

    prior: str
    trials: int  # that were begun
    completed: int  # trials with a score
    pruned: int  # trials that were ended early or broke
    refused: tuple[str, ...]  # why settings did not go together, one text for each such trial; they count as pruned
    env_steps: int  # of all seeds of all trials
    seconds: float  # of training, all trials added up
    best: int | None  # number of the best trial; None where no trial has a score
    best_score: float | None  # of its curve, on the seeds of the trials
    default_score: float | None  # of the default settings; None where the space does not hold them all
    settings: Mapping[str, object]  # of the best trial


@dataclass(frozen=True)
class Point:
    """An evaluation of a trial."""

    step: int  # environment steps per seed
    mean: float  # greedy return, mean over the seeds; NaN where a seed stopped
    value: float  # mean of the newest evaluations up to this one


def curve_of(metrics: Path) -> list[Point]:
    """Return the evaluations of a trial by its metrics file; none before it has begun."""
    rows = [row for row in read_metrics(metrics) if "eval/return_greedy" in row] if metrics.exists() else []
    if not rows:
        return []
    steps, returns = column(rows, "eval/return_greedy")
    means = returns.mean(1).tolist()
    recent = [means[max(0, k + 1 - SMOOTHED) : k + 1] for k in range(len(means))]
    return [Point(int(step), means[k], math.fsum(recent[k]) / len(recent[k])) for k, step in enumerate(steps)]


def score(curve: Sequence[Point]) -> float | None:
    """Return the score of a curve, its last value; None where that is not finite."""
    return curve[-1].value if curve and math.isfinite(curve[-1].value) else None


def fresh_study(
    tuning: Tuning, best: Mapping[str, tuple[int, Mapping[str, object]]], seeds: Sequence[int], episodes: int
) -> Study:
    """Plan the study that evaluates the best settings of each prior, beside the default ones, on seeds of its own.

    Default settings are compared with those of the plain learner, tuned ones with the tuned plain learner. Where that
    is missing or the run itself, tuned settings are compared with the default ones. `best` holds by prior the number of
    the best trial and its settings; a prior without a score is left out.
    """
    panel = f"{tuning.task}, {tuning.algorithm.upper()}, {format_count(tuning.steps)}"

    def cell(variant: str, config: RunConfig, beside: Cell | None) -> Cell:
        reference = None if beside is None else beside.name
        return Cell(name=file_name(variant), panel=panel, variant=variant, config=config, reference=reference)

    cells: list[Cell] = []
    plain: tuple[Cell, Cell] | None = None  # with the default settings and with the best
    for prior in sorted(tuning.priors, key=lambda name: name != "none"):
        default = tuned = cell(f"{NAMES[prior]}, default", tuning.config(prior, {}, seeds), plain and plain[0])
        cells.append(default)
        number, settings = best.get(prior, (0, {}))
        config = tuning.config(prior, settings, seeds)
        # else the default settings were the best, or nothing was; beside a tuned plain learner the best stand anyway
        if config != default.config or (prior in best and plain is not None and plain[0] != plain[1]):
            tuned = cell(f"{NAMES[prior]}, tuned (trial {number})", config, plain[1] if plain else default)
            cells.append(tuned)
        if prior == "none":
            plain = default, tuned
    return Study(
        kind="tuned",
        title=f"Tuned settings of {tuning.algorithm.upper()} on {tuning.task}, judged on fresh seeds",
        command=tuning.command,
        episodes=episodes,
        rows="variants",
        cells=tuple(cells),
    )
