"""`esp tasks`: the tasks with their symmetries, and their cards."""

import json
import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from esp_cli.commands.tasks import CARDS
from esp_envs.registry import TASKS, make, task_names
from tests.cli.running import esp, refused

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def no_task_of_another_test(monkeypatch: pytest.MonkeyPatch) -> None:
    """Show the built-in tasks alone: other tests register tasks with long names."""
    monkeypatch.setattr("esp_envs.registry.TASKS._registered", {})


def test_the_list_names_every_task_with_the_symmetries_that_it_carries() -> None:
    told = esp("tasks")
    for name in filter(TASKS.ships, TASKS):
        (row,) = (line for line in told.stdout.splitlines() if line.startswith(f"│ {name} "))
        cells = [cell.strip() for cell in row.strip("│").split("│")]
        spec = make(name, 1, [0]).spec
        assert cells[1:4] == [str(spec.version), str(spec.num_agents), str(spec.horizon)]
        assert cells[4] == "c2, d2, c4, d4, agents"
        assert cells[5] == spec.convention
    assert "esp tasks NAME" in told.stderr


def test_the_list_as_json(tmp_path: Path) -> None:
    found = json.loads(esp("tasks", "--json", "-").stdout)
    assert [task["task"] for task in found] == list(task_names())
    file = tmp_path / "tasks.json"
    assert "navigation" in esp("tasks", "--json", file).stdout
    assert json.loads(file.read_text()) == found


def test_a_card_as_json() -> None:
    card = json.loads(esp("tasks", "navigation", "--json", "-").stdout)
    assert set(card) == {
        "task", "version", "convention", "agents", "horizon", "observation", "actions", "symmetries", "heuristics",
        "settings",
    }  # fmt: skip
    assert card["observation"][0] == {"index": "0..1", "field": "velocity", "kind": "vector x 1", "unit": "length/s"}
    assert card["actions"] == ["0 no-op (0, 0)", "1 left (-1, 0)", "2 right (1, 0)", "3 down (0, -1)", "4 up (0, 1)"]
    assert card["heuristics"] == ["nearest", "cover", "blind"]
    assert card["settings"]["num_agents"]["default"] == 3
    assert all(setting["description"] for setting in card["settings"].values())


def test_an_unknown_task_is_told_in_one_sentence() -> None:
    sentence = refused("tasks", "chess")
    assert sentence.startswith(f"unknown task 'chess'; the tasks are {', '.join(task_names())}")


def test_the_cards_on_file_are_those_of_the_tasks() -> None:
    maker = runpy.run_path(str(ROOT / "docs" / "make_task_cards.py"))
    assert CARDS.read_text(encoding="utf-8") == maker["text"](), "run python docs/make_task_cards.py"
    assert set(maker["NAMES"]) == set(task_names())


COMPLETION = {"_ESP_COMPLETE": "complete_bash", "COMP_WORDS": "esp train --task na", "COMP_CWORD": "3"}


@pytest.mark.parametrize(
    ("words", "imported"),
    [
        (["tasks"], set()),
        (["tasks", "formation", "--json", "-"], set()),
        (["policies"], set()),
        (["--help"], set()),
        (["train", "--help"], set()),
        ([], set()),  # what a shell asks for at Tab
        (["tasks", "nonsense"], {"torch"}),
    ],
)
def test_lists_help_and_completion_import_no_heavy_library(words: list[str], imported: set[str]) -> None:
    code = f"import sys; sys.argv = ['esp', *{words}]\nfrom esp_cli.app import main\ntry: main()\n"
    heavy = "{'torch', 'numpy', 'mujoco', 'pymunk', 'matplotlib', 'jinja2'}"
    code += f"finally: print(*{heavy} & set(sys.modules), file=sys.stderr)"
    environment = os.environ | (COMPLETION if not words else {})
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert set(done.stderr.splitlines()[-1].split()) >= imported
    assert imported or not done.stderr.splitlines()[-1]
