"""`esp tune`: costs, mistakes, and one small search from the command to a preset."""

import json
from pathlib import Path

import pytest

from esp_cli.studies.study import StudyFolder
from tests.cli.running import TINY_OPTIONS, esp, refused

SPACE = {"mappo.learning_rate": {"low": 1e-4, "high": 1e-2, "log": True}, "prior.consistency_coef": [0.1, 1.0]}


@pytest.fixture
def command(tmp_path: Path) -> list[object]:
    (tmp_path / "space.json").write_text(json.dumps(SPACE))
    return ["tune", "--task", "navigation", *TINY_OPTIONS, "--space", tmp_path / "space.json", "--out", tmp_path / "t"]


def test_a_dry_run_states_the_cost_of_equal_budgets_and_makes_nothing(command: list[object], tmp_path: Path) -> None:
    told = esp(*command, "--prior", "esp,none", "--budget", 5, "--steps", 300, "--seeds", 2, "--jobs", 3, "--dry-run")
    assert "5 trials of each, and the runs that judge: " in told.stdout
    assert "with 3 side by side" in told.stdout
    assert not (tmp_path / "t").exists()
    assert "no such folder" in refused(*command, "--steps", 300, "--dry-run", "--reuse", tmp_path / "nowhere")
    foreign = refused(*command, "--steps", 300, "--dry-run", "--out", Path(__file__).parent)
    assert "is not empty and no study" in foreign
    planned = json.loads(esp(*command, "--prior", "esp,none", "--steps", 300, "--dry-run", "--json", "-").stdout)
    assert [one["name"] for one in planned["runs"][:2]] == ["navigation: ESP", "navigation: plain"]
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
        (["--seed-list", "101"], "seed 101 belongs to the trials"),
        (["--steps", "formation=500k"], "--steps formation=500000 concerns no run here; the tasks are navigation"),
    ],
)
def test_what_is_wrong_is_told_before_there_is_a_folder(command, tmp_path, options, sentence):
    assert sentence in refused(*command, *(() if "--steps" in options else ("--steps", "300")), *options)
    assert not (tmp_path / "t").exists()


@pytest.mark.usefixtures("forked_jobs")
def test_a_search_goes_from_a_command_to_a_preset_and_a_study_on_fresh_seeds(command, tmp_path):
    words = [*command, "--budget", 2, "--steps", 200, "--trial-seeds", 1, "--seeds", 2, "--episodes", 4, "--jobs", 2]
    told = esp(*words)
    out = tmp_path / "t"
    study = StudyFolder.open(out / "fresh")
    assert all(study.is_finished(cell) for cell in study.study.cells)
    assert {cell.config.seeds for cell in study.study.cells} == {(0, 1)}
    assert [cell.variant.split(" (")[0] for cell in study.study.cells][:1] == ["ESP, default"]
    tuned = json.loads(esp("train", "--config", out / "preset-esp.json", "--print-config").stdout)
    assert (tuned["steps"], tuned["prior"]["kind"]) == (200, "esp")
    assert f"next: esp train --config {out / 'preset-esp.json'}" in told.stderr
    assert f"next: esp report {out / 'fresh'}" in told.stderr
    left = json.loads(esp(*words, "--dry-run", "--json", "-").stdout)
    assert {run["status"].split()[0] for run in left["runs"]} <= {"finished", "like"}
    assert (left["core_seconds"], left["seconds"]) == (0, 0)
    more = json.loads(esp(*words, "--budget", 3, "--dry-run", "--json", "-").stdout)
    first, *rest = (run["status"] for run in more["runs"])
    assert (first, set(rest)) == ("2 of 3 finished", {"finished", "new"})
    assert "holds another study (esp-000 has other seeds or settings)" in refused(*words, "--trial-seeds", 2)
    assert "holds another study (esp-default has other seeds" in refused(*words, "--budget", 3, "--seeds", 3)
    assert len(StudyFolder.open(out).study.cells) == 2, "nothing is tried first"
    again = esp(*words)
    assert "2 runs, 2 of them finished" in again.stderr
    assert f"report what judges them by: esp report {out / 'fresh'}" in refused("report", out)
    grown = json.loads(esp(*words, "--budget", 3, "--json", "-").stdout)
    assert len(json.loads((out / "trials.json").read_text())["scores"]["navigation, 200: ESP"]) == 3
    assert grown["cells"][0]["variant"] == "ESP, default"
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
    once = ["--budget", 2, "--steps", 100, "--trial-seeds", 1, "--seeds", 1, "--episodes", 4, "--jobs", 1]
    esp(*command, *once, "--prior", "auto,none")
    study = StudyFolder.open(tmp_path / "t" / "fresh").study
    assert [cell.variant for cell in study.cells if "default" in cell.variant] == ["plain, default", "auto, default"]
    assert json.loads((tmp_path / "t" / "trials.json").read_text())["draws"][1].keys() == {"mappo.gamma", "prior.doubt"}
    tuned = json.loads(esp("train", "--config", tmp_path / "t" / "preset-auto.json", "--print-config").stdout)
    assert "rot90" in tuned["prior"]["weights"]
