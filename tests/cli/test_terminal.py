"""What a person sees at 80 columns: tables that cut no name, and a progress line that keeps what matters."""

import fcntl
import os
import pty
import re
import shlex
import struct
import subprocess
import sys
import termios
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args, get_origin

import pytest
from rich.console import Console
from rich.table import Table
from typer.testing import CliRunner

from esp_cli import console
from esp_cli.app import app, build_command
from esp_cli.commands import COMMANDS
from esp_cli.console import lay_out, progress, streams
from tests.cli.running import TINY_OPTIONS, esp

ROOT = Path(__file__).parents[2]
_runner = CliRunner()
COLUMNS = ("policy", "steps>", "95 % interval>", "what it does")


def shown(rows: list[tuple[str, ...]], width: int, capsys: pytest.CaptureFixture[str]) -> list[str]:
    terminal = Console(width=width, highlight=False)
    for part in lay_out(COLUMNS, rows, terminal):
        terminal.print(part)
    return capsys.readouterr().out.splitlines()


ROWS = [("predator-prey-mappo-esp", "1.5M", "[-115.04, -114.96]", "hunts a prey that is faster than any one of them")]


@pytest.mark.parametrize("width", [200, 80, 70, 60, 44, 36])
def test_no_name_no_number_and_no_word_is_cut_at_any_width(width: int, capsys: pytest.CaptureFixture[str]) -> None:
    lines = shown(ROWS, width, capsys)
    assert max(map(len, lines)) <= width
    words = re.findall(r"[^\s│┃]+", " ".join(lines))
    for cell in ROWS[0]:
        assert set(cell.split()) <= set(words), lines
    assert any("[-115.04, -114.96]" in line for line in lines), "a number stays on one line"


def test_a_table_that_fits_has_lines_and_one_that_cannot_is_a_block_per_row() -> None:
    assert isinstance(lay_out(COLUMNS, ROWS, Console(width=200))[0], Table)
    assert len(lay_out(COLUMNS, ROWS, Console(width=44))) > 3


@pytest.mark.parametrize(("width", "bar"), [(140, 10), (90, 7), (60, 0), (30, 0)])
def test_a_narrow_terminal_shortens_the_bar_before_step_rate_and_time(width, bar, monkeypatch, capsys):
    screen = Console(width=width, force_terminal=True, color_system=None, highlight=False)
    monkeypatch.setattr(progress, "err", screen)
    live = progress.live_progress()
    status = "formation  12.8k/1.25M  9.51k steps/s  12 h 03 min left  [b]"
    live.add_task("", total=4, completed=1, status=status)
    screen.print(live.get_renderable())
    (line,) = capsys.readouterr().out.splitlines()
    assert len(line.rstrip()) <= width
    assert line.startswith(status if width > 60 else status[: width - 2])
    assert line.count("━") == bar, "a quarter is done"


def at_80(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> list[str]:
    terminal = Console(width=80, height=10_000, force_terminal=True, color_system=None, highlight=False)
    monkeypatch.setattr(console, "out", terminal)
    monkeypatch.setattr(streams, "out", terminal)
    text = esp(*arguments).stdout
    return re.sub(r"\x1b\[[0-9;]*m", "", text).splitlines()


def too_wide(lines: list[str]) -> list[str]:
    """Return the lines that are longer than 80 columns, but for commands, which are there to be copied."""
    return [line for line in lines if len(line) > 80 and "esp train" not in line]


@pytest.mark.parametrize(
    "arguments",
    [
        ("tasks",),
        *(("tasks", task) for task in ("navigation", "predator-prey", "formation", "wildlife")),
        ("policies",),
        ("policies", "formation"),
        ("settings",),
        ("eval", "navigation", "--episodes", "2"),
        ("eval", "formation", "--episodes", "2", "--set", "task.horizon=5"),
    ],
    ids=" ".join,
)
def test_what_a_command_prints_fits_80_columns(monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...]) -> None:
    lines = at_80(monkeypatch, *arguments)
    assert len(lines) > 5
    assert too_wide(lines) == []
    assert not any("…" in line for line in lines)


def test_tables_of_runs_fit_80_columns(monkeypatch: pytest.MonkeyPatch, finished: Path, tmp_path: Path) -> None:
    for arguments in (
        ("report", finished),
        ("report", f"plain={finished}", f"esp={finished}", "--at", "100", "--threshold", "-100"),
        ("export", finished, "-f", "numpy", "--seed", "3", "-o", tmp_path / "export"),
        (
            *["reproduce", "table1", "--dry-run", "--task", "navigation", "--algo", "mappo", "--steps", "100"],
            *TINY_OPTIONS,
        ),
    ):
        lines = at_80(monkeypatch, *arguments)
        assert any("navigation" in line or "numpy" in line for line in lines)
        tables = [line for line in lines if not line.startswith("2 runs to do")]
        assert too_wide(tables) == [], arguments
        assert not any("…" in line for line in lines)


def test_a_line_that_is_too_wide_is_found() -> None:
    assert too_wide(["x" * 81, "x" * 80, "esp train " + "x" * 90]) == ["x" * 81]


def on_terminal(*arguments: str, **environment: str) -> str:
    """Return what a process shows on a terminal of 80 columns."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    known = {
        name: value for name, value in os.environ.items() if name not in ("NO_COLOR", "FORCE_COLOR", "COLUMNS", "LINES")
    }
    known |= {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "environments")]), "TERM": "xterm-256color"}
    command = [sys.executable, "-c", "from esp_cli.app import main; main()", *arguments]
    process = subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave, env=known | environment)
    os.close(slave)
    content = b""
    while True:
        try:
            part = os.read(master, 65536)
        except OSError:  # Linux says so when the other side is closed
            break
        if not part:
            break
        content += part
    process.wait()
    os.close(master)
    return content.decode()


COLOUR = re.compile(r"\x1b\[(?:[0-9]+;)*(?:3[0-8]|9[0-7])(?:;[0-9]+)*m")


def test_colours_are_there_and_go_with_no_color() -> None:
    for arguments in (("eval", "--help"), ("nothing",)):
        assert COLOUR.search(on_terminal(*arguments))
        assert not COLOUR.search(on_terminal(*arguments, NO_COLOR="1"))


def test_the_live_line_of_a_training_fits_the_terminal_and_says_what_matters(tmp_path: Path) -> None:
    shown = on_terminal("train", *map(str, TINY_OPTIONS), "--steps", "500", "--out", str(tmp_path / "run"))
    lines = [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", part).rstrip() for part in re.split(r"[\r\n]+", shown)]
    live = [line for line in lines if "steps/s" in line]
    assert live
    assert too_wide(live) == []
    assert re.search(r"navigation .*500/500  \S+ steps/s  0 s left  greedy -[\d.]+", live[-1])


@pytest.mark.parametrize("name", COMMANDS)
def test_help_fits_80_columns_in_groups_and_h_is_short_for_it(name: str) -> None:
    told = _runner.invoke(app, [name, "-h"], env={"COLUMNS": "80"}).stdout
    lines = [line.rstrip() for line in told.splitlines()]
    assert max(map(len, lines)) <= 80
    assert not any("…" in line for line in lines)
    assert told == _runner.invoke(app, [name, "--help"], env={"COLUMNS": "80"}).stdout
    command = build_command(name, COMMANDS[name])
    options = [one for one in command.params if one.opts[0].startswith("-") and not one.hidden]
    assert all(one.opts[0] in told for one in options)
    grouped = [one for one in options if one.rich_help_panel != "Options"]
    assert len(grouped) >= len(options) - 1


def test_defaults_are_told_as_they_are_written() -> None:
    told = " ".join(_runner.invoke(app, ["train", "-h"], env={"COLUMNS": "80"}).stdout.split())
    for default in ("navigation", "mappo", "cpu", "(1M)", "(1)"):
        assert f"[default: {default}]" in told


SEVERAL = ("--steps", "-n", "--prior")
"""Options that a study takes several values of, separated by commas."""


def clashes(commands: Iterable[Any]) -> set[str]:
    kinds: dict[str, set[object]] = {}
    for command in commands:
        for one in command.params:
            if one.opts[0].startswith("-"):
                kind = one.type_descriptor.annotation
                inner = get_args(kind)[0] if get_origin(kind) in (list, tuple) else kind
                for name in one.opts:
                    kinds.setdefault(name, set()).add(str if name in SEVERAL else inner)
    return {name for name, found in kinds.items() if len(found) > 1}


def test_an_option_takes_the_same_kind_of_value_in_every_command() -> None:
    commands = [build_command(name, target) for name, target in COMMANDS.items()]
    assert clashes(commands) == set()
    number = SimpleNamespace(opts=["--view"], type_descriptor=SimpleNamespace(annotation=float))  # a word in render
    assert clashes([*commands, SimpleNamespace(params=[number])]) == {"--view"}


def completed(line: str, **environment: str) -> list[str]:
    """Return what bash is offered at the end of a command line."""
    words = line.split(" ")
    asked = {"_ESP_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)}
    return _runner.invoke(app, [], prog_name="esp", env=asked | environment).stdout.split()


@pytest.mark.parametrize(
    ("line", "offered"),
    [("esp tr", ["train"]), ("esp train --prior aug", ["augment"]), ("esp train --transf", ["--transforms"])],
)
def test_the_shell_is_offered_what_can_follow(line: str, offered: list[str]) -> None:
    assert completed(line) == offered


@pytest.mark.parametrize("closed", ["2>&-", ">&- 2>&-"])
def test_long_work_goes_on_where_nobody_can_read_what_is_said(tmp_path: Path, closed: str) -> None:
    run = f'exec "{sys.executable}" -c "from esp_cli.app import main; main()"'
    words = shlex.join(["train", "--steps", "400", *map(str, TINY_OPTIONS), "--out", "run"])
    done = subprocess.run(["sh", "-c", f"{run} {words} {closed}"], cwd=tmp_path, check=False)
    assert (done.returncode, (tmp_path / "run" / "policy.safetensors").is_file()) == (0, True)
