"""Folders and files that version 0.1.0 wrote load, resume, evaluate, report and export."""

import hashlib
import json
import re
import shlex
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from esp_cli.reporting.results import read_results, summarised
from esp_cli.reporting.tables import TABLES
from tests.cli.running import esp
from tests.learning.golden import probe

ROOT = Path(__file__).parents[2]
OLD = ROOT / "tests" / "fixtures" / "written_by_0.1"
RUNS = ("mappo", "maddpg")


def study_command() -> list[str]:
    """Return the command that the old study says goes on with it, without its folder."""
    arguments = shlex.split(json.loads((OLD / "study" / "study.json").read_text())["command"])
    assert (arguments[0], arguments[-2]) == ("esp", "--out")
    return [*arguments[1:-2], "--jobs", "2"]


def per_seed(evaluation: Path) -> list[list[float]]:
    result = json.loads(evaluation.read_text())
    return [result[mode]["per_seed"] for mode in ("greedy", "stochastic")]


@pytest.fixture(scope="module")
def resumed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The interrupted runs, trained to their end."""
    out = {}
    for name in RUNS:
        out[name] = tmp_path_factory.mktemp("old") / name
        shutil.copytree(OLD / f"{name}-half-way", out[name])
        assert "resuming at 200" in esp("train", "--resume", out[name]).stderr
    return out


@pytest.fixture(scope="module")
def like_machine() -> None:
    """Skip where the numbers of old runs are out of reach."""
    if probe() != (OLD / "probe.txt").read_text().strip():
        pytest.skip("this processor, or its libraries, round otherwise than those that the old runs come from")


@pytest.fixture(scope="module")
def study(forked_jobs: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The half-done study, done."""
    folder = tmp_path_factory.mktemp("old") / "study"
    shutil.copytree(OLD / "study", folder)
    told = esp(*study_command(), "--out", folder)
    assert "4 runs, 2 of them finished" in told.stderr
    return folder


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.usefixtures("like_machine")
def test_an_interrupted_run_ends_with_the_policy_of_an_uninterrupted_one(name, resumed, tmp_path):
    esp("eval", resumed[name], "--episodes", 4, "--json", tmp_path / "eval.json")
    for ended, expected in zip(per_seed(tmp_path / "eval.json"), per_seed(OLD / f"{name}-eval.json"), strict=True):
        assert ended == pytest.approx(expected, rel=1e-4)


def test_a_resumed_run_ends_with_the_weights_of_an_uninterrupted_one_to_rounding(resumed: dict[str, Path]) -> None:
    ended, expected = load_file(resumed["mappo"] / "policy.safetensors"), load_file(OLD / "policy.safetensors")
    (half_way,) = (OLD / "mappo-half-way" / "checkpoints").iterdir()
    before = load_file(half_way)
    assert ended.keys() == expected.keys()
    for name, tensor in ended.items():
        torch.testing.assert_close(tensor, expected[name], rtol=1e-4, atol=1e-5)
    gaps = [(before[f"policy.{name}"] - expected[name]).abs().max() for name in ended if name.endswith("weight")]
    assert min(gaps) > 1e-4, "negative control: half-way they were others"


@pytest.mark.parametrize("name", RUNS)
def test_a_resumed_run_is_whole(name: str, resumed: dict[str, Path]) -> None:
    before = (OLD / f"{name}-half-way" / "metrics.jsonl").read_text()
    after = (resumed[name] / "metrics.jsonl").read_text()
    assert after.startswith(before)
    assert [json.loads(line)["step"] for line in after.splitlines()][-1] == 400
    assert (resumed[name] / "policy.safetensors").is_file()
    assert "is complete at 400 steps" in esp("train", "--resume", resumed[name]).stderr


@pytest.mark.parametrize("name", RUNS)
def test_an_interrupted_run_is_evaluated_from_its_checkpoint(name: str, tmp_path: Path) -> None:
    run = shutil.copytree(OLD / f"{name}-half-way", tmp_path / name)
    assert "after 200 steps" in esp("eval", run, "--episodes", 2).stdout
    esp("export", run, "-f", "numpy", "-o", tmp_path / "export", "--episodes", 2)
    assert (tmp_path / "export" / "policy.py").is_file()


@pytest.mark.usefixtures("like_machine")
def test_a_policy_file_plays_as_it_did(tmp_path: Path) -> None:
    esp("eval", OLD / "policy.safetensors", "--episodes", 4, "--json", tmp_path / "eval.json")
    assert per_seed(tmp_path / "eval.json") == per_seed(OLD / "mappo-eval.json")


def test_a_policy_file_is_exported(tmp_path: Path) -> None:
    esp("export", OLD / "policy.safetensors", "-f", "numpy", "-o", tmp_path / "export", "--seed", 1)
    assert (tmp_path / "export" / "policy.py").is_file()


def test_old_runs_are_compared(resumed: dict[str, Path], tmp_path: Path) -> None:
    esp("report", *resumed.values(), "--at", 200, "--json", tmp_path / "report.json")
    first, second = json.loads((tmp_path / "report.json").read_text())["cells"]
    for run, name in ((first, "mappo"), (second, "maddpg")):
        rows = map(json.loads, (OLD / f"{name}-half-way" / "metrics.jsonl").read_text().splitlines())
        returns = next(row["eval/return_greedy"] for row in rows if row["step"] == 200)
        assert run["returns"]["greedy"] == pytest.approx(returns, rel=1e-8)


def test_a_half_done_study_is_planned_and_reported(tmp_path: Path) -> None:
    folder = shutil.copytree(OLD / "study", tmp_path / "study")
    assert "2 runs to do" in esp(*study_command(), "--out", folder, "--dry-run").stdout
    assert "2 runs to do" in esp(*study_command(), "--out", tmp_path / "new", "--reuse", folder, "--dry-run").stdout
    esp("report", folder, "--results", tmp_path / "results.json")
    cells = json.loads((tmp_path / "results.json").read_text())["cells"]
    assert [cell["status"] for cell in cells] == ["finished", "finished", "not run", "not run"]
    assert (folder / "report" / "report.html").is_file()


@pytest.mark.slow
@pytest.mark.usefixtures("like_machine")
def test_a_finished_study_has_the_numbers_of_the_old_one(study: Path, tmp_path: Path) -> None:
    esp("report", study, "--results", tmp_path / "new.json")
    shutil.copy(OLD / "study-results.json", tmp_path / "old.json")
    tables = []
    for name in ("new", "old"):
        results = summarised(read_results(tmp_path / f"{name}.json"))
        text = "".join(TABLES[kind](results).markdown() for kind in ("returns", "comparison", "statistics", "steps"))
        tables.append(re.sub(r"\| \d+ s \|", "| TIME |", text))  # of training, on the machine at hand
    assert tables[0] == tables[1]
    assert "augmentation" in tables[0]


def test_shipped_policies_are_untouched() -> None:
    listed = dict(line.split()[::-1] for line in (OLD / "checkpoints.sha256").read_text().splitlines())
    del listed["manifest.json"]  # which gains the policies that came later
    shipped = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in (ROOT / "checkpoints").iterdir()}
    assert listed
    assert listed.items() <= shipped.items()
    entries = json.loads((ROOT / "checkpoints" / "manifest.json").read_text())["policies"]
    assert {entry["file"]: entry["sha256"] for entry in entries}.items() <= shipped.items()
    assert listed.keys() <= {entry["file"] for entry in entries}
