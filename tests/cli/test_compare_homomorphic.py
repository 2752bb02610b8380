"""`esp compare-homomorphic`: trains, goes on, tabulates; wildlife with every network from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from esp_cli.reporting.homomorphic import CONTESTANTS, flops_per_action, plan
from esp_cli.training.config import resolve_config
from tests.cli.running import esp, refused

TINY = {
    "mappo.num_envs": 4,
    "mappo.num_steps": 8,
    "mappo.num_epochs": 1,
    "network.hidden": [8],
    "evaluation.episodes": 2,
    "evaluation.every_steps": 32,
    "task.horizon": 6,
}
OPTIONS = [part for name, value in TINY.items() for part in ("--set", f"{name}={json.dumps(value)}")]


def test_all_contestants_are_trained_and_compared(tmp_path: Path) -> None:
    out = tmp_path / "study"
    command = ("compare-homomorphic", "--steps", 64, "--seeds", 2, "--grid", 3, "--drones", 2, "--out", out, *OPTIONS)
    table = esp(*command).stdout
    result = json.loads((out / "comparison.json").read_text())
    assert [run["label"] for run in result["runs"]] == list(CONTESTANTS)
    for run in result["runs"]:
        assert run["label"] in table
        assert len(run["returns"]["64"]["per_seed"]) == 2
        assert min(run["flops_per_action"], run["parameters"]["policy"], run["parameters"]["critic"]) > 0
        assert run["config"]["task_settings"]["num_agents"] == 2
    assert result["runs"][1]["returns"]["64"]["difference"]["paired"]
    assert [run["paper"] for run in result["runs"]] == [2.1, 2.4, 2.25, None]
    assert (out / "curves.png").stat().st_size > 1000
    metrics = (out / "empn" / "metrics.jsonl").read_bytes()
    again = esp(*command)
    assert table.endswith(again.stdout), "the second time, nothing but the last table: nothing is trained"
    assert "is complete" in again.stderr
    assert (out / "empn" / "metrics.jsonl").read_bytes() == metrics
    message = refused(*command, "--group", "d4")
    assert "holds a run of other settings" in message


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--contestants", "mpn,cnn"], "name each contestant once; they are mpn, mpn-esp, empn, mpn-ensemble"),
        (["--contestants", "mpn,mpn"], "name each contestant once"),
        (["--grid", "6"], "use odd numbers"),
        (["--group", "so2"], "so2 cannot act on wildlife"),
        (["--set", "network.name=mlp"], "is what tells the contestants apart"),
    ],
)
def test_what_cannot_be_compared_is_refused(tmp_path: Path, options, message) -> None:
    assert message in refused("compare-homomorphic", "--steps", 10, "--out", tmp_path / "study", *OPTIONS, *options)
    assert not (tmp_path / "study").exists()


def test_contestants_differ_in_network_and_prior_alone() -> None:
    configs = plan(list(CONTESTANTS), 100, (0, 1), 3, 7, "c4", {})
    rest = {config.model_copy(update={"network": None, "prior": None}).model_dump_json() for config in configs.values()}
    assert len(rest) == 1
    assert configs["mpn-esp"].prior.kind == "esp"
    assert {name: config.network.name for name, config in configs.items()} == {
        "mpn": "mpn",
        "mpn-esp": "mpn",
        "empn": "empn",
        "mpn-ensemble": "mpn",
    }
    assert configs["mpn-ensemble"].network.symmetrise == "c4"


def test_flops_by_hand() -> None:
    perceptron = resolve_config("navigation", overrides={"network.hidden": [10]})
    assert flops_per_action(perceptron) == 2 * (14 * 10 + 10 * 5)
    ensemble = resolve_config("navigation", overrides={"network.hidden": [10], "network.symmetrise": "c4"})
    # each of four images is made by a product of 14 x 14 and brought home by one of 5 x 5
    assert flops_per_action(ensemble) == 4 * 2 * (14 * 10 + 10 * 5 + 14 * 14 + 5 * 5)
    messages = resolve_config("wildlife", overrides={"network.hidden": [64]})
    convolutions = 8 * 8 * 49 * 16 + 4 * 4 * 16 * 25 * 32
    assert flops_per_action(messages) == 2 * (convolutions + (2 * 32 + 2) * 64 + 64 * 5)


def test_a_run_on_wildlife_goes_on_bit_for_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("esp_cli.training.trainer.CHECKPOINT_SECONDS", 0.0)
    base = ("train", "--task", "wildlife", *OPTIONS, "--steps", 160)
    esp(*base, "--out", tmp_path / "whole")
    cut = tmp_path / "cut"
    esp(*base, "--out", cut)
    newest = sorted((cut / "checkpoints").iterdir())
    for file in newest[1:]:  # as if killed before these were written
        file.unlink()
    (cut / "policy.safetensors").unlink()
    esp("train", "--resume", cut)
    assert (cut / "policy.safetensors").read_bytes() == (tmp_path / "whole" / "policy.safetensors").read_bytes()


@pytest.mark.parametrize("algo", ["maddpg", "qmix"])
def test_off_policy_learners_play_episodes_that_end_early(tmp_path: Path, algo: str) -> None:
    settings = {"num_envs": 2, "replay_episodes": 8, "batch_episodes": 2, "warmup_episodes": 2}
    options = [part for name, value in settings.items() for part in ("--set", f"{algo}.{name}={value}")]
    rest = [part for part in OPTIONS if part != "--set" and not part.startswith("mappo")]
    options += [part for setting in rest for part in ("--set", setting)]
    board = ("--set", "task.width=3", "--set", "task.height=3", "--set", "task.num_agents=2")
    esp("train", "--algo", algo, "--task", "wildlife", *options, *board, "--steps", 48, "--out", tmp_path / "run")
    result = tmp_path / "result.json"
    esp("eval", tmp_path / "run", "--episodes", 8, "--json", result)
    metrics = json.loads(result.read_text())["metrics"]
    assert 1 <= metrics["steps"] <= 6
    assert 0 <= metrics["captures"] <= 1


def test_a_film_of_drones_and_poacher(tmp_path: Path) -> None:
    esp("train", "--task", "wildlife", *OPTIONS, "--steps", 32, "--out", tmp_path / "run")
    esp("eval", tmp_path / "run", "--episodes", 4)
    for name in ("film.gif", "film.png"):
        esp("render", tmp_path / "run", "-o", tmp_path / name, "--size", 64)
        assert (tmp_path / name).stat().st_size > 200
