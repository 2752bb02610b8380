"""The benchmark of symmetry: each method tuned on equal steps on each task, then judged by seeds that no trial had.

One learner at a time, MAPPO unless another is asked for.
"""

from __future__ import annotations

import json
import math
import random
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np

from esp_cli.checking.measured import planned
from esp_cli.files.formatting import file_name, format_exactly
from esp_cli.files.writing import replace_file
from esp_cli.prior.config import of_no_use_to
from esp_cli.studies.catalogue import Request, refuse_other_tasks, refuse_unknown_or_twice, refuse_varied, settings_of
from esp_cli.studies.kinds import KINDS, TRIALS, Settings
from esp_cli.studies.run_set import Cell
from esp_cli.studies.study import Study, StudyFolder
from esp_cli.training.build import build_learner
from esp_cli.training.config import RunConfig, resolve_config
from esp_cli.training.folder_names import FRESH, METRICS
from esp_cli.training.metrics import column, read_last_row, read_metrics
from esp_envs.errors import UserError
from esp_envs.registry import TASKS as TASK_CLASSES

PERCEPTRON, HOMOMORPHIC = "<perceptron>", "<homomorphic>"  # a task's plain network, and the one that commutes
_PLAIN: Settings = {"network.name": PERCEPTRON, "prior.kind": "none"}
_ESP: Settings = {"network.name": PERCEPTRON, "prior.kind": "esp"}
_SETS: Settings = {"network.name": "set", "prior.kind": "none", "mappo.critic_input": "state"}
_RELAXED: Settings = {**_PLAIN, "network.name": "equivariant", "network.group": "d4", "network.relax": 1.0}
METHODS: Mapping[str, Settings] = {
    "plain": _PLAIN,
    "ESP": _ESP,
    "copies": {**_ESP, "prior.kind": "augment"},
    "copies by a bandit": {**_ESP, "prior.kind": "augment", "prior.copies": "bandit"},
    "consistency": {**_ESP, "prior.kind": "consistency"},
    "ESP and orders of agents": {**_ESP, "prior.transforms": "d4*agents"},
    "sets": _SETS,
    "sets, ESP": {**_SETS, "prior.kind": "esp"},
    "equivariant sets": {**_SETS, "network.name": "set-equivariant"},
    "partially equivariant": {**_RELAXED, "network.relaxation": "gate"},
    "local frames": {**_PLAIN, "network.symmetrise": "local-d4"},
    "homomorphic network": {**_PLAIN, "network.name": HOMOMORPHIC, "network.group": "d4"},
    "frame averages": {**_PLAIN, "network.symmetrise": "d4"},
    **{name: {**_PLAIN, **chosen} for name, chosen in KINDS["ablate-breaking"].variants.items() if name != "ESP"},
}
"""The settings of each method, by its name in tables."""


@dataclass(frozen=True)
class Board:
    """A task of the benchmark, and how long methods are tuned and judged there."""

    task: str  # its name
    settings: Settings = field(default_factory=dict)  # of every run, over those of the preset
    trial_steps: int = 60_000  # environment steps per seed of a trial
    steps: int = 200_000  # of the runs of MAPPO that judge; those of other learners are as long as trials
    preset: str = "default"
    networks: tuple[str, str] = ("mlp", "equivariant")  # plain, and homomorphic
    batches: bool = False  # whether horizon and batch are tuned too; their space is that of particle tasks


_NAVIGATION, _PREDATOR_PREY = (Board(name, preset="fast", batches=True) for name in ("navigation", "predator-prey"))


BROKEN: Mapping[str, Settings] = {
    "subgroup": {"task.action_turn_rad": 1.57},
    "feature": {"task.reward_offset": 0.3},
    "region": {"task.mud": 0.9},
    "approximately": {"task.wind": 0.3},
}
"""The four ways of breaking of PEnGUiN (McClellan et al., 2025): turns alone are left, the landmarks of the reward are
not where they are seen, half of the plane is muddy, and all moves are nearly symmetric."""
_VMAS = "esp_envs.adapters.vmas_scenarios"
TASKS: Mapping[str, Board] = {
    "navigation": _NAVIGATION,
    "navigation-8": replace(_NAVIGATION, settings={"task.num_agents": 8}, trial_steps=40_000, steps=100_000),
    "predator-prey": _PREDATOR_PREY,
    "wildlife": Board("wildlife", networks=("mpn", "empn")),
    "formation": Board("formation", {"evaluation.every_steps": 20_000}, 200_000, 500_000),
    "vmas-navigation": Board(f"{_VMAS}:Navigation", trial_steps=20_000, steps=60_000),  # learned in 30k
    "vmas-dispersion": Board(f"{_VMAS}:Dispersion", trial_steps=40_000, steps=120_000),
    **{
        f"{board.task}-{way}": replace(board, settings=settings)
        for board in (_NAVIGATION, _PREDATOR_PREY)
        for way, settings in BROKEN.items()
    },
}
"""By the name that the tables have; other tasks stand for themselves."""

Space = Mapping[str, tuple[object, ...]]
_OFF_POLICY: Space = {
    "learning_rate": (1e-3, 2e-3, 4e-3, 1e-2),
    "gamma": (0.9, 0.95, 0.98, 0.99),
    "td_lambda": (0.3, 0.6, 0.8, 0.9),
    "updates_per_episode": (1, 2),
    "num_envs": (4, 8),
    "epsilon_steps": (5_000, 10_000, 20_000, 50_000),
}
SPACES: Mapping[str, Space] = {
    "mappo": {
        "learning_rate": (1e-3, 2e-3, 4e-3, 8e-3),
        "entropy_coef": (0.001, 0.003, 0.01, 0.03),
        "gamma": (0.9, 0.95, 0.98, 0.99),
        "gae_lambda": (0.8, 0.9, 0.95),
        "num_epochs": (3, 5, 8),
        "num_minibatches": (2, 5, 10),
        "num_envs": (64, 128),
    },
    "maddpg": {
        **_OFF_POLICY,
        "actor_learning_rate": (1e-3, 2e-3, 4e-3, 1e-2),
        "tau": (0.005, 0.01, 0.03),
        "output_penalty": (1e-4, 1e-3, 1e-2),
    },
    "qmix": {**_OFF_POLICY, "target_every": (25, 50, 100, 200), "replay_episodes": (500, 1000, 5000)},
}
"""What is tried of each learner's settings."""
_COEFFICIENT: Space = {"prior.consistency_coef": (0.03, 0.1, 0.3, 1.0)}
_OF_NETWORKS: Space = {"network.relax": (0.1, 0.3, 1.0, 3.0)}
_OF_BATCHES = ("gamma", "num_minibatches", "num_envs")
TRIAL_SEEDS = (100, 101, 102)
_SCORED = 2  # greedy evaluations at the end of a trial whose mean is its score
_RETURN = "eval/return_greedy"


def draws(algorithm: str, count: int) -> list[dict[str, object]]:
    """Return a learner's settings to try, the same for every method and task: the preset's own, then drawn ones."""
    found: list[dict[str, object]] = [{} for _ in range(count)]
    own = {f"{algorithm}.{name}": values for name, values in SPACES[algorithm].items()}
    for seed, space in enumerate(({**own, **_COEFFICIENT}, _OF_NETWORKS)):
        generator = random.Random(seed)
        for one in found[1:]:
            one.update((name, generator.choice(values)) for name, values in space.items())
    return found


def score(run: Path) -> float:
    """Return the mean of a trial's last two greedy evaluations over its seeds, -inf where one is not finite."""
    _, returns = column(read_metrics(run / METRICS), _RETURN)
    return float(np.nan_to_num(returns[-_SCORED:], nan=-np.inf).mean())


class Trials(StudyFolder):
    """The trials of a benchmark: runs without a final evaluation, in whose folder `fresh` is the study that judges."""

    def is_finished(self, cell: Cell) -> bool:
        """Return whether a trial is trained, or has ended without a policy since every seed stopped."""
        last = read_last_row(self.run_path(cell) / METRICS).get(_RETURN)
        return self.is_trained(cell) or (isinstance(last, list) and all(value is None for value in last))

    @classmethod
    def planned(cls, path: Path, study: Study, keep: bool = True) -> tuple[Self, bool]:
        """Return what `create` makes of the folder; what is judged already gets no further trials."""
        if StudyFolder.is_one(path / FRESH) and cls.is_one(path):
            known = {cell.name for cell in cls.open(path).study.cells}
            done = {cell.name for cell in StudyFolder.open(path / FRESH).study.cells}
            for cell in study.cells:
                if cell.name not in known and (judged := cell.name.rpartition("-")[0]) in done:
                    raise UserError(
                        f"{path / FRESH} has judged {judged} already; keep its --budget, or choose another --out"
                    )
        return super().planned(path, study, keep)


class Benchmark:
    """What is asked for: the methods that each task takes, and by "TASK: METHOD" why others are left out."""

    title = "Trials of the benchmark of symmetry"

    def __init__(self, request: Request, budget: int) -> None:
        self.request, self.budget = request, budget
        self.methods = tuple(METHODS if request.variants is None else request.variants)
        self.boards = {name: TASKS.get(name) or Board(name) for name in request.tasks or TASKS}
        self.algorithm = (request.algorithms or ("mappo",))[0]
        self._refuse_wrong()
        self.left_out: dict[str, str] = {}
        for board in self.boards.values():
            if ":" in board.task:
                TASK_CLASSES.register(board.task)
        self.taken = tuple(self._taken())
        lost = [name for name in self.boards if not any(name == task for task, _ in self.taken)]
        if lost and (request.tasks or not self.taken):  # a task that the user named, and that no method can be run on
            raise UserError(self.left_out[f"{lost[0]}: {self.methods[0]}"])

    def _refuse_wrong(self) -> None:
        refuse_unknown_or_twice("method", self.methods, METHODS)
        if len(self.request.algorithms or ()) > 1 or self.algorithm not in SPACES:
            raise UserError(f"this benchmark tunes one learner, whose space it has; --algo {', '.join(SPACES)}")
        if shared := set(self.request.seeds) & set(TRIAL_SEEDS):
            raise UserError(f"seed {min(shared)} belongs to the trials; choose seeds that no trial has")
        own = {name for method in self.methods for name in METHODS[method]}
        for board in self.boards.values():
            varied = own | {name for name in board.settings if name.startswith("task.")}
            refuse_varied(self.request.overrides, [board.task], varied)
        refuse_other_tasks(self.request.steps or (), self.boards)

    def _taken(self) -> Iterator[tuple[str, str]]:
        for name in self.boards:
            for method in self.methods:
                try:
                    build_learner(self.config(name, method, 0, trial=True).of_one_seed())
                except UserError as error:
                    self.left_out[f"{name}: {method}"] = str(error)
                else:
                    yield name, method

    def steps(self, name: str, trial: bool) -> int:
        """Return the steps per seed of a trial on a task or of the runs that judge, in their usual ratio."""
        board, asked = self.boards[name], self.request.steps or ()
        own = [steps for task, steps in asked if task == name] or [steps for task, steps in asked if task is None]
        if len(own) > 1:
            raise UserError(f"--steps gives {name} several numbers; this study takes one for each task")
        if self.algorithm != "mappo":  # so their trials are as long as what judges
            return own[0] if own else board.trial_steps
        steps = own[0] if own else board.steps
        return max(1, steps * board.trial_steps // board.steps) if trial else steps

    def config(self, name: str, method: str, draw: int, trial: bool) -> RunConfig:
        """Return the run of a method on a task with the settings of a draw."""
        board, request, algorithm = self.boards[name], self.request, self.algorithm
        preset = board.preset if (request.preset, algorithm) == ("default", "mappo") else request.preset
        networks = dict(zip((PERCEPTRON, HOMOMORPHIC), board.networks, strict=True))
        of_method, given = (settings_of(some, board.task, algorithm) for some in (METHODS[method], request.overrides))
        own = {key: networks.get(str(value), value) for key, value in of_method.items()}
        idle = {f"prior.{key}" for key in of_no_use_to(str(own["prior.kind"]))}
        idle |= (_OF_NETWORKS.keys() - own.keys()) | given.keys()
        idle |= set() if board.batches else {f"{algorithm}.{key}" for key in _OF_BATCHES}
        drawn = {key: value for key, value in draws(algorithm, self.budget)[draw].items() if key not in idle}
        steps, seeds = self.steps(name, trial), TRIAL_SEEDS if trial else request.seeds
        settings = {**board.settings, **own, **drawn, **given}
        return planned(resolve_config(board.task, algorithm, preset, steps, seeds, request.device, settings))

    def _cell(self, name: str, method: str, draw: int, trial: bool) -> Cell:
        learner = () if self.algorithm == "mappo" else (self.algorithm,)
        stem = "-".join((file_name(name), format_exactly(self.steps(name, trial=False)), *learner))
        own = f"{stem}-{file_name(method)}"
        return Cell(
            name=f"{own}-{draw}" if trial else own,
            panel=", ".join((name, *map(str.upper, learner), format_exactly(self.steps(name, trial)))),
            variant=f"{method}, draw {draw}" if trial else method,
            config=self.config(name, method, draw, trial),
        )

    def _study(self, kind: str, title: str, cells: Iterable[Cell], left_out: Mapping[str, str]) -> Study:
        same = {"command": self.request.command, "episodes": self.request.episodes, "left_out": dict(left_out)}
        return Study(kind=kind, title=title, rows="variants", cells=tuple(cells), **same)

    @cached_property
    def trials_of(self) -> dict[tuple[str, str], list[Cell]]:
        """By task and method its trials, one for each draw."""
        return {pair: [self._cell(*pair, draw, trial=True) for draw in range(self.budget)] for pair in self.taken}

    @property
    def trials(self) -> Study:
        """The plan of the trials of all methods on all tasks."""
        return self._study(TRIALS, self.title, sum(self.trials_of.values(), list[Cell]()), self.left_out)

    def judged(self, trials: Trials, write: bool = True) -> Study:
        """Plan the runs that judge, with each method's best trial, the first of equals; `trials.json` has scores.

        A trial that is not finished counts as 0, for a forecast, which is not to `write`.
        """
        cells, left_out, firsts = list[Cell](), dict(self.left_out), dict[str, str]()
        scores = dict[str, list[float | None]]()
        for (name, method), tried in self.trials_of.items():
            own = [score(trials.run_path(cell)) if trials.is_finished(cell) else 0.0 for cell in tried]
            scores[f"{name}: {method}"] = [value if math.isfinite(value) else None for value in own]
            if max(own) == -math.inf:
                left_out[f"{name}: {method}"] = "a seed stopped in each of its trials"
                continue
            cell = self._cell(name, method, int(np.argmax(own)), trial=False)
            first = firsts.setdefault(name, cell.name)
            cells.append(cell.model_copy(update={"reference": None if first == cell.name else first}))
        if write:
            document = {"draws": draws(self.algorithm, self.budget), "seeds": TRIAL_SEEDS, "scores": scores}
            replace_file(trials.path / "trials.json", (json.dumps(document, indent=1) + "\n").encode())
        if not cells:
            raise UserError(f"a seed stopped in every trial in {trials.path}, so there is nothing to judge")
        title = "Symmetry in multi-agent learning, each method tuned on equal steps"
        return self._study("symmetry", title, cells, left_out)
