"""The script that measures the seconds until training solves a task measures what it says."""

import dataclasses
import math
from pathlib import Path

import pytest

from tests.benchmarks.seconds_to_solve import CASES, Case, reached, run
from tests.cli.running import esp
from tests.training.runs import TINY

ROOT = Path(__file__).parents[2]


def test_a_run_is_solved_by_the_mean_of_an_evaluation_over_all_seeds() -> None:
    rows = [
        '{"step":0,"eval/return_greedy":[-120,-130]}',
        '{"step":10,"train/return":[0,0]}',
        '{"step":20,"eval/return_greedy":[-120,-90]}',
        '{"step":30,"eval/return_greedy":[-90,-90]}',
    ]
    assert reached(rows, -105) == 20
    assert reached(rows, -104.9) == 30
    assert reached(rows, -89) is None
    assert reached(['{"step":0,"eval/return_greedy":[-1,null]}'], -100) is None, "a seed has stopped"


def test_every_run_has_seeds_of_its_own_and_the_callers_options_have_the_last_word() -> None:
    case = Case("--task navigation", seeds=2, threshold=0.0)
    assert case.words(0)[:4] == ["--task", "navigation", "--seed-list", "0,1"]
    assert case.words(3)[3] == "6,7"
    assert "evaluation.episodes=160" in case.words(0), "320 over both seeds"
    assert case.words(0, ["--preset", "paper"])[-2:] == ["--preset", "paper"]


@pytest.mark.parametrize("name", CASES)
def test_the_options_of_every_case_are_accepted(name: str, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    # a folder that is no run is refused last, when the learner has been built
    told = esp("train", *CASES[name].words(1, ["--preset", "default"]), "--out", tmp_path, code=2)
    assert "is not empty and no run folder" in told.stderr


@pytest.mark.slow
def test_seconds_count_to_the_first_evaluation_that_reaches_the_threshold() -> None:
    tiny = " ".join(f"--set {name}={value}" for name, value in TINY.items() if "eval" not in name)
    easy = Case(tiny, seeds=1, threshold=-1000.0, every=100, episodes=4, steps=300)
    solved = run(easy, easy.words(0), ROOT)
    assert solved.steps == 0
    assert 0 < solved.seconds < 100
    hard = dataclasses.replace(easy, threshold=0.0)
    assert run(hard, hard.words(0), ROOT).seconds == math.inf
    with pytest.raises(RuntimeError, match="has no preset 'best'"):
        run(easy, easy.words(0, ["--preset", "best"]), ROOT)
