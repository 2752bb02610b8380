"""The studies of the paper, as lists of runs: table 1, the numbers of agents, and the three ablations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from esp_cli.algorithms.registry import ALGORITHMS
from esp_cli.formatting import format_count
from esp_cli.studies import paper
from esp_cli.studies.study import Cell, Study
from esp_cli.training.config import RunConfig, resolve_config, resolve_task_settings
from esp_envs.registry import task_names

ORDER = ("maddpg", "qmix", "mappo")
"""The algorithms in the order of the paper's table."""
PAPER_PRIOR: dict[str, object] = {"prior.transforms": "rot90", "prior.consistency_coef": 0.5}
"""What the ablations vary one thing of: a quarter turn and c = 0.5, as in the paper."""
TRANSFORM_CHOICES: dict[str, dict[str, object]] = {
    "none": {"prior.kind": "none"},
    "rot90": {"prior.transforms": "rot90"},
    "rot90, rot180": {"prior.transforms": "rot90,rot180", "prior.copies": "all"},
    "rot90, rot180, rot270": {"prior.transforms": "rot90,rot180,rot270", "prior.copies": "all"},
    "rot90, flip": {"prior.transforms": "rot90,flip-x", "prior.copies": "all"},
    "C4, drawn": {"prior.transforms": "c4", "prior.copies": "draw"},
    "D4, drawn": {"prior.transforms": "d4", "prior.copies": "draw"},
}
"""Figures 5a and 5b, with a copy for every element; then two groups of which each minibatch draws one element."""
COEFFICIENTS = (0.0, 0.01, 0.05, 0.1, 0.5, 1.0)
MODULES = {"none": "none", "loss": "consistency", "augmentation": "augment", "both": "esp"}
"""Figure 6a: how the paper calls it -> `prior.kind`."""
ABLATIONS: dict[str, tuple[dict[str, object], dict[str, dict[str, object]]]] = {
    "ablate-transforms": ({"prior.kind": "augment"}, TRANSFORM_CHOICES),
    "ablate-coefficient": (
        {"prior.kind": "consistency", **PAPER_PRIOR},
        {f"c = {c:g}": {"prior.consistency_coef": c} for c in COEFFICIENTS},
    ),
    "ablate-modules": (PAPER_PRIOR, {name: {"prior.kind": value} for name, value in MODULES.items()}),
}
"""Study -> what all of its runs have in common, and its variants; the others are compared with the first."""
TEAMS = ((2, None), (3, None), (4, None), (4, 3))
"""Agents and landmarks of the supplement's table; None is the task's default. Its four agents fit four landmarks best,
the authors' launcher says three."""


@dataclass(frozen=True)
class Request:
    """What a user asked for; None takes the study's own.

    Attributes:
        tasks: names of tasks.
        algorithms: names of algorithms.
        steps: environment steps per seed, each with the task that it is for (None for all).
        seeds: of every run.
        preset: of every run.
        overrides: dotted names to values; those of an algorithm or a task concern its runs alone.
        device: "cpu" or "cuda".
        episodes: per seed, of the final evaluation of a trained policy.
        command: the command line behind it.
    """

    tasks: Sequence[str] | None = None
    algorithms: Sequence[str] | None = None
    steps: Sequence[tuple[str | None, int]] | None = None
    seeds: Sequence[int] = tuple(range(paper.NUM_SEEDS))
    preset: str = "default"
    overrides: Mapping[str, object] = field(default_factory=dict)
    device: str = "cpu"
    episodes: int = 320
    command: str = ""


def plan(kind: str, request: Request) -> Study:
    """Plan one of the studies.

    Args:
        kind: of `KINDS`.
        request: what the user asked for.

    Raises:
        ValueError: an unknown name, a setting that the study varies itself, or runs that cannot be built.
    """
    build, title, rows, own = KINDS[kind]
    for name in request.overrides:
        if name in own:
            raise ValueError(f"--set {name} is what this study varies by itself; leave it out")
    _refuse_unused(request, _tasks(kind, request), _algorithms(kind, request))
    cells = tuple(build(kind, request))
    return Study(
        kind=kind, title=title, command=request.command, episodes=request.episodes, rows=rows, cells=tuple(cells)
    )


def _table1(kind: str, request: Request) -> Iterator[Cell]:
    for task in _tasks(kind, request):
        for steps in _steps(kind, task, request):
            for algorithm in _algorithms(kind, request):
                yield from _pair(task, task, steps, algorithm, request, {}, ("table1", task))


def _agents(kind: str, request: Request) -> Iterator[Cell]:
    (task,) = _tasks(kind, request)
    if task != "navigation":
        raise ValueError(f"the paper varies the number of agents on navigation alone, not on {task}; leave out --tasks")
    for agents, landmarks in TEAMS:
        label = f"N = {agents}" + (f", {landmarks} landmarks" if landmarks else "")
        settings: dict[str, object] = {"task.num_agents": agents, "task.num_landmarks": landmarks}
        place = ("table1", "navigation") if agents == 3 else ("agents", str(agents))
        for steps in _steps(kind, task, request):
            for algorithm in _algorithms(kind, request):
                yield from _pair(task, label, steps, algorithm, request, settings, place)


def _pair(
    task: str,
    label: str,
    steps: int,
    algorithm: str,
    request: Request,
    settings: Mapping[str, object],
    place: tuple[str, ...],
) -> Iterator[Cell]:
    """Yield the plain learner and the one with the prior; the settings that both have are the cell's own."""
    stem = f"{_slug(label)}-{_count(steps)}-{algorithm}"
    for prior, suffix in (("none", ""), ("esp", "-ESP")):
        config = _config(task, algorithm, steps, request, {**settings, "prior.kind": prior})
        yield Cell(
            name=f"{stem}-{'plain' if prior == 'none' else prior}",
            panel=f"{label}, {_count(steps)}",
            variant=f"{algorithm.upper()}{suffix}",
            config=config,
            reference=None if prior == "none" else f"{stem}-plain",
            paper=(*place, str(steps), algorithm, prior) if _comparable(config, settings) else None,
        )


def _ablation(kind: str, request: Request) -> Iterator[Cell]:
    common, choices = ABLATIONS[kind]
    first = next(iter(choices))
    for task in _tasks(kind, request):
        for algorithm in _algorithms(kind, request):
            for steps in _steps(kind, task, request):
                stem = f"{task}-{algorithm}-{_count(steps)}"
                for label, choice in choices.items():
                    config = _config(task, algorithm, steps, request, choice, common)
                    key = None
                    if kind == "ablate-coefficient" and _comparable(config, {}):
                        coefficient = f"{choice['prior.consistency_coef']:g}"
                        key = ("coefficient, read off figure 5c", task, str(steps), algorithm, coefficient)
                    yield Cell(
                        name=f"{stem}-{_slug(label)}",
                        panel=f"{task}, {algorithm.upper()}, {_count(steps)}",
                        variant=label,
                        config=config,
                        reference=None if label == first else f"{stem}-{_slug(first)}",
                        paper=key if paper.reported(key) else None,
                    )


KINDS: dict[str, tuple[Any, str, Any, frozenset[str]]] = {
    "table1": (_table1, "Table 1 of the paper", "panels", frozenset({"prior.kind"})),
    "agents": (
        _agents,
        "Cooperative navigation with 2, 3 and 4 agents, as in the paper's supplement",
        "panels",
        frozenset({"prior.kind", "task.num_agents", "task.num_landmarks"}),
    ),
    "ablate-transforms": (
        _ablation,
        "Number and type of transforms, augmentation alone (figures 5a and 5b)",
        "variants",
        frozenset({"prior.transforms", "prior.copies"}),
    ),
    "ablate-coefficient": (
        _ablation,
        "Coefficient of the consistency loss, loss alone (figure 5c)",
        "variants",
        frozenset({"prior.consistency_coef"}),
    ),
    "ablate-modules": (
        _ablation,
        "Consistency loss and augmentation, each alone and both (figure 6a)",
        "variants",
        frozenset({"prior.kind"}),
    ),
}
"""Study -> its builder, its title, what the rows of its table are, and the settings that it varies by itself."""


def _tasks(kind: str, request: Request) -> tuple[str, ...]:
    return tuple(request.tasks or (paper.tasks() if kind == "table1" else ("navigation",)))


def _algorithms(kind: str, request: Request) -> tuple[str, ...]:
    return tuple(request.algorithms or (("maddpg",) if kind.startswith("ablate") else ORDER))


def _steps(kind: str, task: str, request: Request) -> tuple[int, ...]:
    """Return the numbers of steps of a task.

    500k and 3M name the paper's two rows, which formation has at 200k and 1M; a number written for the task itself is
    taken as it is.
    """
    rows, names = paper.horizons(task), paper.horizons("navigation")
    if request.steps is None:
        both = kind == "ablate-coefficient"  # figure 5c shows both rows
        return (rows or names) if both else (rows or names)[:1]
    own = tuple(steps for name, steps in request.steps if name == task)
    if own:
        return own
    row_of = dict(zip(names, rows, strict=True)) if rows else {}
    return tuple(row_of.get(steps, steps) for name, steps in request.steps if name is None)


def _config(
    task: str,
    algorithm: str,
    steps: int,
    request: Request,
    choice: Mapping[str, object],
    common: Mapping[str, object] | None = None,
) -> RunConfig:
    """Resolve a run: the study's own settings, over them the user's, over them what is varied."""
    settings = dict(common or {})
    for name, value in request.overrides.items():
        section, _, rest = name.partition(".")
        if section == task:
            settings[f"task.{rest}"] = value
        elif section == algorithm or section not in (*ALGORITHMS, *task_names()):
            settings[name] = value
    settings |= choice
    config = resolve_config(task, algorithm, request.preset, steps, request.seeds, request.device, settings)
    return config.model_copy(update={"prior": config.prior.effective()})  # what trains the same is the same run


def _comparable(config: RunConfig, settings: Mapping[str, object]) -> bool:
    """Return whether the task is the paper's, so that its numbers compare: nothing changed that decides the return."""
    own = {name.removeprefix("task."): value for name, value in settings.items()}
    if "actions" in config.task_settings:  # how the agents act is the algorithm's affair
        own["actions"] = config.task_settings["actions"]
    return resolve_task_settings(config.task, own) == config.task_settings


def _refuse_unused(request: Request, tasks: Sequence[str], algorithms: Sequence[str]) -> None:
    """Refuse what would be passed over in silence."""
    for name in request.overrides:
        section = name.partition(".")[0]
        if section in (*ALGORITHMS, *task_names()) and section not in (*tasks, *algorithms):
            raise ValueError(f"--set {name} concerns no run of this study; it has {', '.join((*tasks, *algorithms))}")
    for task, steps in request.steps or ():
        if task is not None and task not in tasks:
            raise ValueError(f"--steps {task}={steps} concerns no run of this study; its tasks are {', '.join(tasks)}")
    unserved = [task for task in tasks if request.steps and not _steps("", task, request)]
    if unserved:
        raise ValueError(f"--steps says nothing about {unserved[0]}; add a number of steps for all tasks, or for it")
    for given, kind in ((tasks, "task"), (algorithms, "algorithm")):
        twice = {name for name in given if given.count(name) > 1}
        if twice:
            raise ValueError(f"the {kind} {twice.pop()} is named twice; name it once")


def _slug(text: str) -> str:
    """Return a name for a folder: "rot90, rot180" -> "rot90-rot180", "N = 2" -> "n-2"."""
    words = "".join(c if c.isalnum() or c == "." else " " for c in text.lower()).split()
    return "-".join(words)


def _count(steps: int) -> str:
    """Return steps in the short form where that is exact, as names carry it: 500000 -> "500k", 1234 -> "1234"."""
    return format_count(steps) if float(f"{steps:.3g}") == steps else str(steps)


def paper_cells(kind: str) -> Iterator[tuple[str, str, tuple[str, ...]]]:
    """Yield panel, variant and place of every number that the paper's table of this kind has; none for ablations."""
    labels = {"table1": [(task, task, ("table1", task)) for task in paper.tasks()]}
    labels["agents"] = [
        (f"N = {agents}", "navigation", ("table1", "navigation") if agents == 3 else ("agents", str(agents)))
        for agents, landmarks in TEAMS
        if landmarks is None
    ]
    for label, task, place in labels.get(kind, ()):
        for steps in paper.horizons(task):
            for algorithm in ORDER:
                for prior, suffix in (("none", ""), ("esp", "-ESP")):
                    key = (*place, str(steps), algorithm, prior)
                    yield f"{label}, {_count(steps)}", f"{algorithm.upper()}{suffix}", key
