"""The script that sets this working tree against an older commit measures what it says."""

from pathlib import Path

import pytest

from tests.benchmarks.against import CASES, NO_EVALUATION, TURNS, Training, WholeTraining, python, use
from tests.cli.running import esp
from tests.training.runs import TINY

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("case", [name for name, case in CASES.items() if isinstance(case, (Training, WholeTraining))])
def test_the_options_of_every_case_are_accepted(case: str, tmp_path: Path) -> None:
    training = CASES[case]
    assert isinstance(training, (Training, WholeTraining))
    (tmp_path / "taken").write_text("")
    # a folder that is no run is refused last, when the learner has been built
    told = esp("train", *training.options.split(), *NO_EVALUATION.split(), "--out", tmp_path, code=2)
    assert "is not empty and no run folder" in told.stderr


@pytest.mark.slow
def test_a_case_is_measured_with_the_code_of_a_tree(tmp_path: Path) -> None:
    tiny = " ".join(f"--set {name}={value}" for name, value in TINY.items() if "eval" not in name)
    trees = {"old": ROOT, "new": ROOT}
    rates = Training(tiny, seeds=2, per_iteration=100).compare(trees, 1, ())
    assert len(rates["old"]) == len(rates["new"]) == TURNS
    assert min(rates["old"] + rates["new"]) > 0
    whole = WholeTraining(tiny, steps=300).compare(trees, 1, ())
    assert min(whole["old"] + whole["new"]) > 0
    with pytest.raises(RuntimeError, match="No such option"):
        Training("--no-such", seeds=1, per_iteration=100).compare(trees, 1, ())
    with pytest.raises(RuntimeError, match="fails in"):
        python(ROOT, tmp_path, "-c", "raise SystemExit(1)")


def test_code_from_elsewhere_is_not_taken_for_that_of_the_tree(tmp_path: Path) -> None:
    (tmp_path / "esp_cli").mkdir()
    (tmp_path / "esp_cli" / "__init__.py").touch()
    with pytest.raises(RuntimeError, match="instead of the code in"):
        use(tmp_path)
