"""What this machine has: classes by name, optional packages, cores.

Classes are built in, installed by other packages, or named by the caller as module and class.

A package installs classes as entry points. A class `module:Class` is known only after the caller has passed it to
`Registry.register`: its name in a file never imports anything.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from importlib import import_module, invalidate_caches
from inspect import isabstract
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from esp_envs.errors import UserError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

T = TypeVar("T")
FURTHER: dict[str, dict[str, str]] = {}
"""Classes "module:Class" by name, of each group of entry points, that a package adds when it is imported."""
_FOREIGN: set[str] = set()  # top-level modules of the classes that are registered or installed

_ELSEWHERE = {"simple_spread": "navigation", "simple_tag": "predator-prey"}  # names of tasks in MPE
_MODULE_AND_NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")


class Registry(Mapping[str, type[T]]):
    """The classes of one kind by name. A class that is built in or installed is imported when it is looked up.

    `noun` is what messages call one of them, as "task", whose entry points are in the group "esp.tasks"; `base` is the
    "module:Class" of which every one is, and a command takes a name, such as `example`, by `option`.
    """

    def __init__(self, noun: str, built_in: Mapping[str, str], base: str, option: str, example: str) -> None:
        self.noun, self.option, self.example = noun, option, example
        self.group = f"esp.{noun}s"
        self._built_in, self._base = dict(built_in), base
        self._registered: dict[str, type[T]] = {}

    def register(self, given: str | type[T]) -> str:
        """Admit a class that is not installed, or "module:Class"; return the name by which it is then known.

        The working directory is importable while the module is imported, as it is for a script. Call this for a class
        that the user named, never for a name that was read from a file. Any other name is returned as it is.
        """
        if isinstance(given, str):
            if ":" not in given:
                return given
            name, cls = given, self._checked(import_named(given, self.noun, "Class", self.example), given)
        else:
            name, cls = f"{given.__module__}:{given.__qualname__}", self._checked(given, given.__qualname__)
        self._registered[name] = cls
        _FOREIGN.add(cls.__module__.partition(".")[0])
        return name

    def __getitem__(self, name: str) -> type[T]:
        """Return a class by its name, imported if it is built in or installed."""
        if name in self._registered:
            return self._registered[name]
        if name in self._built_in:
            return self._checked(load(self._built_in[name]), name)
        if entry := self._installed().get(name):
            _FOREIGN.add(entry.module.partition(".")[0])
            try:
                return self._checked(entry.load(), name)
            except (Exception, SystemExit) as error:
                raise UserError(f"the installed {self.noun} '{name}' cannot be imported: {last_line(error)}") from error
        if _MODULE_AND_NAME.fullmatch(name):
            raise UserError(
                f"the {self.noun} '{name}' is not installed; add {self.option} {name} to let esp import and run it"
            )
        other = _ELSEWHERE.get(name.lower())
        near = [other] if other in self else get_close_matches(name.lower(), self, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"the {self.noun}s are {', '.join(self)}"
        raise UserError(f"unknown {self.noun} '{name[:80]}'; {hint}; name your own as module:Class")

    def __contains__(self, name: object) -> bool:
        return name in list(self)

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys((*self._built_in, *self._installed(), *self._registered)))

    def ships(self, name: str) -> bool:
        """Return whether the package itself brings a class of this name."""
        return name in self._built_in

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def _installed(self) -> dict[str, EntryPoint]:
        return {entry.name: entry for entry in entries(self.group)}

    def _checked(self, cls: object, name: str) -> type[T]:
        base: type[T] = load(self._base)
        if not (isinstance(cls, type) and issubclass(cls, base)):
            noun = f"{'an' if self.noun[0] in 'aeiou' else 'a'} {self.noun}"
            raise UserError(f"'{name}' is not {noun}; {noun} is a subclass of {self._base.replace(':', '.')}")
        if isabstract(cls):
            missing = ", ".join(sorted(vars(cls)["__abstractmethods__"]))
            raise UserError(f"the {self.noun} '{name}' lacks {missing}; implement what its base class leaves open")
        return cls


def import_named(name: str, noun: str, kind: str, example: str) -> Any:
    """Import what a user named as "module:Class" or "module:function" for a `noun`, also from the working directory."""
    if not _MODULE_AND_NAME.fullmatch(name):
        raise UserError(f"'{name[:80]}' names no {noun}; write module:{kind}, as in {example}")
    module_name, attribute = name.split(":")
    here = str(Path.cwd())
    # first while the module is found, as for a script; last afterwards: no other import meets the user's files
    sys.path.insert(0, here)
    invalidate_caches()  # the user may have written the file a moment ago
    try:
        module = import_module(module_name)
    except (Exception, SystemExit) as error:
        missing = isinstance(error, ModuleNotFoundError) and f"{module_name}.".startswith(f"{error.name}.")
        place = f"; it is looked for in {here} and among installed packages, without .py" if missing else ""
        raise UserError(f"cannot import the module '{module_name}' of the {noun}: {last_line(error)}{place}") from error
    finally:
        sys.path.remove(here)
        if here not in sys.path:
            sys.path.append(here)
    if not hasattr(module, attribute):
        raise UserError(
            f"the module '{module_name}' has no {kind.lower()} '{attribute}'; check the name after the colon"
        )
    return getattr(module, attribute)


def import_function(name: str) -> Any:
    """Import what a user named as "module:function"."""
    if callable(found := import_named(name, "function", "function", "my_robot:mirror")):
        return found
    raise UserError(f"'{name}' is no function; check the name after the colon")


def entries(group: str) -> list[EntryPoint]:
    """Return what packages install, and those that are `FURTHER`; none is imported."""
    from importlib.metadata import EntryPoint, entry_points  # noqa: PLC0415 - which `esp --help` can do without

    added = FURTHER.get(group, {}).items()
    return [*(EntryPoint(name, target, group) for name, target in added), *entry_points(group=group)]


def raised_in(failure: BaseException) -> str | None:
    """Return where the code of a user raised: "'step' (mine.py, line 7)"; None where esp itself or a library did."""
    place, trace = None, failure.__traceback__
    while trace is not None:
        frame = trace.tb_frame
        if str(frame.f_globals.get("__name__")).partition(".")[0] in _FOREIGN - {"esp_cli", "esp_envs"}:
            code = frame.f_code
            place = f"'{code.co_name}' ({Path(code.co_filename).name}, line {trace.tb_lineno})"
        trace = trace.tb_next
    return place


def load(target: str) -> Any:
    """Import "module:name" and return what it names."""
    module, attribute = target.split(":")
    return getattr(import_module(module), attribute)


def last_line(error: BaseException) -> str:
    """Return the last line of a traceback."""
    text = str(error).strip()
    return f"{type(error).__name__}: {text.splitlines()[-1]}" if text else type(error).__name__


def install(extra: str) -> str:
    """Return the command that installs what an extra needs, from any index: "pip install 'ray>=2.60'"."""
    from importlib.metadata import requires  # noqa: PLC0415 - as above

    rows = (row.replace('"', "'").split(";") for row in requires("esp-marl") or [])
    needed = [row[0].strip() for row in rows if row[-1].strip() == f"extra == '{extra}'"]
    return " ".join(["pip install", *(f"'{package}'" for package in needed)])


def available_cores() -> int:
    """Return the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
