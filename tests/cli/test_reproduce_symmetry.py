"""`esp reproduce symmetry`: costs, mistakes, and a small benchmark that survives being killed."""

import json
from pathlib import Path

import pytest

from esp_cli import app
from esp_cli.studies.search import Trials
from esp_cli.studies.study import StudyFolder
from esp_cli.training import trainer
from tests.cli.running import TINY_OPTIONS, esp, refused
from tests.forks import fork, killed, said, wait
from tests.studies.small_studies import write_run
from tests.studies.test_symmetry import benchmark, write_trials

SMALL = ("reproduce", "symmetry", "--tasks", "navigation", "--budget", "2", "--seeds", "2", "--episodes", "4")
STEPS = ("--steps", "500")


def test_a_dry_run_states_the_cost_of_each_method_and_makes_nothing(tmp_path: Path) -> None:
    words = [*SMALL, *STEPS, *TINY_OPTIONS, "--methods", "plain,sets, ESP", "--out", tmp_path / "s", "--dry-run"]
    found = json.loads(esp(*words, "--json", "-").stdout)
    assert {run["name"]: (run["steps"], run["num_seeds"]) for run in found["runs"]} == {
        "navigation: plain": (150, 3),
        "navigation: sets, ESP": (150, 3),
        "navigation-500-plain": (500, 2),
        "navigation-500-sets-esp": (500, 2),
    }
    assert found["core_seconds"] == pytest.approx(sum(run["seconds"] for run in found["runs"]))
    assert "2 trials of each, and the runs that judge: " in esp(*words).stdout
    assert not (tmp_path / "s").exists()
    assert "is not empty and no study" in refused(*words, "--out", Path(__file__).parent)


def test_a_dry_run_in_a_folder_counts_what_is_left(tmp_path: Path) -> None:
    asked = benchmark(budget=2)
    write_trials(tmp_path / "s", asked, {})
    words = ("reproduce", "symmetry", "--tasks", "navigation", "--methods", "plain,ESP", "--budget", "2", "--seeds", 4)
    words += ("--episodes", 4, "--out", tmp_path / "s", "--dry-run", "--json", "-")
    found = json.loads(esp(*words).stdout)
    assert [run["status"] for run in found["runs"]] == ["finished"] * 2 + ["new"] * 2
    assert f"report what judges them by: esp report {tmp_path}/s/fresh" in refused("report", tmp_path / "s")
    fresh = StudyFolder.create(tmp_path / "s" / "fresh", asked.judged(Trials.open(tmp_path / "s")))
    for cell in fresh.study.cells:
        write_run(fresh, cell, [[-1.0] * 4], [-1.0] * 4)
    found = json.loads(esp(*words).stdout)
    assert ([run["status"] for run in found["runs"]], found["seconds"]) == (["finished"] * 4, 0)
    assert "has trials on navigation, 60k, 2 each, and" in refused(*words, "--budget", "3")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["symmetry", "--methods", "magic"], "'magic' is no method"),
        (["symmetry", "--algo", "mappo,qmix"], "this benchmark tunes one learner"),
        (["table1", "--budget", "3"], "--methods and --budget are for esp reproduce symmetry"),
        (["agents", "--methods", "plain"], "--methods and --budget are for esp reproduce symmetry"),
    ],
)
def test_what_is_wrong_is_told_before_there_is_a_folder(tmp_path: Path, arguments: list[str], sentence: str) -> None:
    assert sentence in refused("reproduce", *arguments, "--tasks", "navigation", "--out", tmp_path / "s")
    assert not (tmp_path / "s").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("forked_jobs")
def test_a_benchmark_that_is_killed_goes_on_and_ends_in_a_report(tmp_path: Path) -> None:
    """Killed in the middle of a trial and of a run that judges, it trains what one that was left alone does."""
    out, alone = tmp_path / "s", tmp_path / "alone"
    words = [*SMALL, "--steps", "1500", *TINY_OPTIONS, "--methods", "plain,ESP", "--jobs", "1"]

    def study() -> None:
        trainer.CHECKPOINT_SECONDS = trainer.CHECKPOINT_SPACING = 0
        app.app([*words, "--out", str(out)])

    def rows(run: str) -> int:
        file = out / run / "metrics.jsonl"
        return file.read_bytes().count(b"\n") if file.exists() else 0

    names = ["runs/navigation-1.5k-plain-1", "fresh/runs/navigation-1.5k-esp"]
    for name in names:
        killed(study, out, lambda name=name: rows(name), 3)
    assert wait(fork(study, out)) == 0, said(out)
    told = esp(*words, "--out", alone)
    for name in names:
        policies = [(folder / name / "policy.safetensors").read_bytes() for folder in (out, alone)]
        assert policies[0] == policies[1]
    assert (out / "trials.json").read_bytes() == (alone / "trials.json").read_bytes()
    assert f"next: esp report {alone / 'fresh'}" in told.stderr
    grown = refused(*words, "--budget", "3", "--out", out)
    assert (
        "has trials on navigation, 450, 2 each, and fresh judges them; keep its --budget, or choose another --out"
        in grown
    )
    document = json.loads(esp(*words, "--out", out, "--json", "-").stdout)
    assert [cell["variant"] for cell in document["cells"]] == ["plain", "ESP"]
    assert all({"early", "area_under_curve", "parameters", "seconds"} <= cell.keys() for cell in document["cells"])
    esp("report", out / "fresh")
    assert (out / "fresh" / "report" / "returns-1.png").is_file()
    assert all(map(StudyFolder.open(out / "fresh").is_finished, StudyFolder.open(out / "fresh").study.cells))
