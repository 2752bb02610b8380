from __future__ import annotations

import math
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

import esp_envs
from esp_envs import Environment, make, register, registry, task_class, task_names


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory of its own, whose modules are forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(registry.TASKS, "_registered", {})
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]


@pytest.mark.parametrize("settings", [{"num_agents": 0}, {"agents": 3}])
def test_settings_that_a_task_does_not_take_are_refused_in_one_sentence(settings: dict[str, int]) -> None:
    with pytest.raises(
        esp_envs.UserError, match=rf"^navigation does not take these settings, {next(iter(settings))}: .+"
    ):
        make("navigation", 1, [0], settings)


def test_a_name_alone_never_imports_a_module(folder: Path) -> None:
    (folder / "trap.py").write_text("from pathlib import Path\nPath('sprung').touch()\n")
    with pytest.raises(ValueError, match="'trap:Trap' is not installed; add --task trap:Trap"):
        task_class("trap:Trap")
    with pytest.raises(ValueError, match="add --task"):
        make("trap:Trap", 1, [0])
    assert not (folder / "sprung").exists()
    with pytest.raises(ValueError, match="has no class 'Trap'"):
        register("trap:Trap")
    assert (folder / "sprung").exists(), "the control: a registered module is imported"


def test_a_class_can_be_registered_itself(folder: Path) -> None:
    navigation = task_class("navigation")
    name = register(navigation)
    assert name == "esp_envs.mpe.navigation:Navigation"
    assert task_class(name) is navigation
    assert register("navigation") == "navigation", "an ordinary name needs no registration"
    assert all(hasattr(esp_envs, public) for public in esp_envs.__all__)


@pytest.mark.parametrize(
    ("source", "sentence"),
    [
        ("import no_such_module\n", "cannot import the module 'mine' of the task: ModuleNotFoundError: No module"),
        ("raise SystemExit(3)\n", "cannot import the module 'mine' of the task: SystemExit: 3"),
        ("def f(:\n", "cannot import the module 'mine' of the task: SyntaxError: "),
        ("raise RuntimeError('first\\nlast')\n", "cannot import the module 'mine' of the task: RuntimeError: last"),
        ("Task = 3\n", "'mine:Task' is not a task; a task is a subclass of esp_envs.base.Environment"),
        ("class Task: pass\n", "'mine:Task' is not a task"),
        ("class Other: pass\n", "the module 'mine' has no class 'Task'"),
        ("from esp_envs import BatchedTask\nclass Task(BatchedTask): pass\n", "lacks _advance, _describe, _observe"),
    ],
)
def test_a_module_without_a_task_is_answered_by_a_sentence(folder: Path, source: str, sentence: str) -> None:
    (folder / "mine.py").write_text(source)
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the sentence is compared below
        register("mine:Task")
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["os", "a:b:c", "../x:Y", "x:", ":Y", "x y:Z", "navigaton"])
def test_what_names_no_task_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"names no task|unknown task"):
        task_class(register(name))


def test_the_users_modules_do_not_hide_others(folder: Path) -> None:
    (folder / "mine.py").write_text("import csv\n")
    (folder / "this_is_unused.py").write_text("")
    with pytest.raises(ValueError, match="no class"):
        register("mine:Task")
    assert sys.path[0] != str(folder)
    assert sys.path[-1] == str(folder)


def test_an_installed_task_is_known_by_its_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    entries = [
        EntryPoint("theirs", "esp_envs.mpe.navigation:Navigation", "esp.tasks"),
        EntryPoint("broken", "no_such_package:Task", "esp.tasks"),
    ]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: entries if group == "esp.tasks" else [])
    assert {"theirs", "broken", "navigation"} <= set(task_names())
    assert issubclass(task_class("theirs"), Environment)
    with pytest.raises(ValueError, match="the installed task 'broken' cannot be imported: ModuleNotFoundError"):
        task_class("broken")


@pytest.mark.parametrize("period", [0.0, -0.1, math.nan, math.inf])
def test_a_control_period_that_no_clock_has_is_refused(period: float) -> None:
    spec = make("navigation", 1, [0]).spec
    with pytest.raises(ValueError, match=r"task navigation: control_period_s is .*; give seconds above 0"):
        replace(spec, control_period_s=period)
