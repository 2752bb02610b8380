"""The `esp` application: finds commands by name, imports them when asked for, and turns failures into exit codes.

Exit codes: 0 done; 1 the machine failed (a full or read-only disk), or a bug (with its traceback); 2 the user can
correct it: one sentence on standard error, no traceback; 130 interrupted. ESP_TRACEBACK=1 shows the traceback of a
sentence too.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated, Any

import typer
from typer import Option
from typer.core import TyperGroup

from esp_cli import console, machine
from esp_cli.commands import COMMANDS
from esp_cli.commands.help import arrange
from esp_cli.defaults import __version__
from esp_cli.files import formatting
from esp_envs.errors import UserError
from esp_envs.installed import last_line, raised_in

_LACK_OF_MEMORY = re.compile("can't allocate memory|out of memory")  # as torch says it
_LOOKS: dict[str, Any] = {
    "context_settings": {"help_option_names": ["-h", "--help"]},
    "pretty_exceptions_enable": False,
    "rich_markup_mode": "rich",
}
_OTHER_NAMES = {
    "--seed": ("--seed-list", "--seeds 3 takes the seeds 0 to 2, --seed-list 7 that seed"),
    "--num-envs": ("--preset", "write --set mappo.num_envs=64"),
    "--wandb": ("--track", "write --track wandb; it stays offline unless WANDB_MODE=online"),
}
"""Options of other programs -> an option of commands that have something like it, and what is written there."""
EXIT_MACHINE, EXIT_USER, EXIT_INTERRUPTED = 1, 2, 130


class LazyGroup(TyperGroup):
    """A command group over `COMMANDS` that imports a command's module only when the command is asked for."""

    def list_commands(self, ctx: typer.Context) -> list[str]:  # type: ignore[override] # same class, public name
        return list(COMMANDS)

    def get_command(self, ctx: typer.Context, cmd_name: str) -> Any:  # type: ignore[override]
        return build_command(cmd_name, COMMANDS[cmd_name]) if cmd_name in COMMANDS else None

    def resolve_command(self, ctx: typer.Context, args: list[str]) -> Any:  # type: ignore[override]
        """Find the command that the first argument names, or say which one is like it."""
        name = args[0]
        if name not in COMMANDS and not name.startswith("-"):
            hint = formatting.did_you_mean(name, COMMANDS) or "; 'esp --help' lists the commands"
            raise UserError(f"there is no command '{name}'{hint}")
        return super().resolve_command(ctx, args)

    def main(self, args: Sequence[str] | None = None, prog_name: str | None = None, **extra: Any) -> Any:  # type: ignore[override]
        """Run a command line; every failure that has a sentence becomes that sentence and its exit code."""
        extra["standalone_mode"] = False  # usage errors then come here instead of being printed in a box
        try:
            extra["obj"] = words = [*(sys.argv[1:] if args is None else args)]
            _refuse_empty(words)
            _refuse_deleted_folder()
            code = super().main(args, prog_name or self.name, **extra)
        except (Exception, SystemExit) as failure:  # of the user's code: sys.exit is no end of a command
            code = report(failure)
            if code is None or os.environ.get("ESP_TRACEBACK"):
                raise
        raise SystemExit(code if isinstance(code, int) else 0)

    def invoke(self, ctx: typer.Context) -> Any:  # type: ignore[override]
        """Run the chosen command; an interrupt ends it with a short sentence."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            console.note("interrupted")
            raise typer.Exit(EXIT_INTERRUPTED) from None


def _refuse_empty(words: Sequence[str]) -> None:
    """Refuse an argument without text, as a variable of the shell that is not set leaves one."""
    for place, word in enumerate(words):
        if not word or re.fullmatch(r"--[a-z-]+=", word):
            where = f"'{word}'" if word else f"argument {place + 1}"
            raise UserError(f"{where} is empty; write its value, or leave it out")


def _refuse_deleted_folder() -> None:
    """Refuse to work in a folder that was deleted; libraries end the process where they meet one."""
    try:
        os.getcwd()  # noqa: PTH109 - no Path is wanted
    except FileNotFoundError:
        raise UserError("the working directory was deleted; change to another one (cd)") from None


def build_command(name: str, target: str) -> Any:
    """Import "module:function" and make it a typer command, with the module's `EPILOG` below its help."""
    module_name, function_name = target.split(":")
    module = import_module(module_name)
    single = typer.Typer(add_completion=False, **_LOOKS)
    single.command(name, epilog=getattr(module, "EPILOG", None))(getattr(module, function_name))
    command = typer.main.get_command(single)
    command.name = name
    return arrange(command)


def report(failure: Exception | SystemExit) -> int | None:
    """Print the sentence that a failure deserves and return its exit code; None where it is a bug without one."""
    if isinstance(failure, typer.TyperException):
        message, context = formatting.own_words(failure.format_message()), getattr(failure, "ctx", None)
        if message:  # empty where no argument was given at all: typer has shown the help already
            known = {name for option in context.command.params for name in option.opts} if context else {}
            needed, hint = _OTHER_NAMES.get(getattr(failure, "option_name", ""), ("", ""))
            message = f"{message.split(' (')[0]}; {hint}" if needed in known else message
            console.error(f"{message.rstrip('.')} (see '{context.command_path if context else 'esp'} --help')")
        return failure.exit_code
    if isinstance(failure, typer.Abort):
        console.note("aborted")
        return EXIT_MACHINE
    if isinstance(failure, UserError):
        console.error(str(failure) or type(failure).__name__)
        return EXIT_USER
    if isinstance(failure, OSError) and failure.errno is not None:
        console.error(formatting.sentence(failure))
        return EXIT_USER if formatting.is_correctable(failure) else EXIT_MACHINE
    if isinstance(failure, MemoryError) or (isinstance(failure, RuntimeError) and _LACK_OF_MEMORY.search(str(failure))):
        console.error("this needs more memory than there is; choose fewer agents, worlds, episodes or seeds")
        return EXIT_MACHINE
    if (place := raised_in(failure)) is None:
        return None
    console.error(f"your code raises in {place}: {last_line(failure)}; ESP_TRACEBACK=1 shows the traceback")
    return EXIT_USER


app = typer.Typer(name="esp", cls=LazyGroup, no_args_is_help=True, **_LOOKS)


def _print_version(wanted: bool) -> None:
    if wanted:
        console.say(f"esp {__version__}")
        raise typer.Exit


_VERSION = Option("--version", help="Print the version and leave.", callback=_print_version, is_eager=True)


@app.callback()
def root(version: Annotated[bool, _VERSION] = False) -> None:
    """Train, evaluate and render multi-agent policies with the symmetry prior of ESP.

    Start with: esp demo, or esp train --preset fast --steps 100k; each takes half a minute.
    """


def main() -> None:
    """Run the application on the command line of this process."""
    console.fit_encoding()
    machine.prepare()
    app()
