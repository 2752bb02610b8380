"""What `esp tasks` says of built-in tasks without importing them is what they say themselves."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from esp_cli.commands.tasks import CARDS
from esp_envs.registry import TASKS

ROOT = Path(__file__).parents[2]


def test_the_cards_on_file_are_those_of_the_tasks():
    maker = runpy.run_path(str(ROOT / "docs" / "make_task_cards.py"))
    assert CARDS.read_text(encoding="utf-8") == maker["text"](), "run python docs/make_task_cards.py"
    assert set(maker["BUILT_IN"]) == set(TASKS._built_in)


@pytest.mark.parametrize("line", [["tasks"], ["tasks", "formation", "--json", "-"], ["policies"], ["train", "--help"]])
def test_lists_and_help_import_no_torch(line):
    code = f"import sys; sys.argv = ['esp', *{line}]\nfrom esp_cli.app import main\ntry: main()\n"
    code += "finally: print('torch' in sys.modules, 'numpy' in sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout
    assert done.stderr.splitlines()[-1] == "False False"


def test_a_task_that_is_not_built_in_does_import_torch():
    code = "import sys; sys.argv = ['esp', 'tasks', 'nonsense']\nfrom esp_cli.app import main\ntry: main()\n"
    code += "finally: print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.splitlines()[-1] == "True"
    assert "unknown task 'nonsense'" in done.stderr
