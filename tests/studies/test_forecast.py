"""What is left of a study: only what is not finished is measured, sums are those of the runs, nothing is written."""

import threading
from pathlib import Path

import pytest
import torch

from esp_cli.studies import forecast as module
from esp_cli.studies.forecast import Cost, forecast_tuned
from esp_cli.studies.forecast import forecast_study as forecast
from esp_cli.studies.search import Trials
from esp_cli.studies.study import StudyFolder
from esp_cli.training.build import build_learner
from esp_envs.errors import UserError
from tests.studies.small_studies import small_study, write_run
from tests.studies.test_tuning import tuning
from tests.training.runs import tiny_config


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(module, "PROBE_SECONDS", 0.0)


@pytest.fixture
def probed(monkeypatch) -> list[str]:
    """Let every probe say the same, and return the algorithms of the runs that were probed."""
    seen: list[str] = []

    def measure(config, episodes):
        seen.append(config.prior.kind)
        return Cost(training_s=100.0, evaluation_s=4.0)

    monkeypatch.setattr(module, "measure", measure)
    return seen


def test_two_new_runs_side_by_side_or_one_after_the_other(tmp_path: Path, probed: list[str]) -> None:
    folder, told = StudyFolder(tmp_path / "s", small_study()), []
    both = forecast(folder, [], 2, told.append)
    assert (both.seconds, both.core_seconds) == (104.0, 208.0)
    one = forecast(folder, [], 1, told.append)
    assert (one.seconds, one.core_seconds) == (208.0, 208.0)
    assert told == [1, 2, 1, 2]
    assert probed == ["none", "esp"] * 2
    assert not folder.path.exists()


def test_a_run_that_has_begun_takes_what_is_left_of_its_training_and_its_evaluation(tmp_path, probed, monkeypatch):
    folder = StudyFolder(tmp_path / "s", small_study())
    monkeypatch.setattr(folder, "progress", lambda cell: (cell.config.steps // 4, 1.0))
    assert [run.seconds for run in forecast(folder, [], 1, lambda done: None).runs] == [75.0 + 4.0] * 2


def test_what_costs_the_same_is_measured_once_and_what_trains_the_same_is_run_once(tmp_path, probed) -> None:
    """Three runs of each method: measured weights are ESP where nothing is broken, and draw otherwise elsewhere."""
    methods = ("plain", "ESP", "measured weights")
    study = small_study("ablate-breaking", tasks=("navigation",), variants=methods, breakings=("wind",))
    found = forecast(StudyFolder(tmp_path / "s", study), [], 1, lambda done: None)
    assert probed == ["none", "esp", "esp"]
    assert {run.name: run.status for run in found.runs if not run.seconds} == {
        "navigation-unbroken-mappo-200-measured-weights": "like navigation-unbroken-mappo-200-esp"
    }
    assert found.core_seconds == 8 * 104.0
    assert [run.seconds for run in found.runs].count(104.0) == 8


def test_a_finished_run_is_not_measured(tmp_path: Path, probed: list[str]) -> None:
    folder = StudyFolder.create(tmp_path / "s", small_study())
    plain = folder.study.cells[0]
    write_run(folder, plain, [[-1.0] * 3], [-1.0] * 3)
    found = forecast(folder, [], 2, lambda done: None)
    assert [run.status for run in found.runs] == ["finished", "new"]
    assert (found.seconds, found.core_seconds) == (104.0, 104.0)
    # a study that takes it over sees the same
    other = StudyFolder(tmp_path / "t", small_study())
    reused = forecast(other, [folder], 2, lambda done: None)
    assert reused.seconds == 104.0
    assert probed == ["esp", "esp"]


def test_the_forecast_of_a_search_by_hand(tmp_path: Path, probed: list[str]) -> None:
    """Each prior: 6 trials of 100 s, and then a run of 104 s."""
    asked, path = tuning(budget=6), tmp_path / "s"
    trials, _ = Trials.planned(path, asked.trials)
    fresh = StudyFolder(path / "fresh", small_study())
    for jobs, seconds in ((1, 12 * 100.0 + 208.0), (2, 600.0 + 104.0), (99, 100.0 + 104.0)):
        judged = forecast(fresh, [], jobs, lambda done: None)
        groups = {": ".join(one): cells for one, cells in asked.trials_of.items()}
        found = forecast_tuned(trials, groups, judged, lambda done: None)
        assert [run.seconds for run in found.runs] == [600.0] * 2 + [104.0] * 2
        assert (found.core_seconds, found.seconds) == (12 * 100.0 + 208.0, seconds)


def test_twice_the_steps_cost_about_twice_the_iterations_and_evaluations(monkeypatch):
    # a clock that ticks once at every look: an iteration and an evaluation cost the same in both
    ticks = iter(range(10**6))
    monkeypatch.setattr(module.time, "process_time", lambda: float(next(ticks)))
    one, two = module.measure(tiny_config(steps=1000), 4), module.measure(tiny_config(steps=2000), 4)
    # 20 and 40 iterations; 11 and 21 evaluations of two episodes twice; eight episodes take a tick, two a quarter
    iteration = (two.training_s - one.training_s - 10 * 2 * 0.25) / 20
    assert one.training_s == pytest.approx(20 * iteration + 11 * 2 * 0.25)
    # greedy, drawn, random, and the three heuristics of navigation, four episodes each
    assert one.evaluation_s == two.evaluation_s == 6 * 0.5


@pytest.mark.parametrize(("fixed", "each", "longer"), [(0.1, 0.01, 0.1 + 320 * 0.01), (4.0, 0.5, 8.0 + 312 * 1.0)])
def test_episodes_played_side_by_side_share_their_steps(monkeypatch, fixed, each, longer):
    """Eight episodes take 0.18 s and 32 take 0.42 s; where eight take 8 s, the rest is taken to cost as much each."""
    now = [0.0]
    monkeypatch.setattr(module, "PROBE_SECONDS", 1.0)
    monkeypatch.setattr(module, "play", lambda env, _: now.__setitem__(0, now[0] + fixed + each * env.num_envs))
    monkeypatch.setattr(module, "_clock", lambda config: lambda: now[0])
    config = tiny_config()
    playing = module._playing(config, build_learner(config).policy)
    assert playing(8) == pytest.approx(fixed + 8 * each)
    assert playing(320) == pytest.approx(longer)


def test_a_gpu_that_is_not_here_is_not_measured(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError, match="this machine has no GPU"):
        module.measure(tiny_config().model_copy(update={"device": "cuda"}), 4)


def test_other_work_on_the_machine_costs_a_run_nothing(monkeypatch):
    """The processor time of a process does not pass while it sleeps; a GPU's time does."""
    monkeypatch.setattr(module.time, "process_time", lambda: 7.0)
    own, watch = threading.get_ident(), module.time.monotonic

    def read() -> float:
        return pytest.fail("a watch was read") if threading.get_ident() == own else watch()  # others wait by it

    monkeypatch.setattr(module.time, "monotonic", read)
    assert module.measure(tiny_config(steps=100), 4).training_s == 0.0
    assert module._clock(tiny_config().model_copy(update={"device": "cuda"})) is module.time.monotonic


def test_threads_are_as_before():
    before = torch.get_num_threads()
    assert module.measure(tiny_config(steps=100), 4).training_s > 0
    assert torch.get_num_threads() == before
