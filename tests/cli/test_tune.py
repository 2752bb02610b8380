"""`esp tune`: costs, mistakes, and one small search from the command to a preset."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("optuna", reason="needs Optuna, of the extra tune")

from esp_cli.studies.study import StudyFolder
from tests.cli.running import TINY_OPTIONS, esp, refused

SPACE = {"mappo.learning_rate": {"low": 1e-4, "high": 1e-2, "log": True}, "prior.consistency_coef": [0.1, 1.0]}


@pytest.fixture
def command(tmp_path: Path) -> list[object]:
    (tmp_path / "space.json").write_text(json.dumps(SPACE))
    return ["tune", "--task", "navigation", *TINY_OPTIONS, "--space", tmp_path / "space.json", "--out", tmp_path / "t"]


def test_a_dry_run_states_the_cost_of_equal_budgets_and_makes_nothing(command: list[object], tmp_path: Path) -> None:
    told = esp(*command, "--prior", "esp,none", "--budget", 5, "--steps", 300, "--seeds", 2, "--jobs", 3, "--dry-run")
    assert "on one core at most" in told.stdout
    assert "3 runs side by side" in told.stdout
    assert not (tmp_path / "t").exists()
    planned = json.loads(esp(*command, "--prior", "esp,none", "--steps", 300, "--dry-run", "--json", "-").stdout)
    assert [(one["prior"], one["trials"]) for one in planned["searches"]] == [("esp", 30), ("none", 30)]
    assert 0 < planned["likely_s"] < planned["at_most_s"]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--task", "formation"], "esp tune takes one --task, not 2; run it once for each"),
        (["--algo", "mappo,qmix"], "esp tune takes one --algo, not 2"),
        (["--prior", "magic"], "--prior names each kind once; they are none, esp, augment, consistency"),
        (["--for", "steps"], "--for steps needs --reach RETURN"),
        (["--for", "steps", "--reach", "nan"], "--reach"),
        (["--set", "mappo.learning_rate=1e-3"], "--set mappo.learning_rate fixes what the space varies"),
        (["--algo", "qmix"], "cannot set 'mappo.num_envs'"),
        (["--seed-list", "1001"], "seed 1001 belongs to the trials"),
        (["--steps", "formation=500k"], "--steps formation=500000 concerns no run of this tuning"),
    ],
)
def test_what_is_wrong_is_told_before_there_is_a_folder(
    command: list[object], tmp_path: Path, options: list[str], sentence: str
) -> None:
    assert sentence in refused(*command, *(() if "--steps" in options else ("--steps", "300")), *options)
    assert not (tmp_path / "t").exists()


def test_without_optuna_tuning_is_refused_in_one_sentence(
    command: list[object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    monkeypatch.delitem(sys.modules, "esp_cli.studies.tuner", raising=False)
    assert refused(*command, "--steps", "300") == "Optuna is not installed: pip install 'optuna>=4.2'"
    assert not (tmp_path / "t").exists()


@pytest.mark.usefixtures("forked_jobs")
def test_a_search_goes_from_a_command_to_a_preset_and_a_study_on_fresh_seeds(
    command: list[object], tmp_path: Path
) -> None:
    words = [*command, "--budget", 2, "--steps", 200, "--trial-seeds", 1, "--seeds", 2, "--episodes", 4, "--jobs", 2]
    told = esp(*words)
    out = tmp_path / "t"
    assert "Budget: 2 trials of 1 seed and" in " ".join(told.stdout.split())
    study = StudyFolder.open(out / "fresh")
    assert all(study.is_finished(cell) for cell in study.study.cells)
    assert {cell.config.seeds for cell in study.study.cells} == {(0, 1)}
    assert [cell.variant.split(" (")[0] for cell in study.study.cells][:1] == ["ESP, default"]
    esp("train", "--config", out / "preset-esp.json", "--print-config")
    assert (out / "report" / "tuning.md").is_file()
    again = esp(*words)
    assert "2 runs, 2 of them finished" in again.stderr
    assert f"next: esp report {out / 'fresh'}" in again.stderr
    assert f"report its study by: esp report {out / 'fresh'}" in refused("report", out)
    outcome = json.loads((out / "report" / "tuning.json").read_text())["outcomes"][0]
    assert (outcome["prior"], outcome["trials"]) == ("esp", 2)
    json.loads(esp(*words, "--json", "-").stdout)
    esp("report", out / "fresh")
    assert (out / "fresh" / "report" / "report.html").is_file()
