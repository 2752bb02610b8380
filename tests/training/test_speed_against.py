"""The script that sets this working tree against an older commit measures what it says."""

import dataclasses
from pathlib import Path

import pytest

from tests.benchmarks.against import CASES, NO_EVALUATION, Training, measure, python, steps_per_second, use
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


def test_code_from_elsewhere_is_not_taken_for_that_of_the_tree(tmp_path: Path) -> None:
    (tmp_path / "esp_cli").mkdir()
    (tmp_path / "esp_cli" / "__init__.py").touch()
    with pytest.raises(RuntimeError, match="instead of the code in"):
        use(tmp_path)
