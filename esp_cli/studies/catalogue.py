"""Planning: a kind of study and what a user asks for give a list of runs."""

from __future__ import annotations

from collections.abc import Collection, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product

from esp_cli.algorithms.presets import ALGORITHMS, SETS
from esp_cli.checking.measured import planned
from esp_cli.defaults import EPISODES, STUDY_SEEDS
from esp_cli.files.formatting import file_name, format_exactly
from esp_cli.studies import paper
from esp_cli.studies.kinds import GROUP, KINDS, UNBROKEN, Settings, StudyKind, Team
from esp_cli.studies.plan import Cell, Study
from esp_cli.training.build import build_learner
from esp_cli.training.config import RunConfig, resolve_config, resolve_task_settings
from esp_envs.errors import UserError
from esp_envs.registry import task_names


@dataclass(frozen=True)
class Request:
    """What a user asked for; None takes the study's own."""

    tasks: Sequence[str] | None = None  # names of tasks
    algorithms: Sequence[str] | None = None  # names of algorithms
    # environment steps per seed, each with the task that it is for (None for all)
    steps: Sequence[tuple[str | None, int]] | None = None
    seeds: Sequence[int] = STUDY_SEEDS  # of every run
    preset: str = "default"  # of every run
    # dotted names to values; those of an algorithm or a task concern its runs alone
    overrides: Settings = field(default_factory=dict)
    device: str = "cpu"  # "cpu" or "cuda"
    episodes: int = EPISODES  # per seed, of the final evaluation of a trained policy
    variants: Sequence[str] | None = None  # names of the variants, in order; the others are compared with the first
    group: str = "c4"  # whose symmetry a study of networks is about
    # names of the settings that break symmetry in a study of that; all by default
    breakings: Sequence[str] | None = None
    command: str = ""  # the command line behind it


def plan(name: str, request: Request) -> Study:
    """Plan a study of a kind, by its name in `KINDS`."""
    kind = KINDS[name]
    cells = planned_cells(_cells(kind, request), request)
    return Study(
        kind=name, title=kind.title, command=request.command, episodes=request.episodes, rows=kind.rows, cells=cells
    )


def planned_cells(cells: Iterable[Cell], request: Request) -> tuple[Cell, ...]:
    """Return what is run where these cells are asked for."""

    def given(c: RunConfig) -> tuple[str, ...]:
        return tuple(task_setting(k, c.task) for k in request.overrides if concerns(k, c.task, c.algorithm))

    return tuple(
        cell.model_copy(update={"config": planned(cell.config), "given": given(cell.config)}) for cell in cells
    )


def refuse_untrainable(study: Study) -> None:
    """Refuse a study of which a run cannot be built, before there is a folder; a GPU need not be here."""
    for cell in study.cells:
        build_learner(cell.config.of_one_seed())


def without_effect(name: str, request: Request) -> list[str]:
    """Return the settings that a user asked for and that change nothing in any run of a study of this kind."""
    return idle_settings(request.overrides, _cells(KINDS[name], request))


def idle_settings(settings: Iterable[str], cells: Iterable[Cell]) -> list[str]:
    """Return those of a user's settings that change nothing in any cell that is asked for, before it is planned."""
    idle = [(cell.config, cell.config.without_effect()) for cell in cells]
    return [
        setting
        for setting in settings
        if all(task_setting(setting, c.task) in names for c, names in idle if concerns(setting, c.task, c.algorithm))
    ]


def _cells(kind: StudyKind, request: Request) -> tuple[Cell, ...]:
    variants = tuple(kind.variants) if request.variants is None else tuple(request.variants)
    refuse_unknown_or_twice("variant of this study", variants, kind.variants)
    tasks, algorithms = tuple(request.tasks or kind.tasks), tuple(request.algorithms or kind.algorithms)
    refuse_varied(request.overrides, tasks, kind.varies)
    _refuse_unused(kind, request, tasks, algorithms)
    build = _pairs if kind.rows == "panels" else _variants
    return tuple(cell for task in tasks for cell in build(kind, task, algorithms, variants, request))


def refuse_unknown_or_twice(noun: str, names: Sequence[str], known: Collection[str]) -> None:
    """Refuse a name that is not known, or that stands twice."""
    for name in names:
        if name not in known:
            raise UserError(f"'{name}' is no {noun}; choose from {', '.join(map(repr, dict.fromkeys(known)))}")
        if names.count(name) > 1:
            raise UserError(f"'{name}' is named twice; name it once")


def refuse_other_tasks(steps: Iterable[tuple[str | None, int]], tasks: Collection[str]) -> None:
    """Refuse numbers of steps for tasks of which there is no run."""
    for task, number in steps:
        if task is not None and task not in tasks:
            raise UserError(f"--steps {task}={number} concerns no run here; the tasks are {', '.join(tasks)}")


def refuse_unused(settings: Iterable[str], sections: Collection[str]) -> None:
    """Refuse settings of tasks or algorithms of which there is no run."""
    for setting in settings:
        section = setting.rpartition(".")[0]
        if section in (*ALGORITHMS, *task_names()) and section not in sections:
            raise UserError(f"--set {setting} concerns no run of this study; it has {', '.join(sections)}")


def refuse_varied(settings: Iterable[str], tasks: Sequence[str], varied: Container[str]) -> None:
    """Refuse a user's setting that a study chooses itself in runs of one of the tasks."""
    for setting in settings:
        if any(task_setting(setting, task) in varied for task in tasks):
            raise UserError(f"--set {setting} is what this study varies by itself; leave it out")


def _pairs(
    kind: StudyKind, task: str, algorithms: Sequence[str], variants: Sequence[str], request: Request
) -> Iterator[Cell]:
    teams = kind.teams or (Team(task, {}, ("table1", task)),)
    for team, steps, algorithm in product(teams, _steps(kind, task, request), algorithms):
        stem = f"{file_name(team.label)}-{format_exactly(steps)}-{file_name(algorithm)}"
        for variant in variants:
            config = _config(kind, task, algorithm, steps, request, {**team.settings, **kind.variants[variant]})
            prior = config.prior.kind
            yield Cell(
                name=f"{stem}-{file_name(variant)}",
                panel=f"{team.label}, {format_exactly(steps)}",
                variant=paired_name(algorithm, prior),
                config=config,
                reference=None if prior == "none" else f"{stem}-plain",
                paper=(*team.place, str(steps), algorithm, prior) if _comparable(config, team.settings) else None,
            )


def _variants(
    kind: StudyKind, task: str, algorithms: Sequence[str], variants: Sequence[str], request: Request
) -> Iterator[Cell]:
    strengths = [Team(UNBROKEN if kind.breakings else "", {}, ())]
    for setting, values in kind.breakings.get(task, {}).items():
        if request.breakings is None or setting in request.breakings:
            strengths += [Team(f"{setting} {value:g}", {f"task.{setting}": value}, ()) for value in values]
    for strength, algorithm, steps in product(strengths, algorithms, _steps(kind, task, request)):
        heads = [part for part in (task, strength.label) if part]
        stem = "-".join(file_name(part) for part in (*heads, algorithm)) + f"-{format_exactly(steps)}"
        for variant in variants:
            if request.variants is None and variant in kind.without.get(task, ()):
                continue
            choice = {name: request.group if v == GROUP else v for name, v in kind.variants[variant].items()}
            choice |= strength.settings
            config = _config(kind, task, algorithm, steps, request, choice)
            fields = {"task": task, "steps": steps, "algorithm": algorithm, "value": variant.removeprefix("c = ")}
            named = kind.place if steps in kind.steps or "{steps}" in kind.place else ()  # the paper's steps, or these
            place = tuple(part.format(**fields) for part in named)
            yield Cell(
                name=f"{stem}-{file_name(variant)}",
                panel=", ".join([*heads, paired_name(algorithm, "none"), format_exactly(steps)]),
                variant=variant,
                config=config,
                reference=None if variant == variants[0] else f"{stem}-{file_name(variants[0])}",
                paper=place if paper.reported(place) and _comparable(config, {}) else None,
            )


def task_setting(name: str, task: str) -> str:
    """Return a setting as a run of the task calls it: "navigation.wind" is "task.wind" in a run of navigation."""
    section, _, rest = name.rpartition(".")
    return f"task.{rest}" if section == task else name


def _steps(kind: StudyKind, task: str, request: Request) -> tuple[int, ...]:
    rows, names = paper.horizons(task), paper.horizons("navigation")
    if request.steps is None:
        return kind.steps or ((rows or names) if kind.all_rows else (rows or names)[:1])
    own = tuple(steps for name, steps in request.steps if name == task)
    if own:
        return tuple(dict.fromkeys(own))
    row_of = dict(zip(names, rows, strict=True)) if rows else {}
    return tuple(dict.fromkeys(row_of.get(steps, steps) for name, steps in request.steps if name is None))


def _config(kind: StudyKind, task: str, algorithm: str, steps: int, request: Request, choice: Settings) -> RunConfig:
    settings = dict(kind.common)
    if kind.papers_network and request.preset != "paper" and task in SETS.get(algorithm, {}):
        settings["network.name"] = "mlp"
    settings |= {**settings_of(request.overrides, task, algorithm), **choice}
    return resolve_config(task, algorithm, request.preset, steps, request.seeds, request.device, settings)


def settings_of(settings: Settings, task: str, algorithm: str) -> dict[str, object]:
    """Return those settings that concern runs of this task and algorithm, as these call them."""
    return {task_setting(name, task): value for name, value in settings.items() if concerns(name, task, algorithm)}


def concerns(name: str, task: str, algorithm: str) -> bool:
    """Return whether a setting is one of all runs, or of those of this task or algorithm."""
    section = name.rpartition(".")[0]
    return section in (task, algorithm) or section not in (*ALGORITHMS, *task_names())


def _comparable(config: RunConfig, settings: Settings) -> bool:
    """Return whether the task is the paper's, so that its numbers compare: nothing changed that decides the return."""
    own = {name.removeprefix("task."): value for name, value in settings.items()}
    if "actions" in config.task_settings:  # how the agents act is the algorithm's affair
        own["actions"] = config.task_settings["actions"]
    return resolve_task_settings(config.task, own) == config.task_settings


def _refuse_unused(kind: StudyKind, request: Request, tasks: Sequence[str], algorithms: Sequence[str]) -> None:
    """Refuse what would be ignored without a word."""
    other = next((task for task in tasks if kind.only not in (None, task)), None)
    if other is not None:
        raise UserError(f"this study is on {kind.only} alone, not on {other}; leave out --tasks")
    unknown = [task for task in tasks if kind.breakings and task not in kind.breakings]
    if unknown:
        raise UserError(f"this study knows no breaking of {unknown[0]}; its tasks are {', '.join(kind.breakings)}")
    known = dict.fromkeys(setting for task in tasks for setting in kind.breakings.get(task, {}))
    for setting in request.breakings or ():
        if setting not in known:
            raise UserError(f"'{setting}' breaks none of these tasks here; choose from {', '.join(known)}")
    refuse_unused(request.overrides, (*tasks, *algorithms))
    refuse_other_tasks(request.steps or (), tasks)
    unserved = [task for task in tasks if not _steps(kind, task, request)]
    if unserved:
        raise UserError(f"--steps says nothing about {unserved[0]}; add a number of steps for all tasks, or for it")
    refuse_unknown_or_twice("task", tasks, tasks)
    refuse_unknown_or_twice("algorithm", algorithms, algorithms)
    called = {paired_name(algorithm, "none"): algorithm for algorithm in algorithms}
    for algorithm in algorithms:
        if (other := called[name := paired_name(algorithm, "none")]) != algorithm:
            raise UserError(f"tables would call both {algorithm} and {other} {name}; rename yours, or run one alone")


def paired_name(algorithm: str, prior: str) -> str:
    """Return how the paper calls an algorithm without the prior and with it: "MADDPG", "MADDPG-ESP"."""
    return algorithm.rpartition(":")[2].upper() + ("" if prior == "none" else "-ESP")
