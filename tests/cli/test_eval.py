"""`esp eval`: the documented result, and one sentence for whatever is no policy."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from esp_cli.app import app
from esp_cli.policies import loading
from tests.cli.running import DAMAGE, edit_config, esp, refused, train_tiny

DOCUMENTED = {"task", "task_version", "convention", "episodes", "greedy", "stochastic", "anchors", "metrics"}
BESIDE = {"esp_version", "source", "step", "seeds", "heuristics", "metrics_per_seed", "anchor_metrics", "task_settings"}
BESIDE |= {"roles", "over_episodes", "parameters", "flops_per_action"}


def test_the_result_has_the_documented_keys_and_its_parts_agree(finished: Path, tmp_path: Path) -> None:
    file = tmp_path / "new" / "result.json"
    shown = esp("eval", finished, "--episodes", 4, "--json", file).stdout
    result = json.loads(file.read_text())
    assert set(result) == DOCUMENTED | BESIDE
    assert (result["task"], result["task_version"], result["episodes"]) == ("navigation", 1, 4)
    assert (result["source"], result["step"], result["seeds"]) == (str(finished), 150, [3, 7])
    assert set(result["anchors"]) == {"random", "heuristic", "cover", "blind"}
    assert set(result["metrics"]) == {"collisions", "collisions_per_agent", "landmark_distance", "coverage"}
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


def test_one_seed_has_no_error_over_seeds_and_states_that_over_episodes(tmp_path: Path) -> None:
    run = train_tiny(tmp_path / "one", steps=50)
    told = esp("eval", run, "--episodes", 8, "--json", tmp_path / "result.json").stdout
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["greedy"]["sem"] is None
    assert result["greedy"]["ci95"] is None
    spread = result["over_episodes"]
    assert set(spread) == {"greedy", "stochastic", *result["anchors"]}
    (row,) = (line for line in told.splitlines() if "greedy  " in line and "heuristic" not in line)
    low, high = spread["greedy"]["ci95"]
    assert low < result["greedy"]["mean"] < high
    cells = [cell.strip() for cell in row.strip("│").split("│")]
    shown = f"{result['greedy']['mean']:.2f} ± {spread['greedy']['sem']:.2f}"
    random, best = (result["anchors"]["random"], max(v for k, v in result["anchors"].items() if k != "random"))
    score = (result["greedy"]["mean"] - random) / (best - random)
    assert cells == ["greedy", shown, f"[{low:.2f}, {high:.2f}]", f"{score:.2f}"]
    assert "95 % interval over 8 episodes of one seed" in told


def test_one_seed_that_stopped_has_no_return(monkeypatch: pytest.MonkeyPatch) -> None:
    open_policy = loading.open_policy
    monkeypatch.setattr(loading, "open_policy", lambda *given: replace(open_policy(*given), stopped=(0,)))
    told = CliRunner().invoke(app, ["eval", "navigation", "--episodes", "2"])
    assert told.exit_code == 0
    rows = [[cell.strip() for cell in line.strip("│").split("│")] for line in told.stdout.splitlines()]
    assert [row for row in rows if row[0] in ("greedy", "stochastic")] == [
        ["greedy", "-", "-", "-"],
        ["stochastic", "-", "-", "-"],
    ]
    assert "heuristic nearest" in told.stdout
    assert "metric" not in told.stdout
    assert "1 seed(s) (1 stopped) x 2 episodes" in " ".join(told.stdout.split())


def test_several_seeds_state_their_error_over_seeds_and_say_so(finished: Path) -> None:
    told = esp("eval", finished, "--episodes", 4).stdout
    assert "95 % interval over seeds, of reference policies over episodes" in told
    spread = json.loads(esp("eval", finished, "--episodes", 4, "--json", "-").stdout)["over_episodes"]
    assert set(spread) == {"random", "heuristic", "cover", "blind"}, "the policy's episodes are those of two seeds"


def test_a_policy_that_was_chosen_by_its_task_is_named() -> None:
    told = esp("eval", "navigation", "--episodes", 2)
    assert "navigation: taking the bundled policy navigation-mappo-esp" in told.stderr.splitlines()
    assert "navigation-mappo-esp on navigation version 1" in told.stdout
    assert "taking" not in esp("eval", "navigation-mappo-esp", "--episodes", 2).stderr


def test_a_near_miss_of_a_policy_is_answered_by_the_one_that_is_meant() -> None:
    assert refused("eval", "formatio") == "formatio does not exist; did you mean 'formation'?"
    assert "give a run folder, a policy file" in refused("eval", "zzz")


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


def test_a_policy_is_judged_under_other_settings_of_its_task(finished: Path) -> None:
    trained = json.loads(esp("eval", finished, "--episodes", 2, "--json", "-").stdout)
    again = json.loads(
        esp("eval", finished, "--episodes", 2, "--set", "task.landmark_extent=1.0", "--json", "-").stdout
    )
    idle = esp("eval", finished, "--episodes", 1, "--set", "task.local_ratio=0.9").stderr
    assert "without effect beside the other settings: task.local_ratio" in idle
    assert trained["task_settings"]["landmark_extent"] is None
    assert again["task_settings"]["landmark_extent"] == 1.0
    assert again["greedy"]["mean"] != trained["greedy"]["mean"]


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("task.num_agents=2", "was trained with other agents than the task has with task.num_agents changed"),
        ("task.num_landmarks=2", "was trained with other observation than the task has"),
        ("task.actions=continuous", "was trained with other action than the task has"),
        ("task.weather=2", "unknown setting 'task.weather'"),
        ("task.horizon=0", "bad value 0 for 'task.horizon'"),
        ("mappo.gamma=0.9", "is not a setting of the task"),
    ],
)
def test_settings_that_a_policy_cannot_take_are_refused(finished: Path, setting: str, sentence: str) -> None:
    assert sentence in refused("eval", finished, "--episodes", 2, "--set", setting)


def test_fewer_episodes_are_played_where_they_are_long_or_of_many_agents_and_the_output_says_so(monkeypatch, finished):
    monkeypatch.setattr("esp_cli.commands.eval._AGENT_STEPS", 5 * 25 * 3 + 1)  # of navigation: 25 steps, 3 agents
    told = esp("eval", finished)
    assert "5 episodes" in told.stdout
    assert "5 each, not 320; --episodes 320 for less error" in told.stderr
    asked = esp("eval", finished, "--episodes", 6)
    assert "6 episodes" in asked.stdout
    assert "each, not" not in asked.stderr


def test_a_policy_is_taken_where_its_last_checkpoint_is_damaged(copied: Path) -> None:
    for file in (copied / "checkpoints").iterdir():
        file.write_bytes(file.read_bytes()[:-5])
    told = esp("eval", copied, "--episodes", 2)
    assert f"taking {copied / 'policy.safetensors'}" in " ".join(told.stderr.split())
    assert "too narrow" in " ".join(told.stdout.split())


def test_a_mean_over_unlike_roles_is_not_normalised(tmp_path: Path) -> None:
    options = ("--task", "predator-prey", "--prior", "none", "--seed-list", "3", "--set", "task.horizon=5")
    for control, has_scale in (("both", False), ("predators", True)):
        run = train_tiny(tmp_path / control, *options, "--set", f"task.control={control}", steps=60)
        told = esp("eval", run, "--episodes", "2")
        assert ("normalised" in told.stdout) == has_scale
        assert "heuristic chase" in told.stdout
