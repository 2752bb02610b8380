"""`esp tune`: costs, mistakes, and one small search from the command to a preset."""

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
    assert "all trials with the default settings, of which pruning saves about half: " in told.stdout
    assert "with 3 side by side" in told.stdout
    assert not (tmp_path / "t").exists()
    assert "no such folder" in refused(*command, "--steps", 300, "--dry-run", "--reuse", tmp_path / "nowhere")
    foreign = refused(*command, "--steps", 300, "--dry-run", "--out", Path(__file__).parent)
    assert "is not empty and no tuning" in foreign
    planned = json.loads(esp(*command, "--prior", "esp,none", "--steps", 300, "--dry-run", "--json", "-").stdout)
    assert [one["name"] for one in planned["runs"][:2]] == ["30 trials, prior esp", "30 trials, prior none"]
    assert len(planned["runs"]) == 2 + 4, "of each the default settings and the best"
    assert planned["core_seconds"] == pytest.approx(sum(run["seconds"] for run in planned["runs"]))


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--budget", "1" + "0" * 309], "--budget"),
        (["--task", "formation"], "esp tune takes one --task, not 2; run it once for each"),
        (["--algo", "mappo,qmix"], "esp tune takes one --algo, not 2"),
        (["--prior", "magic"], "'magic' is no kind of prior; choose from 'none', 'esp', "),
        (["--set", "mappo.learning_rate=1e-3"], "--set mappo.learning_rate fixes what the space varies"),
        (["--algo", "qmix"], "cannot set 'mappo.num_envs'"),
        (["--algo", "mapo"], "unknown algorithm 'mapo'; did you mean 'mappo'?"),
        (["--set", "prior.kind=none"], "takes the kinds of prior by --prior"),
        (["--gpu-share", "0.5"], "--gpu-share is for GPUs of a Ray cluster; add --engine ray"),
        (["--seed-list", "1001"], "seed 1001 belongs to the trials"),
        (["--steps", "formation=500k"], "--steps formation=500000 concerns no run here; the tasks are navigation"),
    ],
)
def test_what_is_wrong_is_told_before_there_is_a_folder(command, tmp_path, options, sentence):
    assert sentence in refused(*command, *(() if "--steps" in options else ("--steps", "300")), *options)
    assert not (tmp_path / "t").exists()


def test_without_optuna_tuning_is_refused_in_one_sentence(command, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    monkeypatch.delitem(sys.modules, "esp_cli.studies.search", raising=False)
    assert refused(*command, "--steps", "300") == "Optuna is not installed: pip install 'optuna>=4.2'"
    assert not (tmp_path / "t").exists()


@pytest.mark.usefixtures("forked_jobs")
def test_a_search_goes_from_a_command_to_a_preset_and_a_study_on_fresh_seeds(command, tmp_path):
    words = [*command, "--budget", 2, "--steps", 200, "--trial-seeds", 1, "--seeds", 2, "--episodes", 4, "--jobs", 2]
    told = esp(*words)
    out = tmp_path / "t"
    assert "Budget: 2 trials of 1 seed and" in " ".join(told.stdout.split())
    study = StudyFolder.open(out / "fresh")
    assert all(study.is_finished(cell) for cell in study.study.cells)
    assert {cell.config.seeds for cell in study.study.cells} == {(0, 1)}
    assert [cell.variant.split(" (")[0] for cell in study.study.cells][:1] == ["ESP, default"]
    tuned = json.loads(esp("train", "--config", out / "preset-esp.json", "--print-config").stdout)
    assert (tuned["steps"], tuned["prior"]["kind"]) == (200, "esp")
    assert (out / "report" / "tuning.md").is_file()
    grown = [*words, "--budget", 9, "--episodes", 8]
    assert f"{out / 'fresh'} holds another study; go on with it by 'esp tune" in refused(*grown)
    assert len(list((out / "trials").iterdir())) == 2, "nothing is trained for a study that is refused"
    left = json.loads(esp(*words, "--dry-run", "--json", "-").stdout)
    assert {run["status"].split()[0] for run in left["runs"]} <= {"finished", "like"}
    assert (left["core_seconds"], left["seconds"]) == (0, 0)
    more = json.loads(esp(*words, "--budget", 3, "--dry-run", "--json", "-").stdout)
    first, *rest = (run["status"] for run in more["runs"])
    assert (first, set(rest)) == ("2 of 3 finished", {"finished", "new"})
    for options in (("--budget", 1), ("--trial-seeds", 2)):
        assert "holds another tuning; go on with it by" in refused(*words, *options, "--dry-run")
    again = esp(*words)
    assert "2 runs, 2 of them finished" in again.stderr
    assert f"next: esp report {out / 'fresh'}" in again.stderr
    assert f"report what judges them by: esp report {out / 'fresh'}" in refused("report", out)
    outcome = json.loads((out / "report" / "tuning.json").read_text())["outcomes"][0]
    assert (outcome["prior"], outcome["trials"]) == ("esp", 2)
    json.loads(esp(*words, "--json", "-").stdout)
    esp("report", out / "fresh")
    assert (out / "fresh" / "report" / "report.html").is_file()


@pytest.mark.usefixtures("forked_jobs")
def test_a_setting_of_the_task_is_refused_by_its_name_and_auto_is_a_prior_as_any(command, tmp_path):
    (tmp_path / "space.json").write_text(json.dumps({"mappo.gamma": [0.9, 0.99], "prior.kind": ["none"]}))
    assert "takes the kinds of prior by --prior" in refused(*command, "--steps", 100)
    (tmp_path / "space.json").write_text(json.dumps({"navigation.wind": [0.0, 0.3], "prior.doubt": [4.0, 8.0]}))
    assert "the space varies 'task.wind'" in refused(*command, "--steps", 100)
    assert not (tmp_path / "t").exists()
    (tmp_path / "space.json").write_text(json.dumps({"mappo.gamma": [0.9, 0.95], "prior.doubt": [4.0, 8.0]}))
    command += ["--set", "navigation.wind=0.3"]
    once = ["--budget", 1, "--steps", 100, "--trial-seeds", 1, "--seeds", 1, "--episodes", 4, "--jobs", 1]
    esp(*command, *once, "--prior", "auto,none")
    outcomes = json.loads((tmp_path / "t" / "report" / "tuning.json").read_text())["outcomes"]
    assert [set(one["settings"]) for one in outcomes] == [{"mappo.gamma", "prior.doubt"}, {"mappo.gamma"}]
    study = StudyFolder.open(tmp_path / "t" / "fresh").study
    assert [cell.variant for cell in study.cells] == ["plain, default", "auto, default"]
    tuned = json.loads(esp("train", "--config", tmp_path / "t" / "preset-auto.json", "--print-config").stdout)
    assert "rot90" in tuned["prior"]["weights"]
