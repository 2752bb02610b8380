"""The options that the studies share, and the parsers behind them."""

from __future__ import annotations

import copy
import functools
import inspect
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import typer
from typer import Option

from esp_cli.commands import options
from esp_cli.commands.counts import chosen_seeds, parse_count
from esp_cli.defaults import EPISODES, STUDY_SEEDS, Mode
from esp_envs.errors import UserError

if TYPE_CHECKING:
    from esp_cli.studies.catalogue import Request


def parse_names(items: Sequence[str] | None, known: Collection[str] = ()) -> tuple[str, ...] | None:
    """Read names that are repeated or separated by commas: ["mappo,qmix"] -> ("mappo", "qmix").

    Names that are `known` may have ", " in them; of those that fit, the longest is taken. "a,b" is two names.
    """
    names: list[str] = []
    for item in items or ():
        parts = [part for part in item.split(",") if part.strip()]
        while parts:
            end = next((k for k in range(len(parts), 1, -1) if ",".join(parts[:k]).strip() in known), 1)
            names.append(",".join(parts[:end]).strip())
            del parts[:end]
    if items and not names:
        raise UserError(f"'{' '.join(items)}' names nothing; name something, or leave the option out")
    return tuple(names) or None


def parse_study_steps(items: Sequence[str] | None) -> tuple[tuple[str | None, int], ...] | None:
    """Read numbers of steps: ["500k", "formation=1M"] -> ((None, 500000), ("formation", 1000000))."""
    found: list[tuple[str | None, int]] = []
    for item in parse_names(items) or ():
        task, equals, text = item.rpartition("=")
        found.append((task if equals else None, parse_count(text)))
    return tuple(dict.fromkeys(found)) or None


@dataclass
class StudyChoices:
    """The options that all study commands share: annotations hold flags and help, values what was given."""

    tasks: Annotated[
        list[str] | None,
        Option("--task", "--tasks", "-t", help="Tasks, as navigation,formation; by default the paper's."),
    ] = None
    algos: Annotated[
        list[str] | None, Option("--algo", "--algos", "-a", help="Algorithms, as mappo,qmix; by default the paper's.")
    ] = None
    steps: Annotated[
        list[str] | None,
        Option(
            "--steps",
            "-n",
            help="Environment steps per seed; several give a row each. 500k and 3M name the paper's rows, which "
            "formation has at 200k and 1M; formation=500k is taken as it is.",
            metavar="STEPS",
        ),
    ] = None
    seeds: Annotated[options.Seeds | None, options.seeds_option(len(STUDY_SEEDS))] = None
    seed_list: options.SeedListOption = None
    out: Annotated[Path | None, Option("--out", "-o", help="Study folder; by default runs/STUDY.")] = None
    preset: options.PresetOption = "default"
    settings: options.SetOption = None
    device: options.DeviceOption = "cpu"
    episodes: options.EpisodesOption = EPISODES
    jobs: Annotated[
        int | None,
        Option("--jobs", "-j", min=1, max=1000, help="Runs side by side, one thread each; by default one a core."),
    ] = None
    engine: Annotated[
        Literal["local", "ray"],
        Option("--engine", help="What runs the study: this machine, or the nodes of a Ray cluster."),
    ] = "local"
    address: Annotated[
        str | None,
        Option(
            "--address",
            help="Ray cluster, as auto or HOST:6379; by default RAY_ADDRESS, or else a new one on this machine.",
        ),
    ] = None
    gpu_share: Annotated[
        float, Option("--gpu-share", min=0.01, max=1.0, help="Share of a GPU that a run takes on a Ray cluster.")
    ] = 1.0
    dry_run: Annotated[
        bool, Option("--dry-run", help="Say what would be run, how long it takes and what it needs; run nothing.")
    ] = False
    reuse: Annotated[
        list[Path] | None,
        Option(
            "--reuse",
            help="Take finished runs of the same configuration from this study instead of training them again; may be "
            "repeated.",
        ),
    ] = None
    no_check: options.NoCheckOption = False
    json: options.JsonOption = None
    command: str = field(init=False, default="")  # as it was typed
    # what the study's report states; by default the evaluations and the thresholds of its kind
    mode: Mode | None = field(init=False, default=None)
    thresholds: Sequence[float] = field(init=False, default=())

    def folder(self, kind: str) -> Path:
        return self.out or Path("runs") / kind

    def request(self) -> Request:
        from esp_cli.machine import resolve_device
        from esp_cli.studies.catalogue import Request

        overrides = options.parse_assignments(self.settings or [])
        options.register_named(parse_names(self.tasks), parse_names(self.algos), [overrides.get("network.name")])
        on_cluster = (self.engine, self.device) == ("ray", "cuda")  # whose GPU need not be here
        return Request(
            tasks=parse_names(self.tasks),
            algorithms=parse_names(self.algos),
            steps=parse_study_steps(self.steps),
            seeds=chosen_seeds(self.seeds, self.seed_list, STUDY_SEEDS),
            preset=self.preset,
            overrides=overrides,
            device="cuda" if on_cluster else resolve_device(self.device),
            episodes=self.episodes,
            command=self.command,
        )


def study_command(command: Callable[..., None] | None = None, **helps: str) -> Callable[..., Any]:
    """Give a command an option for each field of its parameter `choices: StudyChoices`, where typer looks for them.

    `helps` has, by the name of a field, the help of an option that means something else in this command.
    """
    if command is None:
        return lambda given: study_command(given, **helps)
    own = dict(inspect.signature(command, eval_str=True).parameters)
    del own["choices"]
    shared = dict(inspect.signature(StudyChoices, eval_str=True).parameters)
    for name, text in helps.items():
        kind, option = get_args(shared[name].annotation)
        option = copy.copy(option)
        option.help = text
        shared[name] = shared[name].replace(annotation=Annotated[kind, option])
    context = inspect.Parameter("context", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=typer.Context)
    parameters = sorted([context, *own.values(), *shared.values()], key=lambda one: one.default is not one.empty)

    @functools.wraps(command)
    def with_options(context: typer.Context, **given: Any) -> None:
        arguments = {name: given.pop(name) for name in own}
        choices = StudyChoices(**given)
        choices.command = options.command_line(context)
        command(choices=choices, **arguments)

    with_options.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    with_options.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return with_options
