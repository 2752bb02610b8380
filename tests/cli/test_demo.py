"""`esp demo`: two runs side by side, their curves, a film of both, and what the numbers say."""

from pathlib import Path

import pytest
from rich.console import Console

from esp_cli.commands.demo import CURVES, FILM, draw_curves
from tests.cli.running import TINY_OPTIONS, esp, refused

DEMO = ("demo", "--steps", 100, "--seeds", 3, *TINY_OPTIONS)


@pytest.mark.usefixtures("forked_jobs")
def test_both_learners_are_trained_drawn_and_compared_and_a_second_call_trains_nothing(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    told = esp(*DEMO, "--out", out)
    assert {path.name for path in (out / "runs").iterdir()} == {
        "predator-prey-100-mappo-plain",
        "predator-prey-100-mappo-esp",
    }
    assert (out / CURVES).read_bytes().startswith(b"\x89PNG")
    assert (out / FILM).read_bytes().startswith(b"GIF8")
    first, verdict, steps = told.stdout.splitlines()
    assert first.startswith("predator-prey, 100: MAPPO with symmetry has ")
    assert " and MAPPO has " in first
    assert "greedy return, 3 seeds; normalised" in first
    assert verdict.startswith("MAPPO with symmetry is ")
    assert steps.startswith("The mean over seeds first has ")
    assert "film of the same 3 episodes, return MAPPO " in told.stderr
    again = esp(*DEMO, "--out", out)
    assert "2 runs, 2 of them finished" in again.stderr
    assert "training" not in again.stderr
    assert again.stdout == told.stdout
    assert "holds another study" in refused(*DEMO, "--out", out, "--seeds", 2)
    longer = esp(*DEMO, "--out", out, "--steps", 200)  # beside the runs that the folder has
    assert "film of the same 3 episodes, return MAPPO " in longer.stderr
    assert [line.split(":")[0] for line in longer.stdout.splitlines()[:1]] == ["predator-prey, 200"]
    assert len(longer.stdout.splitlines()) == 3


def test_curves_are_drawn_as_wide_as_the_terminal_and_as_far_as_they_are() -> None:
    drawn = draw_curves({"a": [(0, 1.0), (50, 2.0)], "b": [(0, 1.0)]}, 100, 60)
    rows = drawn.plain.splitlines()
    assert max(map(len, rows)) <= 60
    assert rows[0].startswith("       2 │")
    assert rows[11].startswith("       1 │●")
    assert max(row.rfind("○") for row in rows[:12]) == 10 + 49 // 2
    assert rows[-1].split() == ["○", "a", "2.0", "●", "b", "1.0"]
    assert "○" not in draw_curves({"a": [], "b": []}, 100, 60).plain.splitlines()[5]
    Console(width=20).print(drawn)


def test_a_stopped_seed_leaves_a_gap_in_a_curve() -> None:
    ends = (100, float("nan"))
    rows = draw_curves({"a": [(0, 1.0), (50, 2.0), ends], "b": [(0, 3.0), ends]}, 100, 60).plain.splitlines()
    assert rows[0].startswith("       3 │●")
    assert max(row.rfind("○") for row in rows[:12]) == 10 + 49 // 2
    assert "○" not in "".join(draw_curves({"a": [ends], "b": [ends]}, 100, 60).plain.splitlines()[:12])
