"""The benchmark of symmetry: each method tuned on equal steps on each task, then judged by seeds that no trial had.

One learner at a time, MAPPO unless another is asked for.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

from esp_cli.checking.measured import planned
from esp_cli.files.formatting import file_name, format_exactly
from esp_cli.studies.catalogue import (
    Request,
    refuse_other_tasks,
    refuse_unknown_or_twice,
    refuse_unused,
    refuse_varied,
    settings_of,
)
from esp_cli.studies.kinds import KINDS, Settings
from esp_cli.studies.plan import Cell
from esp_cli.studies.search import FIRST_TRIAL_SEED, Candidate, Search
from esp_cli.studies.space import LEARNERS, Dimension, drawn, of_learner, of_use
from esp_cli.training.build import build_learner
from esp_cli.training.config import RunConfig, resolve_config
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
    "formation": Board("formation", {"evaluation.every_steps": 20_000}, 80_000),  # as long as the paper's shorter row
    "vmas-navigation": Board(f"{_VMAS}:Navigation", trial_steps=20_000, steps=60_000),  # learned in 30k
    "vmas-dispersion": Board(f"{_VMAS}:Dispersion", trial_steps=40_000, steps=120_000),
    **{
        f"{board.task}-{way}": replace(board, settings=settings)
        for board in (_NAVIGATION, _PREDATOR_PREY)
        for way, settings in BROKEN.items()
    },
}
"""By the name that the tables have; other tasks stand for themselves."""

_OF_NETWORKS = {"network.relax": Dimension(choices=(0.1, 0.3, 1.0, 3.0))}
_OF_BATCHES = ("gamma", "num_minibatches", "num_envs")


def draws(algorithm: str, count: int) -> list[dict[str, object]]:
    """Return a learner's settings to try, the same for every method and task: the preset's own, then drawn ones."""
    found: list[dict[str, object]] = [{} for _ in range(count)]
    for seed, space in enumerate((of_learner(algorithm), _OF_NETWORKS)):
        generator = random.Random(seed)
        for one in found[1:]:
            one.update(drawn(space, generator))
    return found


class Benchmark(Search):
    """The methods that each task takes."""

    title = "Trials of the benchmark of symmetry"
    judges = "symmetry", "Symmetry in multi-agent learning, each method tuned on equal steps"

    def __init__(self, request: Request, budget: int) -> None:
        self.request, self.trial_seeds = request, tuple(range(FIRST_TRIAL_SEED, FIRST_TRIAL_SEED + 3))
        self.methods = tuple(METHODS if request.variants is None else request.variants)
        self.boards = {name: TASKS.get(name) or Board(name) for name in request.tasks or TASKS}
        self.algorithm = (request.algorithms or ("mappo",))[0]
        self._refuse_wrong()
        self.draws = draws(self.algorithm, budget)
        self.left_out: dict[str, str] = {}
        for board in self.boards.values():
            if ":" in board.task:
                TASK_CLASSES.register(board.task)
        self.candidates = tuple(self._taken())
        lost = [name for name in self.boards if not any(name == task for task, _ in self.candidates)]
        if lost and (request.tasks or not self.candidates):  # a task that the user named, and that no method takes
            raise UserError(self.left_out[f"{lost[0]}: {self.methods[0]}"])

    def _refuse_wrong(self) -> None:
        refuse_unknown_or_twice("method", self.methods, METHODS)
        if len(self.request.algorithms or ()) > 1 or self.algorithm not in LEARNERS:
            raise UserError(f"this benchmark tunes one learner, whose space it has; --algo {', '.join(LEARNERS)}")
        self.refuse_trial_seeds()
        own = {name for method in self.methods for name in METHODS[method]}
        for board in self.boards.values():
            varied = own | {name for name in board.settings if name.startswith("task.")}
            refuse_varied(self.request.overrides, [board.task], varied)
        tasks = dict.fromkeys(board.task for board in self.boards.values())
        refuse_unused(self.request.overrides, (*tasks, self.algorithm))
        refuse_other_tasks(self.request.steps or (), self.boards)

    def _taken(self) -> Iterator[Candidate]:
        for name in self.boards:
            for method in self.methods:
                try:
                    build_learner(planned(self.config(name, method, 0, trial=True)).of_one_seed())
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
        """Return the run of a method on a task with the settings of a draw, before it is planned."""
        board, request, algorithm = self.boards[name], self.request, self.algorithm
        preset = board.preset if (request.preset, algorithm) == ("default", "mappo") else request.preset
        networks = dict(zip((PERCEPTRON, HOMOMORPHIC), board.networks, strict=True))
        of_method, given = (settings_of(some, board.task, algorithm) for some in (METHODS[method], request.overrides))
        own = {key: networks.get(str(value), value) for key, value in of_method.items()}
        idle = (_OF_NETWORKS.keys() - own.keys()) | given.keys()
        idle |= set() if board.batches else {f"{algorithm}.{key}" for key in _OF_BATCHES}
        tried = {key: value for key, value in self.draws[draw].items() if key not in idle}
        steps, seeds = self.steps(name, trial), self.trial_seeds if trial else request.seeds
        settings = {**board.settings, **own, **of_use(tried, str(own["prior.kind"])), **given}
        return resolve_config(board.task, algorithm, preset, steps, seeds, request.device, settings)

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

    def trial(self, candidate: Candidate, draw: int) -> Cell:
        return self._cell(*candidate, draw, trial=True)

    def fresh(self, best: Mapping[Candidate, int]) -> list[Cell]:
        """Return one run for each; those of a task are compared with its first."""
        cells, firsts = list[Cell](), dict[str, str]()
        for name, method in filter(best.__contains__, self.candidates):
            cell = self._cell(name, method, best[name, method], trial=False)
            first = firsts.setdefault(name, cell.name)
            cells.append(cell.model_copy(update={"reference": None if first == cell.name else first}))
        return cells
