"""`esp eval`: the documented result, and one sentence for whatever is no policy."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch

from tests.cli.running import DAMAGE, edit_config, esp, refused, train_tiny

DOCUMENTED = {"task", "task_version", "convention", "episodes", "greedy", "stochastic", "anchors", "metrics"}
BESIDE = {"esp_version", "source", "step", "seeds", "heuristics", "metrics_per_seed", "anchor_metrics", "task_settings"}


def test_the_result_has_the_documented_keys_and_its_parts_agree(finished: Path, tmp_path: Path) -> None:
    file = tmp_path / "new" / "result.json"
    shown = esp("eval", finished, "--episodes", 4, "--json", file).stdout
    result = json.loads(file.read_text())
    assert set(result) == DOCUMENTED | BESIDE
    assert (result["task"], result["task_version"], result["episodes"]) == ("navigation", 1, 4)
    assert (result["source"], result["step"], result["seeds"]) == (str(finished), 150, [3, 7])
    assert set(result["anchors"]) == {"random", "heuristic", "cover"}
    assert set(result["metrics"]) == {"collisions", "landmark_distance", "coverage"}
    for mode in ("greedy", "stochastic"):
        verdict = result[mode]
        assert set(verdict) == {"mean", "sem", "ci95", "per_seed"}
        low, high = verdict["per_seed"]
        assert verdict["mean"] == pytest.approx((low + high) / 2)
        # two numbers lie |a - b| / sqrt(2) apart in standard deviations; over sqrt(2) that is half their distance
        assert verdict["sem"] == pytest.approx(abs(low - high) / 2)
        assert verdict["ci95"] == pytest.approx(sorted(verdict["per_seed"]))
        assert f"{verdict['mean']:.2f} ± {verdict['sem']:.2f}" in shown
    assert f"{result['anchors']['random']:.2f}" in shown
    assert result["convention"] in shown
    assert "2 seed(s) x 4 episodes" in shown


def test_json_on_standard_output_is_alone_there(finished: Path) -> None:
    result = json.loads(esp("eval", finished, "--episodes", 2, "--json", "-").stdout)
    assert set(result) == DOCUMENTED | BESIDE


def test_one_seed_has_no_error_to_state(tmp_path: Path) -> None:
    run = train_tiny(tmp_path / "one", steps=50)
    result = json.loads(esp("eval", run, "--episodes", 2, "--json", "-").stdout)
    assert result["greedy"]["sem"] is None
    assert result["greedy"]["ci95"] is None
    (row,) = (line for line in esp("eval", run, "--episodes", 2).stdout.splitlines() if "greedy  " in line)
    cells = [cell.strip() for cell in row.strip("│").split("│")]
    assert cells == ["greedy", f"{result['greedy']['mean']:.2f}", "-"]


def test_a_policy_file_gives_the_same_numbers_as_its_run_every_time(finished: Path) -> None:
    policy = finished / "policy.safetensors"
    results = [json.loads(esp("eval", p, "--episodes", 3, "--json", "-").stdout) for p in (finished, policy, policy)]
    assert [result.pop("source") for result in results] == [str(finished), str(policy), str(policy)]
    assert results[0] == results[1] == results[2]


@pytest.mark.parametrize("kind", DAMAGE)
def test_what_is_no_policy_is_told_in_one_sentence(copied: Path, kind: str) -> None:
    damage, sentence = DAMAGE[kind]
    assert sentence in refused("eval", damage(copied), "--episodes", 1)
    assert not (copied / "exploded").exists(), "loading ran code"


def test_a_damaged_newest_checkpoint_is_passed_over_with_a_note(tmp_path: Path) -> None:
    run = train_tiny(tmp_path / "run", steps=50)
    (final,) = (run / "checkpoints").iterdir()
    (run / "checkpoints" / "step-000000000100-final.safetensors").write_bytes(final.read_bytes()[:-9])
    result = esp("eval", run, "--episodes", 1, "--json", "-")
    assert json.loads(result.stdout)["step"] == 50
    assert "step-000000000100-final.safetensors" in result.stderr
    assert "going back to step 50" in result.stderr
    assert result.stderr.count("\n") == 1


def test_a_policy_of_a_gpu_plays_on_the_cpu_where_there_is_none(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    run = edit_config(copied, device="cuda")
    result = json.loads(esp("eval", run, "--episodes", 1, "--json", "-").stdout)
    assert math.isfinite(result["greedy"]["mean"])


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--episodes", "0"], "--episodes"),
        (["--episodes", "many"], "valid integer"),
        (["--speed", "3"], "No such option: --speed"),
    ],
)
def test_a_bad_option_is_told_in_one_sentence(finished: Path, options: list[str], sentence: str) -> None:
    assert sentence in refused("eval", finished, *options)


def test_a_policy_is_judged_under_other_settings_of_its_task(finished: Path) -> None:
    trained = json.loads(esp("eval", finished, "--episodes", 2, "--json", "-").stdout)
    again = json.loads(
        esp("eval", finished, "--episodes", 2, "--set", "task.landmark_extent=1.0", "--json", "-").stdout
    )
    assert trained["task_settings"]["landmark_extent"] is None
    assert again["task_settings"]["landmark_extent"] == 1.0
    assert again["greedy"]["mean"] != trained["greedy"]["mean"]


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("task.num_agents=2", "was trained with other agents than the task has with task.num_agents changed"),
        ("task.num_landmarks=2", "was trained with other observation than the task has"),
        ("task.actions=continuous", "was trained with other action than the task has"),
        ("task.wind=2", "unknown setting 'task.wind'"),
        ("task.horizon=0", "bad value 0 for 'task.horizon'"),
        ("mappo.gamma=0.9", "is not a setting of the task"),
    ],
)
def test_settings_that_a_policy_cannot_take_are_refused(finished: Path, setting: str, sentence: str) -> None:
    assert sentence in refused("eval", finished, "--episodes", 2, "--set", setting)


def test_physics_is_refused_where_a_task_has_none(finished: Path) -> None:
    assert "unknown setting 'task.physics'" in refused("eval", finished, "--physics", "pymunk")
