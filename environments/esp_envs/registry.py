"""The tasks by name: built in, installed by other packages, or named by module and class.

A built-in task is one module and one line here. A package installs tasks as entry points of the group `esp.tasks`. A
task `module:Class` runs only after the caller has passed it to `register`: its name in a file never imports anything.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module, invalidate_caches
from importlib.metadata import EntryPoint, entry_points
from inspect import isabstract
from pathlib import Path

import torch

from esp_envs.base import Environment, generators_for

GROUP = "esp.tasks"
"""The entry point group in which other packages install tasks."""
_BUILT_IN = {
    "navigation": "esp_envs.mpe.navigation:Navigation",
    "predator-prey": "esp_envs.mpe.predator_prey:PredatorPrey",
    "formation": "esp_envs.epuck.formation:Formation",
    "wildlife": "esp_envs.wildlife.wildlife:Wildlife",
}
_REGISTERED: dict[str, type[Environment]] = {}
_MODULE_AND_CLASS = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")


def task_names() -> tuple[str, ...]:
    """Return the names of the built-in and the installed tasks, and of those that the caller registered."""
    return tuple(dict.fromkeys((*_BUILT_IN, *_installed(), *_REGISTERED)))


def register(task: str | type[Environment]) -> str:
    """Admit a task that is not installed; return the name that the other functions then know it by.

    The working directory is importable while the module is imported, as it is for a script. Call this for a task that
    the user named, never for a name that was read from a file.

    Args:
        task: "module:Class", or the class itself. Any other name is returned as it is.

    Raises:
        ValueError: the module cannot be imported, or holds no such task.
    """
    if isinstance(task, str):
        if ":" not in task:
            return task
        name, cls = task, _import(task)
    else:
        name, cls = f"{task.__module__}:{task.__qualname__}", _checked(task, task.__qualname__)
    _REGISTERED[name] = cls
    return name


def task_class(name: str) -> type[Environment]:
    """Return the environment class of a task, imported if it is built in or installed.

    Raises:
        ValueError: no such task, or one that is neither installed nor registered.
    """
    if name in _REGISTERED:
        return _REGISTERED[name]
    if name in _BUILT_IN:
        module, attribute = _BUILT_IN[name].split(":")
        found: type[Environment] = getattr(import_module(module), attribute)
        return found
    if entry := _installed().get(name):
        try:
            return _checked(entry.load(), name)
        except Exception as error:
            raise ValueError(f"the installed task '{name}' cannot be imported: {_last_line(error)}") from error
    if _MODULE_AND_CLASS.fullmatch(name):
        raise ValueError(f"the task '{name}' is not installed; add --task {name} to let esp import and run it")
    known = ", ".join(task_names())
    raise ValueError(f"unknown task '{name[:80]}'; the tasks are {known}; name your own as module:Class")


def make(
    name: str,
    num_envs: int,
    seeds: Sequence[int],
    settings: Mapping[str, object] | None = None,
    device: torch.device | str = "cpu",
) -> Environment:
    """Make E worlds for each of the S seeds.

    Args:
        name: of a built-in, installed or registered task.
        num_envs: E, worlds per seed.
        seeds: one integer per seed.
        settings: task settings that differ from the defaults.
        device: where the worlds live.

    Raises:
        ValueError: unknown task, unknown setting, or a value out of range.
    """
    cls = task_class(name)
    return cls(cls.Settings(**(settings or {})), num_envs, generators_for(seeds, device))


def _installed() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUP)}


def _import(name: str) -> type[Environment]:
    if not _MODULE_AND_CLASS.fullmatch(name):
        raise ValueError(f"'{name[:80]}' names no task; write module:Class, as in rendezvous:Rendezvous")
    module_name, class_name = name.split(":")
    here = str(Path.cwd())
    # First while the module is found, as for a script; last afterwards, so that no other import meets the user's files.
    sys.path.insert(0, here)
    invalidate_caches()  # the user may have written the file a moment ago
    try:
        module = import_module(module_name)
    except Exception as error:
        raise ValueError(f"cannot import the module '{module_name}' of the task: {_last_line(error)}") from error
    finally:
        sys.path.remove(here)
        if here not in sys.path:
            sys.path.append(here)
    if not hasattr(module, class_name):
        raise ValueError(f"the module '{module_name}' has no class '{class_name}'; check the name after the colon")
    return _checked(getattr(module, class_name), name)


def _checked(cls: object, name: str) -> type[Environment]:
    if not (isinstance(cls, type) and issubclass(cls, Environment)):
        raise ValueError(f"'{name}' is not a task; a task is a subclass of esp_envs.Environment")
    if isabstract(cls):
        missing = ", ".join(sorted(cls.__abstractmethods__))
        raise ValueError(f"the task '{name}' lacks {missing}; implement what its base class leaves open")
    return cls


def _last_line(error: Exception) -> str:
    """Return the last line of a traceback."""
    text = str(error).strip()
    return f"{type(error).__name__}: {text.splitlines()[-1]}" if text else type(error).__name__
