"""What a person sees at 80 columns: tables that cut no name, and a progress line that keeps what matters."""

from __future__ import annotations

import re

import pytest
from rich.console import Console
from rich.table import Table

from esp_cli import console
from esp_cli.console.progress import progress_line
from esp_cli.console.tables import lay_out
from tests.cli.running import esp

COLUMNS = ("policy", "steps>", "95 % interval>", "what it does")


def shown(rows: list[tuple[str, ...]], width: int, capsys: pytest.CaptureFixture[str]) -> list[str]:
    laid = lay_out(COLUMNS, rows, width)
    for part in laid if isinstance(laid, list) else [laid]:
        Console(width=width, highlight=False).print(part)
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
    assert isinstance(lay_out(COLUMNS, ROWS, 200), Table)
    assert isinstance(lay_out(COLUMNS, ROWS, 44), list)


@pytest.mark.parametrize("description", ["formation", "a-task-with-a-rather-long-name"])
def test_the_progress_line_keeps_step_rate_time_and_return_at_80_columns(description: str) -> None:
    status = ["12.8k/1.25M  9.51k steps/s  12 h 03 min left", "greedy -131.4", "return -140.2", "entropy 1.204"]
    line = progress_line(description, 0.25, status, 80)
    assert len(line) <= 80
    assert "12.8k/1.25M  9.51k steps/s  12 h 03 min left  greedy -131.4" in line
    wide = progress_line(description, 0.25, status, 140)
    assert all(item in wide for item in (description, *status))
    assert wide.count("━") == pytest.approx((wide.count("━") + wide.count("╌")) / 4, abs=1)


def at_80(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> list[str]:
    """Return what a command prints on a terminal of 80 columns."""
    terminal = Console(width=80, height=10_000, force_terminal=True, color_system=None, highlight=False)
    monkeypatch.setattr(console, "out", terminal)
    return esp(*arguments).stdout.splitlines()
