"""The example script of the documentation runs, and its policy gets somewhere."""

import re
import runpy
from pathlib import Path

import pytest

from esp_cli.policies.bundled import find

SCRIPT = Path(__file__).parents[2] / "docs" / "load_policy.py"


def test_the_example_script_runs(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(SCRIPT))
    shown = capsys.readouterr().out
    assert find("formation").file in shown
    distances = [float(x) for x in re.findall(r"s: ([\d.]+) m to the goal", shown)]
    assert len(distances) == 4
    assert distances[0] == pytest.approx(2.3, abs=0.3), "from edge to edge of an arena of 2 m, along sides or diagonals"
    assert distances[-1] < distances[0] - 1.0
