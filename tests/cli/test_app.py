"""The application: lazy commands, help without torch, and one exit code per kind of failure."""

import errno
import os
import signal
import subprocess
import sys
import time
import types
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from esp_cli import __version__
from esp_cli.app import app
from esp_cli.commands import COMMANDS
from esp_cli.commands.options import Seeds, StepsOption, seeds_option
from esp_envs.errors import UserError
from tests.cli.test_console import shell

ROOT = Path(__file__).parents[2]
runner = CliRunner()


FAILURES: dict[str, BaseException] = {
    "value": UserError("task 'x' has no\nsymmetry; choose another"),
    "interrupt": KeyboardInterrupt(),
    "missing": FileNotFoundError(errno.ENOENT, "No such file or directory", "runs/a"),
    "denied": PermissionError(errno.EACCES, "Permission denied", "runs/b"),
    "full": OSError(errno.ENOSPC, "No space left on device", "runs/c"),
    "io": OSError(errno.EIO, "Input/output error", "runs/d"),
    "read-only": OSError(errno.EROFS, "Read-only file system", "runs/e"),
    "memory": MemoryError("Unable to allocate 80. GiB for an array"),
    "allocator": RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 80000000000 bytes."),
    "bug": ZeroDivisionError("division by zero"),
    "value bug": ValueError("3 is not in list"),
}


def toy(
    kind: Annotated[str, typer.Argument(help="What to do.")] = "fine",
    steps: StepsOption = 500_000,
    seeds: Annotated[Seeds | None, seeds_option(1)] = None,
) -> None:
    """Fail in the way that is asked for."""
    if kind in FAILURES:
        raise FAILURES[kind]
    typer.echo(f"{kind} {steps} {seeds}")


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch) -> None:
    module = types.ModuleType("toy_command")
    module.toy = toy  # type: ignore[attr-defined]
    module.EPILOG = "Example: esp toy fine --steps 20k"  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "toy_command", module)
    monkeypatch.setitem(COMMANDS, "toy", "toy_command:toy")


def test_a_command_gets_its_parsed_arguments(commands: None) -> None:
    result = runner.invoke(app, ["toy", "hello", "--steps", "1.5M", "--seeds", "2"])
    assert (result.exit_code, result.stdout) == (0, "hello 1500000 (0, 1)\n")


@pytest.mark.parametrize(
    ("kind", "code", "sentence"),
    [
        ("value", 2, "error: task 'x' has no symmetry; choose another"),
        ("interrupt", 130, "interrupted"),
        ("missing", 2, "error: no such file or directory: runs/a; check the path and its permissions"),
        ("denied", 2, "error: permission denied: runs/b; check the path and its permissions"),
        ("full", 1, "error: no space left on device: runs/c; free some space and run the command again, or resume it"),
        ("memory", 1, "error: this needs more memory than there is; choose fewer agents, worlds, episodes or seeds"),
        ("allocator", 1, "error: this needs more memory than there is; choose fewer agents, worlds, episodes or seeds"),
        ("read-only", 1, "error: read-only file system: runs/e; make the file system writable, or choose another path"),
        ("io", 1, "error: input/output error: runs/d; check the disk and the machine"),
    ],
)
def test_a_failure_becomes_one_sentence_and_a_code(commands: None, kind: str, code: int, sentence: str) -> None:
    result = runner.invoke(app, ["toy", kind])
    assert (result.exit_code, result.stderr, result.stdout) == (code, sentence + "\n", "")


def test_an_interrupt_in_the_middle_of_an_import_leaves_at_once(tmp_path: Path) -> None:
    """A library may swallow the exception and go on half imported."""
    (tmp_path / "slow.py").write_text(
        "import pathlib, time\npathlib.Path('begun').touch()\n"
        "try:\n    time.sleep(60)\nexcept BaseException:\n    pass\n"
    )
    heard = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"  # a background job ignores it
    start = f"{heard}; from esp_cli.__main__ import main; main()"
    words = [sys.executable, "-c", start, "train", "--task", "slow:Task"]
    paths = os.pathsep.join([str(ROOT), str(ROOT / "environments")])
    process = subprocess.Popen(
        words, cwd=tmp_path, env=os.environ | {"PYTHONPATH": paths}, stderr=subprocess.PIPE, text=True
    )
    while not (tmp_path / "begun").exists():
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=30)
    assert (process.returncode, told) == (130, "interrupted\n")


@pytest.mark.parametrize("kind", ["bug", "value bug"])
def test_a_bug_keeps_its_traceback(commands: None, kind: str) -> None:
    """A ValueError that no `raise UserError` made is a bug as any other."""
    result = runner.invoke(app, ["toy", kind])
    assert result.exception is FAILURES[kind]


def test_the_traceback_of_a_sentence_can_be_asked_for(commands: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ESP_TRACEBACK", "1")
    assert runner.invoke(app, ["toy", "value"]).exception is FAILURES["value"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["toi"], "there is no command 'toi'; did you mean 'toy'?"),
        (["fly"], "there is no command 'fly'; 'esp --help' lists the commands"),
        (
            ["toy", "--steps", "many"],
            "'many' is not a number of steps; write for example 20000, 500k or 1.5M (see 'esp toy --help')",
        ),
        (["toy", "--seeds", "2,2"], "does not say how many seeds"),
        (["toy", "--speed", "3"], "No such option: --speed"),
        (["--speed"], "No such option: --speed"),
    ],
)
def test_a_slip_on_the_command_line_is_told_in_one_line(commands: None, arguments: list[str], sentence: str) -> None:
    result = runner.invoke(app, arguments)
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1


def test_help_lists_every_command_and_a_command_shows_its_example(commands: None) -> None:
    listing = runner.invoke(app, ["--help"]).stdout
    assert all(f" {name} " in listing for name in COMMANDS)
    assert "Fail in the way that is asked for." in listing
    assert "Example: esp toy fine --steps 20k" in runner.invoke(app, ["toy", "--help"]).stdout


def test_no_arguments_show_the_help() -> None:
    result = runner.invoke(app, [])
    assert "Usage: esp" in result.stdout
    assert result.stderr == ""


def test_only_the_command_that_runs_is_imported(commands: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(COMMANDS, "broken", "no_such_module:run")
    assert runner.invoke(app, ["toy"]).exit_code == 0
    assert isinstance(runner.invoke(app, ["broken"]).exception, ModuleNotFoundError)


def test_every_command_has_help_and_an_example() -> None:
    for name in COMMANDS:
        result = runner.invoke(app, [name, "--help"], env={"COLUMNS": "200"})
        assert result.exit_code == 0, result.output
        assert f"esp {name}" in result.stdout.split("╰")[-1], f"esp {name} --help ends without an example"


def test_scipy_s_statistics_are_imported_only_where_they_are_asked_for() -> None:
    code = "import sys; from esp_cli.policies.statistics import mean_and_sem as m;"
    code += "f = lambda x: (x and m(x), 'scipy.stats' in sys.modules)[1]; print(f([]), f([1.0]), f([1.0, 2.0]))"
    done = shell(f'PYTHON "{code}"')
    assert done.stdout.split() == ["False", "False", "True"], done.stderr


def test_the_version_is_the_packages() -> None:
    assert runner.invoke(app, ["--version"]).stdout == f"esp {__version__}\n"
