"""What is left of a study: only what is not finished is measured, and sums are those of the runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from esp_cli.studies import forecast as module
from esp_cli.studies import probe as probing
from esp_cli.studies.forecast import forecast_study as forecast
from esp_cli.studies.probe import Cost
from esp_cli.studies.study import StudyFolder
from tests.studies.small_studies import small_study, write_run


@pytest.fixture
def probed(monkeypatch) -> list[str]:
    """Let every probe say the same, and return the algorithms of the runs that were probed."""
    seen: list[str] = []

    def probe(config, episodes):
        seen.append(config.prior.kind)
        return Cost(training_s=100.0, evaluation_s=4.0, disk_bytes=50, peak_bytes=70)

    monkeypatch.setattr(probing, "probe", probe)
    return seen


def test_two_new_runs_side_by_side_or_one_after_the_other(tmp_path: Path, probed: list[str]) -> None:
    folder, told = StudyFolder(tmp_path / "s", small_study()), []
    both = forecast(folder, [], 2, told.append)
    assert (both.seconds, both.core_seconds, both.disk_bytes, both.disk_peak_bytes) == (104.0, 208.0, 100, 140)
    one = forecast(folder, [], 1, told.append)
    assert (one.seconds, one.core_seconds, one.disk_bytes, one.disk_peak_bytes) == (208.0, 208.0, 100, 120)
    assert told == [1, 2, 1, 2]
    assert probed == ["none", "esp"] * 2
    assert not folder.path.exists()


def test_a_run_that_has_begun_takes_what_is_left_of_its_training_and_its_evaluation() -> None:
    cell = small_study().cells[0]
    cost = Cost(training_s=100.0, evaluation_s=4.0, disk_bytes=50, peak_bytes=70)
    found = module._left(cell, cell.config.steps // 4, cost, again=False)
    assert found.seconds_left == 75.0 + 4.0


def test_what_costs_the_same_is_measured_once_and_what_trains_the_same_is_run_once(tmp_path, probed) -> None:
    """Three runs of each method: the gate, which is ESP where nothing is broken, has another gradient elsewhere."""
    study = small_study(
        "ablate-breaking", tasks=("navigation",), variants=("plain", "ESP", "gate"), breakings=("wind",)
    )
    found = forecast(StudyFolder(tmp_path / "s", study), [], 1, lambda done: None)
    assert probed == ["none", "esp", "esp"]
    assert [run.name for run in found.runs if run.status == "finished"] == ["navigation-unbroken-mappo-200-gate"]
    assert found.core_seconds == 8 * 104.0
    assert [run.seconds_left for run in found.runs].count(104.0) == 8


def test_a_finished_run_is_not_measured_and_takes_the_place_that_it_takes(tmp_path: Path, probed: list[str]) -> None:
    folder = StudyFolder.create(tmp_path / "s", small_study())
    plain = folder.study.cells[0]
    write_run(folder, plain, [[-1.0] * 3], [-1.0] * 3)
    size = sum(file.stat().st_size for file in folder.run_path(plain).iterdir() if file.is_file())
    found = forecast(folder, [], 2, lambda done: None)
    assert [run.status for run in found.runs] == ["finished", "waiting"]
    assert (found.seconds, found.core_seconds) == (104.0, 104.0)
    assert (found.disk_bytes, found.disk_peak_bytes) == (size + 50, size + 70)
    # a study that takes it over sees the same
    other = StudyFolder(tmp_path / "t", small_study())
    reused = forecast(other, [folder], 2, lambda done: None)
    assert (reused.seconds, reused.disk_bytes) == (104.0, size + 50)
    assert probed == ["esp", "esp"]
