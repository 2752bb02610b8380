"""Wrong command lines, from the commands' own parameters and the settings' own models: each ends in one sentence."""

import contextlib
import os
import random
import shlex
import shutil
import typing
from collections.abc import Iterator
from pathlib import Path
from types import NoneType
from typing import Any, Literal

from pydantic import BaseModel
from typer.testing import CliRunner

from esp_cli.algorithms.presets import ALGORITHMS
from esp_cli.app import app, build_command
from esp_cli.commands import COMMANDS, train
from esp_cli.networks.build import NETWORKS
from esp_cli.prior.config import PriorConfig
from esp_cli.training.config import EvaluationConfig
from esp_envs.registry import task_class, task_names
from tests.bodies.models import biped
from tests.torture.limits import PROCESSOR_S, TooLongError, time_limit
from tests.torture.record import Part

BATCH = 10
WORDS = ("x", "-", "--", "é", "a b", "../../x", "$(x)", "`x`", "x" * 3000, "\udcff", "[bold]", "0x10", "1,", ",", "=a")
INTEGERS = ("x", "1.5", "nan", "inf", "-1", "1e30", "9" * 400, "0x1", "1_", "true", "[1]", "--", "é")
FLOATS = ("x", "nan", "inf", "-inf", "1e999", "true", "[1]", "1,5", "é")
VALUES = (
    '"x"',
    "x",
    "NaN",
    "Infinity",
    "1e999",
    "9" * 400,
    "[]",
    "{}",
    '{"a":1}',
    "[" * 20_000,
    "[1",
    '"',
    "\udcff",
    "null",
)


class Lines(Part):
    def __init__(self, scratch: Path, seed: int) -> None:
        self.scratch, self.seed = scratch / "lines", seed
        self.scratch.mkdir()
        robot = scratch / "robot.xml"
        robot.write_text(biped())
        self.arguments = {"check": {"task": "navigation", "robot": str(robot)}, "mirror": {"model": str(robot)}}
        """Good ones, by command and name."""
        self.commands = {name: build_command(name, target) for name, target in COMMANDS.items()}
        self.settings = dict(_settings())
        self._runner = CliRunner()
        train._train = lambda *_: None  # a run that can begin is not a wrong line

    def run(self, number: int) -> str | None:
        rng = random.Random(f"{self.seed} {number}")
        for _ in range(BATCH):
            with _inside(self.scratch):
                words = self._setting_line(rng) if rng.random() < 0.5 else self._option_line(rng)
                self.done += 1
                wrong = self._try(words)
                left = [entry.name for entry in self.scratch.iterdir()]
                if left:
                    shutil.rmtree(self.scratch)
                    self.scratch.mkdir()
                if wrong or left:
                    return f"esp {shlex.join(words)[:600]}: {wrong or f'leaves {left}'}"
        return None

    def _try(self, words: list[str]) -> str | None:
        try:
            with time_limit():
                result = self._runner.invoke(app, words)
        except TooLongError:
            return f"takes longer than {PROCESSOR_S} s"
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            return f"{type(result.exception).__name__}: {str(result.exception)[:300]}"
        lines = result.stderr.splitlines()
        if result.exit_code != 2:
            return f"exit code {result.exit_code}: {result.stderr[-300:]}"
        if result.stdout or len(lines) != 1 or not lines[0].startswith("error: ") or len(lines[0]) > 8000:
            return f"is not one sentence: {result.output[:300]!r}"
        return None

    def _option_line(self, rng: random.Random) -> list[str]:
        """Return a command with one bad option or argument among good ones."""
        name = rng.choice(list(self.commands))
        command = self.commands[name]
        options = [parameter for parameter in command.params if parameter.param_type_name == "option"]
        words = []
        for argument in command.params:
            if argument.param_type_name == "argument" and (argument.required or rng.random() < 0.5):
                sound = typing.get_args(argument.type_descriptor.annotation) or ("nowhere", "no/such/place", "x" * 300)
                if (good := self.arguments.get(name, {}).get(argument.name)) and rng.random() < 0.7:
                    sound = (good,)
                words += ["nowhere" if isinstance(sound[0], type) else rng.choice(("nowhere", *sound))]
        words += _NEEDED.get(name, [])
        choice = rng.random()
        if choice < 0.1:
            return [rng.choice((name.upper(), name[:-1] + "_", f"{name}x", *WORDS[:6])), *words]
        if choice < 0.2:
            return [name, *words, f"--{rng.choice(('no-such', 'x', 'Steps', 'out-', 'set='))}x"]
        option = rng.choice(options)
        bad = _bad_value(option, rng)
        if bad is None:
            return [name, *words, *([] if words else ["nowhere"]), "surplus", f"--{option.name}-x"]
        return [name, *words, f"{option.opts[0]}={bad}"]

    def _setting_line(self, rng: random.Random) -> list[str]:
        task, algorithm, network = rng.choice(_tasks()), rng.choice(list(ALGORITHMS)), rng.choice(list(NETWORKS))
        words = ["train", "--task", task, "--algo", algorithm, "--network", network, "--steps", "100", "--out", "out"]
        section = rng.choice(["task", algorithm, "network", "prior", "evaluation"])
        model = self.settings[{"task": f"task {task}", "network": f"network {network}"}.get(section, section)]
        name = rng.choice(list(model.model_fields))
        if rng.random() < 0.1:
            name = rng.choice((f"{name}x", name.upper(), "", "__class__", "model_config", "é"))
        return [*words, "--set", f"{section}.{name}={_bad_setting(model, name, rng)}"]


def _tasks() -> list[str]:
    """Return the tasks of every installation; the kills register one of their own."""
    return [name for name in task_names() if ":" not in name]


def _settings() -> Iterator[tuple[str, type[BaseModel]]]:
    yield from ((name, cls.config_class) for name, cls in ALGORITHMS.items())
    yield from ((f"task {name}", task_class(name).Settings) for name in _tasks())
    yield from ((f"network {name}", cls) for name, cls in NETWORKS.items())
    yield from (("prior", PriorConfig), ("evaluation", EvaluationConfig))


def _bad_setting(model: type[BaseModel], name: str, rng: random.Random) -> str:
    annotation = model.model_fields[name].annotation if name in model.model_fields else str
    kinds = {annotation, *typing.get_args(annotation)}
    sound = {"null"} if NoneType in kinds else {"{}", '{"a":1}'} if typing.get_origin(annotation) is dict else set()
    values = [value for value in VALUES if value not in sound]
    if bool in kinds:
        values += ["2", "-1", "0.5"]
    elif int in kinds or float in kinds:
        values += ["true", "false", "1e400"]
        values += ["0.5", "1e30", "-1000000000000"] if int in kinds and float not in kinds else []
    return rng.choice(values)


def _bad_value(option: Any, rng: random.Random) -> str | None:
    kind = option.type_descriptor.annotation
    if option.name in _NUMBERS:
        return rng.choice(_NUMBERS[option.name])
    if kind in (int, float, list[float], tuple[float, float]):
        return rng.choice(INTEGERS if kind is int else FLOATS)
    if typing.get_origin(kind) is Literal or option.name in _NAMES:
        return rng.choice(WORDS[:8])
    return None


_NEEDED = {
    "export": ["-f", "c", "-o", "out"],
    "render": ["-o", "x.gif"],
    "reproduce": ["--dry-run"],
    "ablate": ["--dry-run"],
    "compare-homomorphic": ["--dry-run"],
    "tune": ["--dry-run"],
    "train": ["--out", "out"],
}
_NAMES = (
    "task",
    "tasks",
    "algo",
    "algos",
    "preset",
    "transforms",
    "physics",
    "network",
    "methods",
    "formats",
    "reference",
    "numbers",
    "check",
)
_NUMBERS: dict[str, tuple[str, ...]] = {
    "steps": ("0", "-1", "1e30", "x", "1.5", "nan", "1kk", "500x", "9" * 300),
    "at": ("0", "-1", "1e30", "x", "1.5", "nan", "1kk", "500x", "9" * 300),
    "seeds": ("0", "-1", "x", "1,1", "5000", "1.5", "9" * 300, ",", "1,,2"),
    "seed_list": ("-1", "x", "1,1", "1.5", "9" * 300, ",", "1,,2"),
    "seconds": ("x", "nan", "-1", "true", "[1]", "1,5", "é"),
    "speed": ("0", "nan", "x", "-1", "1e9", "xx"),
    "settings": ("x", "=1", "task.x=1", "mappo=1", "x.y=2", ".=1", "task.=1"),
}


@contextlib.contextmanager
def _inside(folder: Path) -> Iterator[None]:
    old = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(old)
