"""Options and arguments that several commands share, and the parsers behind them.

A command writes `task: TaskOption = "navigation"`: flag, help and parser are declared here, the default in the
command.
"""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import typer
from typer import Argument, Option

from esp_cli import console
from esp_cli.commands.counts import parse_count, parse_seed_list, parse_seeds
from esp_cli.defaults import PriorKind
from esp_envs.errors import UserError

if TYPE_CHECKING:
    from esp_cli.training.config import RunConfig

    Seeds = tuple[int, ...]
else:  # typer trusts the parser for a plain `tuple`, but would read tuple[int, ...] as a pattern of its own
    Seeds = tuple

T = TypeVar("T")
Names = Iterable[Any] | None  # given to an option that may be repeated


def parse_assignments(items: Iterable[str]) -> dict[str, object]:
    """Read settings: "mappo.learning_rate=5e-4" -> {"mappo.learning_rate": 0.0005}; what is not JSON is text."""
    from esp_cli.files.documents import parse_value  # pydantic comes with it, which no help needs

    settings: dict[str, object] = {}
    for item in items:
        name, equals, text = item.partition("=")
        name = name.strip()
        if not equals or not name:
            raise UserError(
                f"--set {item} is not a setting; write --set name=value, as in --set mappo.learning_rate=5e-4"
            )
        if name in settings:
            raise UserError(f"--set names '{name}' twice; set it once")
        try:
            settings[name] = parse_value(text)
        except ValueError:
            if text.lstrip()[:1] in ("[", "{"):
                raise UserError(f"--set {name} has a value that is not JSON; write lists as [64,64]") from None
            settings[name] = text.strip()
    return settings


def note_without_effect(names: Iterable[str]) -> None:
    """Name the settings that were asked for and that change nothing beside the others."""
    if idle := ", ".join(sorted(names)):
        console.note(f"without effect beside the other settings: {idle}")


def note_idle_settings(task: str, chosen: Iterable[str], settings: Mapping[str, object]) -> None:
    """Name the chosen settings of a task that change nothing beside all that it is made with."""
    from esp_envs.registry import task_class

    idle = task_class(task).Settings(**settings).without_effect()
    note_without_effect(f"task.{name}" for name in chosen if name in idle)


def parse_task_settings(items: Iterable[str], physics: str | None = None) -> dict[str, object]:
    """Read settings of the task alone, written as "task.name=value", and the shorthand `--physics`.

    ["task.sensor_noise_m=0.005"], "pymunk" -> {"sensor_noise_m": 0.005, "physics": "pymunk"}; a setting goes before it.
    """
    settings = parse_assignments(items)
    for name in settings:
        if not name.startswith("task."):
            raise UserError(f"--set {name} is not a setting of the task; this command takes only task.NAME=VALUE")
    own = {name.removeprefix("task."): value for name, value in settings.items()}
    return own if physics is None else {"physics": physics, **own}


def check_finite(option: str, *values: float) -> None:
    """Refuse numbers of an option that are not finite, which typer lets through."""
    for value in values:
        if not math.isfinite(value):
            raise UserError(f"{option} {value} is not a finite number; write for example {option} -125")


def command_line(context: typer.Context) -> str:
    """Return the command line as it was typed."""
    return shlex.join(["esp", *context.find_root().obj])


def was_given(context: typer.Context, name: str | None) -> bool:
    """Return whether the command line names the option of a parameter."""
    return getattr(context.get_parameter_source(str(name)), "name", "") == "COMMANDLINE"


def installed_tasks() -> list[str]:
    """Return the names of the robots' tasks, and of those that other packages install; none is imported."""
    from esp_envs.installed import entries

    return [entry.name for entry in entries("esp.tasks")]


def register_named(tasks: Names, algorithms: Names = (), networks: Names = ()) -> None:
    """Admit what this command line names as module:Class; a name of any other form needs nothing."""
    from esp_envs.installed import load

    homes = {
        "esp_envs.registry:TASKS": tasks,
        "esp_cli.algorithms.presets:ALGORITHMS": algorithms,
        "esp_cli.networks.build:NETWORKS": networks,
    }
    for home, names in homes.items():
        for name in names or ():
            if isinstance(name, str) and ":" in name:
                load(home).register(name)


def refuse_unused(configs: Iterable[RunConfig], tasks: Names, algorithms: Names = (), networks: Names = ()) -> None:
    """Refuse a class of the caller, or the task of a run, that nothing which the command works on is made with."""
    made = [{"task": one.task, "algo": one.algorithm, "network": one.network.name} for one in configs]
    for option, names in (("task", tasks), ("algo", algorithms), ("network", networks)):
        used = dict.fromkeys(one[option] for one in made)
        for name in names or ():
            if name and name not in used and (":" in name or option == "task"):
                where = f", where the {option} is {', '.join(used)}" if used else ""
                raise UserError(f"--{option} {name} changes nothing here{where}; leave it out")


def _option_parser(parse: Callable[[str], T], name: str) -> Callable[[str], T]:
    """Wrap a parser so that its message names the option."""

    def parser(value: str) -> T:
        try:
            return parse(value)
        except UserError as failure:
            raise typer.BadParameter(str(failure)) from failure

    parser.__name__ = name
    return parser


def _named_class(value: str) -> str:
    if ":" not in value:
        raise UserError(f"'{value}' is no module:Class; only a class of yours has to be named, so leave it out")
    return value


_own_class = _option_parser(_named_class, "module:Class")


def not_over_a_run(context: typer.Context, path: T) -> T:
    """Return the path of an option that writes a table or results, unless it is a folder or what a run or study needs.

    Only `esp eval` may write the final evaluation of a run.
    """
    from esp_cli.training import folder_names as of

    if path is None or str(path) == "-":
        return path
    from esp_cli.files.documents import begins_with  # pydantic comes with it, which no help needs
    from esp_cli.files.writing import refuse_unwritable

    real = Path(os.path.realpath(str(path)))  # a link is followed when it is written
    if real.is_dir():  # known before hours of work
        raise UserError(f"{path} is a folder; name a file in it")
    refuse_unwritable(str(path))
    documents = (of.CONFIG, of.STUDY)
    names = (*documents, of.METRICS, of.POLICY, of.INITIAL, of.LOCK, of.STUDY_LOCK)
    owned = real.name in (names if context.info_name == "eval" else (*names, of.FINAL))
    home = next((folder.parent for folder in real.parents if folder.name == of.CHECKPOINTS), None)
    for folder in (real.parent if owned else None, home):
        if folder and any(begins_with(folder / name, '"format": "esp-') for name in documents):
            raise UserError(f"{path} belongs to the run or study in {folder}; write to another file")
    return path


TaskOption = Annotated[str, Option("--task", "-t", help="Task: one that `esp tasks` lists, or module:Class.")]
_OWN: dict[str, Any] = {"parser": _own_class, "metavar": "MODULE:CLASS"}
OwnTaskOption = Annotated[
    list[str] | None, Option("--task", help="Import your task, on which the run or policy was trained.", **_OWN)
]
AlgoOption = Annotated[str, Option("--algo", "-a", help="Learning algorithm: mappo, maddpg, qmix, or module:Class.")]
OwnAlgoOption = Annotated[
    list[str] | None, Option("--algo", help="Import your algorithm, which trained the run.", **_OWN)
]
OwnNetworkOption = Annotated[
    list[str] | None, Option("--network", help="Import your network, which the run uses.", **_OWN)
]
PresetOption = Annotated[
    str, Option("--preset", help="'default' (measured best), 'fast' (fewer seconds) or 'paper' (the paper's settings).")
]
StepsOption = Annotated[
    int,
    Option(
        "--steps",
        "-n",
        help="Environment steps per seed, as 20000, 500k or 3M.",
        metavar="STEPS",
        parser=_option_parser(parse_count, "STEPS"),
    ),
]


def seeds_option(default: int) -> Any:
    """Return `--seeds` of a command that trains this many by default."""
    return Option(
        "--seeds",
        "-s",
        help="How many seeds to train at once: 10 means the seeds 0 to 9.",
        show_default=str(default),
        metavar="COUNT",
        parser=_option_parser(parse_seeds, "COUNT"),
    )


SeedListOption = Annotated[
    Seeds | None,
    Option(
        "--seed-list",
        help="Which seeds to train at once, by number, as 3,7.",
        metavar="SEEDS",
        parser=_option_parser(parse_seed_list, "SEEDS"),
    ),
]
OutOption = Annotated[Path, Option("--out", "-o", help="Path of the output.")]
Device = Literal["auto", "cpu", "cuda"]
NoCheckOption = Annotated[
    bool, Option("--no-check", help="Skip the check, of at most 2 s, of a task that is not built in.")
]
DeviceOption = Annotated[Device, Option("--device", help="cpu, cuda, or auto: a GPU if there is one.")]
JsonOption = Annotated[
    str | None,
    Option(
        "--json",
        help="Also write the result as JSON to this file; - writes it to standard output instead.",
        callback=not_over_a_run,
    ),
]
SecondsOption = Annotated[
    float,
    Option("--seconds", min=1, help="Time for it; what does not fit in is not covered. Declared elements come first."),
]
RootOption = Annotated[
    Path | None, Option("--root", help="Folder that holds all files of a robot; by default its own.", metavar="DIR")
]
OrderOption = Annotated[
    str | None,
    Option(
        "--order",
        help="Joints in your simulator's order, one a line; or a function that says what all your numbers are.",
        metavar="FILE|MODULE:NAME",
    ),
]
ForceOption = Annotated[bool, Option("--force", help="Overwrite existing output.")]
EpisodesOption = Annotated[
    int, Option("--episodes", "-e", min=1, max=1_000_000, help="Episodes per seed.", metavar="COUNT")
]
SetOption = Annotated[
    list[str] | None,
    Option("--set", help="Change one setting, as mappo.learning_rate=5e-4; repeatable.", metavar="NAME=VALUE"),
]
TaskSetOption = Annotated[
    list[str] | None,
    Option(
        "--set", help="Change one setting of the task, as task.sensor_noise_m=0.005; repeatable.", metavar="NAME=VALUE"
    ),
]
PhysicsOption = Annotated[
    str | None, Option("--physics", help="Short for --set task.physics=NAME: mujoco, mujoco-3d, pymunk.")
]
TransformsOption = Annotated[
    str | None,
    Option("--transforms", help="Elements (rot90,flip-x) or a group (c4, d4) that the prior uses, or discovered."),
]
PolicyArgument = Annotated[
    Path,
    Argument(
        help="Run folder, policy file, or bundled policy by its task or its name (`esp policies`).",
        metavar="RUN|POLICY",
    ),
]
BundledAlgoOption = Annotated[
    str | None,
    Option(
        "--algo",
        "-a",
        help="Choose the bundled policy that this algorithm trained; or import module:Class, which trained the run.",
    ),
]
BundledPriorOption = Annotated[
    PriorKind | None, Option("--prior", help="Choose the bundled policy with this prior (none: the plain learner).")
]
