"""The script that sets this working tree against an older commit measures what it says."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from tests.benchmarks.against import (
    CASES,
    NO_EVALUATION,
    Solving,
    Training,
    measure,
    python,
    reaches,
    speedup,
    steps_per_second,
    use,
)
from tests.cli.running import esp
from tests.training.runs import TINY

ROOT = Path(__file__).parents[2]


def test_the_rate_is_the_median_without_the_first_two_and_the_last_iteration() -> None:
    seconds = [9.0, 9.0, 1.0, 2.0, 4.0, 50.0]
    rows = [{"step": 100 * (k + 1), "time/elapsed_s": sum(seconds[: k + 1])} for k in range(len(seconds))]
    assert steps_per_second([{"step": 0}, *rows]) == pytest.approx(50.0)
    with pytest.raises(ValueError, match="the run is too short to measure"):
        steps_per_second(rows[:3])


@pytest.mark.parametrize("case", [name for name, case in CASES.items() if isinstance(case, Training)])
def test_the_options_of_every_case_are_accepted(case: str, tmp_path: Path) -> None:
    training = CASES[case]
    assert isinstance(training, Training)
    (tmp_path / "taken").write_text("")
    # a folder that is no run is refused last, when the learner has been built
    told = esp("train", *training.options.split(), *NO_EVALUATION.split(), "--out", tmp_path, code=2)
    assert "is not empty and no run folder" in told.stderr


@pytest.mark.slow
def test_a_case_is_measured_with_the_code_of_a_tree(tmp_path: Path) -> None:
    tiny = " ".join(f"--set {name}={value}" for name, value in TINY.items() if "eval" not in name)
    training = Training(tiny, seeds=2, steps=300)
    assert measure(training, ROOT) > 0
    assert measure(dataclasses.replace(training, end_to_end=True), ROOT) > 0
    with pytest.raises(RuntimeError, match="fails in"):
        python(ROOT, tmp_path, "-c", "raise SystemExit(1)")


def test_a_run_is_solved_by_the_mean_of_an_evaluation_over_all_seeds(tmp_path: Path) -> None:
    metrics = tmp_path / "metrics.jsonl"
    assert not reaches(metrics, -100)
    metrics.write_text(
        '{"step":0,"eval/return_greedy":[-120,-90]}\n{"step":1,"train/return":[0,0]}\n{"step":2,"eval/re'
    )
    assert reaches(metrics, -105)
    assert not reaches(metrics, -104.9)
    metrics.write_text('{"step":0,"eval/return_greedy":[-1,null]}\n')
    assert not reaches(metrics, -100), "a seed has stopped"


def test_a_case_of_seconds_is_faster_by_old_over_new() -> None:
    solving, training = (next(c for c in CASES.values() if isinstance(c, kind)) for kind in (Solving, Training))
    assert speedup(solving, 30.0, 10.0) == 3.0
    assert speedup(training, 10.0, 30.0) == 3.0


@pytest.mark.slow
def test_seconds_count_to_the_first_evaluation_that_reaches_the_threshold() -> None:
    tiny = " ".join(f"--set {name}={value}" for name, value in TINY.items() if "eval" not in name)
    assert 0 < measure(Solving(tiny, 1, -1000.0, steps=300, every=100), ROOT) < 100
    with pytest.raises(RuntimeError, match="ends without a return of 0"):
        measure(Solving(tiny, 1, 0.0, steps=300, every=100), ROOT)


def test_code_from_elsewhere_is_not_taken_for_that_of_the_tree(tmp_path: Path) -> None:
    (tmp_path / "esp_cli").mkdir()
    (tmp_path / "esp_cli" / "__init__.py").touch()
    with pytest.raises(RuntimeError, match="instead of the code in"):
        use(tmp_path)
