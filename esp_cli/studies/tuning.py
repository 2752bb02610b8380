"""Tuning: a search of a learner's settings on one task, for each kind of prior, and what it makes of the best."""

from __future__ import annotations

import json
import random
from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path

from esp_cli.algorithms.presets import ALGORITHMS
from esp_cli.checking.measured import planned
from esp_cli.files.formatting import file_name, format_count
from esp_cli.files.writing import replace_file
from esp_cli.studies.catalogue import Request, refuse_other_tasks, refuse_unknown_or_twice, task_setting
from esp_cli.studies.plan import Cell
from esp_cli.studies.search import FIRST_TRIAL_SEED, Candidate, Search
from esp_cli.studies.space import Space, default_space, drawn, of_use, read_space
from esp_cli.training.build import build_learner
from esp_cli.training.config import RunConfig, resolve_config
from esp_envs.errors import UserError

_GIVEN = ("task", "evaluation")  # varied, a search would take the easiest task, or the best-scoring evaluation
_TRIES = 20  # of drawing settings that go together and are new, for each trial
NAMES = {"none": "plain", "esp": "ESP", "auto": "auto", "augment": "augmentation", "consistency": "loss"}


class Tuning(Search):
    """Each kind of prior with its trials.

    Attributes:
        refused: why draws were left out, one text each: their settings do not go together.
        hints: what the best trials tell of the space, one text each.
    """

    title = "Trials of a tuning"
    keeps = False  # a longer search may find another winner

    def __init__(
        self, request: Request, priors: Sequence[str], budget: int, trial_seeds: int = 3, space: Path | None = None
    ) -> None:
        for flag, names in (("--task", request.tasks), ("--algo", request.algorithms), ("--steps", request.steps)):
            if names is not None and len(names) != 1:
                raise UserError(f"esp tune takes one {flag}, not {len(names)}; run it once for each")
        refuse_unknown_or_twice("kind of prior", priors, NAMES)
        self.request, self.priors = request, tuple(priors)
        self.task, self.algorithm = (request.tasks or ("navigation",))[0], (request.algorithms or ("mappo",))[0]
        refuse_other_tasks(request.steps or (), (self.task,))
        ALGORITHMS[self.algorithm]  # refuses an unknown algorithm before the space that it lacks
        self.steps = request.steps[0][1] if request.steps else 500_000
        self.judges = "tuned", f"Tuned settings of {self.algorithm.upper()} on {self.task}, judged on fresh seeds"
        self.trial_seeds = tuple(range(FIRST_TRIAL_SEED, FIRST_TRIAL_SEED + trial_seeds))
        self.overrides = {task_setting(name, self.task): value for name, value in request.overrides.items()}
        self.candidates, self.left_out = tuple((self.task, NAMES[prior]) for prior in priors), {}
        self.space = self._chosen(space)
        self._check()
        self.refused, self.hints = list[str](), list[str]()
        self.draws = self._draws(budget)

    def config(self, prior: str, settings: Mapping[str, object], seeds: Sequence[int]) -> RunConfig:
        """Resolve the run of a kind of prior with these settings over those of all runs, before it is planned.

        Without a prior, none of its settings counts.
        """
        chosen = {**self.overrides, "prior.kind": prior, **of_use(settings, prior)}
        request = self.request
        return resolve_config(self.task, self.algorithm, request.preset, self.steps, seeds, request.device, chosen)

    def _chosen(self, file: Path | None) -> Space:
        """Return the space of a file, or of the default one what a run has."""
        if file is not None:
            return {task_setting(name, self.task): tried for name, tried in read_space(file).items()}
        default = default_space(self.algorithm)
        stored = self.config(self.priors[0], {}, self.trial_seeds).model_dump(mode="json")
        known = {**stored["algorithm_settings"], **stored["network"], **stored["prior"]}
        return {name: tried for name, tried in default.items() if known.get(name.rpartition(".")[2]) is not None}

    def _without_effect(self, prior: str) -> frozenset[str]:
        """Return the settings that change nothing with a prior, at the defaults and at each value that is checked."""
        space = of_use(self.space, prior)
        tried: list[dict[str, object]] = [{name: value} for name, d in space.items() for value in d.corners()]
        configs = (self.config(prior, settings, self.trial_seeds) for settings in ({}, *tried))
        return frozenset.intersection(*(config.without_effect() for config in configs))

    def _check(self) -> None:
        """Refuse what cannot be run."""
        self.refuse_trial_seeds()
        if "prior.kind" in self.overrides or "prior.kind" in self.space:
            raise UserError("a tuning takes the kinds of prior by --prior, not by --set or --space")
        effective, searched = set[str](), set[str]()
        for prior in self.priors:
            space = of_use(self.space, prior)
            if not space:
                raise UserError(
                    f"with --prior {prior} no setting of the space changes anything, so its trials would be equal; add "
                    "a setting of the learner, or leave this prior out"
                )
            for name, dimension in space.items():
                if name.partition(".")[0] in _GIVEN:
                    raise UserError(
                        f"the space varies '{name}', and then trials are not scored alike; leave it out, and fix it by "
                        f"--set {name}=VALUE"
                    )
                if name in self.overrides:
                    raise UserError(f"--set {name} fixes what the space varies; leave it out, or use another --space")
                for value in dimension.corners():
                    self.config(prior, {name: value}, self.trial_seeds)
            searched |= space.keys()
            effective |= space.keys() - self._without_effect(prior)
        if lost := sorted(searched - effective):
            raise UserError(
                f"the space varies '{lost[0]}', which is without effect beside the other settings; leave it out"
            )

    def _draws(self, budget: int) -> list[dict[str, object]]:
        """Return the default settings, and then those drawn that go together and are new."""
        generator, found, tried = random.Random(0), list[dict[str, object]]([{}]), count(1)

        def build(settings: Mapping[str, object]) -> None:
            for prior in self.priors:
                build_learner(planned(self.config(prior, settings, self.trial_seeds)).of_one_seed())

        build({})
        while len(found) < budget and next(tried) <= _TRIES * budget:
            settings = dict[str, object](drawn(self.space, generator))
            if settings in found:
                continue
            try:
                build(settings)
            except UserError as error:
                self.refused.append(str(error))
            else:
                found.append(settings)
        return found

    def trial(self, candidate: Candidate, draw: int) -> Cell:
        prior = self.priors[self.candidates.index(candidate)]
        return Cell(
            name=f"{prior}-{draw:03d}",
            panel=f"{self.task}, {format_count(self.steps)}",
            variant=f"{NAMES[prior]}, trial {draw}",
            config=self.config(prior, self.draws[draw], self.trial_seeds),
        )

    def fresh(self, best: Mapping[Candidate, int]) -> list[Cell]:
        """Return for each kind of prior the run of the default settings and that of the best, which judge it.

        Default settings are compared with those of the plain learner, tuned ones with the tuned plain learner. Where
        that is missing or the run itself, tuned settings are compared with the default ones.
        """
        panel = f"{self.task}, {self.algorithm.upper()}, {format_count(self.steps)}"

        def cell(variant: str, config: RunConfig, beside: Cell | None) -> Cell:
            reference = None if beside is None else beside.name
            return Cell(name=file_name(variant), panel=panel, variant=variant, config=config, reference=reference)

        cells: list[Cell] = []
        plain: tuple[Cell, Cell] | None = None  # with the default settings and with the best
        for prior in sorted(self.priors, key=lambda name: name != "none"):
            name, number = NAMES[prior], best.get((self.task, NAMES[prior]))
            config = self.config(prior, {}, self.request.seeds)
            default = tuned = cell(f"{name}, default", config, plain and plain[0])
            cells.append(default)
            # beside a tuned plain learner the best settings stand though they are the default ones
            if number or (number == 0 and plain is not None and plain[0] != plain[1]):
                config = self.config(prior, self.draws[number], self.request.seeds)
                tuned = cell(f"{name}, tuned (trial {number})", config, plain[1] if plain else default)
                cells.append(tuned)
            if prior == "none":
                plain = default, tuned
        return cells

    def record(self, path: Path, scores: Mapping[Candidate, Sequence[float]], best: Mapping[Candidate, int]) -> None:
        """Write the best settings of each kind of prior, too, for `esp train --config`."""
        super().record(path, scores, best)
        for prior in self.priors:
            if (number := best.get((self.task, NAMES[prior]))) is not None:
                own = of_use(self.draws[number], prior)
                whole = {"task": self.task, "algorithm": self.algorithm, "preset": self.request.preset}
                document = {**whole, "steps": self.steps, **self.overrides, "prior.kind": prior, **own}
                replace_file(path / f"preset-{prior}.json", (json.dumps(document, indent=2) + "\n").encode())
                ends = [f"{name} {value}" for name, value in own.items() if self.space[name].is_at_end(value)]
                if ends:
                    self.hints.append(
                        f"the best of {NAMES[prior]} lies at an end of what was tried: {', '.join(ends)}; a wider "
                        "--space may hold a better one"
                    )
