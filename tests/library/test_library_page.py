"""The examples of docs/library.md give what the page says, and the single-file MAPPO runs with and without prior."""

import re
import runpy
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
SCRIPT = DOCS / "plain_mappo.py"
MARK = "  # ESP"


def test_the_script_is_as_short_as_the_page_says() -> None:
    lines = SCRIPT.read_text(encoding="utf-8").splitlines()
    claimed = re.search(r"one file of (\d+) lines", (DOCS / "library.md").read_text(encoding="utf-8"))
    assert claimed is not None
    assert len(lines) == int(claimed[1]) < 250
    assert sum(line.endswith(MARK) for line in lines) == 4


@pytest.mark.parametrize("prior", [True, False])
def test_the_single_file_learns_with_the_four_lines_and_without(prior: bool, tmp_path: Path) -> None:
    lines = SCRIPT.read_text(encoding="utf-8").splitlines()
    kept = [line for line in lines if prior or not line.endswith(MARK)]
    script = tmp_path / "script.py"
    script.write_text("\n".join(kept) + "\n", encoding="utf-8")
    loaded = runpy.run_path(str(script), run_name="plain_mappo")
    returns = loaded["main"](["--steps", "16000"])
    assert len(returns) == 20
    assert returns[0] < -190, "a fresh policy is near the random one's -218"
    assert sum(returns[-5:]) / 5 > returns[0] + 10
    assert loaded["main"](["--steps", "1600"]) == returns[:2], "the same seed gives the same run"


def test_the_script_says_what_its_settings_are(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["plain_mappo.py", "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(SCRIPT), run_name="__main__")
    assert ended.value.code == 0
    assert "--learning-rate" in capsys.readouterr().out
