"""The form that marl-eval reads, as its public README describes it."""

from __future__ import annotations

import json

from esp_cli.reporting.collect import collect_study
from esp_cli.reporting.page import marl_eval
from tests.studies.small_studies import small_study, write_study


def written(path, study, ends):
    return marl_eval(collect_study(write_study(path, study, ends)))


def test_environment_task_algorithm_run_step_and_metric(tmp_path):
    study = small_study(tasks=("navigation", "predator-prey"))
    found = written(tmp_path / "s", study, {"MAPPO": [-1.0, -2.0, -3.0], "MAPPO-ESP": [0.0, 1.0, 2.0]})
    assert list(found) == ["mpe_200"]
    assert list(found["mpe_200"]) == ["navigation_200", "predator-prey_200"]
    assert list(found["mpe_200"]["navigation_200"]) == ["MAPPO", "MAPPO-ESP"]
    runs = found["mpe_200"]["navigation_200"]["MAPPO-ESP"]
    assert list(runs) == ["seed_0", "seed_1", "seed_2"]
    assert runs["seed_1"] == {
        "step_1": {"step_count": 0, "return": [-39.0]},
        "step_2": {"step_count": 100, "return": [-19.0]},
        "step_3": {"step_count": 200, "return": [1.0]},
        "absolute_metrics": {"return": [1.0]},
    }
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_runs_without_an_end_and_stopped_seeds_have_no_place_there(tmp_path):
    found = written(tmp_path / "s", small_study(), {"MAPPO": [-1.0, None, -3.0]})
    assert found == {}
