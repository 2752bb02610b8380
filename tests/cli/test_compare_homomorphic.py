"""`esp compare-homomorphic`: trains, goes on, tabulates; wildlife with every network from the command line."""

import json
from pathlib import Path

import pytest

from esp_cli.policies.evaluation import flops_per_action
from esp_cli.studies.catalogue import Request, plan
from esp_cli.studies.kinds import KINDS
from esp_cli.studies.paper import reported
from esp_cli.training.build import build_environment, build_learner
from esp_cli.training.config import resolve_config
from tests.cli.running import esp, refused

METHODS = KINDS["homomorphic"].variants
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


@pytest.mark.usefixtures("forked_jobs")
def test_all_methods_are_trained_and_compared_as_any_study(tmp_path: Path) -> None:
    out, file = tmp_path / "study", tmp_path / "results.json"
    board = ("--grid", 3, "--drones", 2)
    command = ("compare-homomorphic", "--steps", 64, "--seeds", 2, *board, "--out", out, *OPTIONS, "--jobs", 2)
    first = esp(*command, "--json", file)
    assert "4 runs, 0 of them finished, 2 side by side" in first.stderr
    result = json.loads(file.read_text())
    assert (result["kind"], result["mode"]) == ("homomorphic", "stochastic")
    assert [cell["variant"] for cell in result["cells"]] == list(METHODS)
    for cell in result["cells"]:
        assert cell["variant"] in first.stdout
        assert len(cell["returns"]["stochastic"]) == 2
        assert min(cell["flops_per_action"], cell["parameters"]["policy"]) > 0
        assert [passed["threshold"] for passed in cell["steps_to"]] == [2.0]
        assert {**result["config"], **cell["config"]}["task_settings.num_agents"] == 2
    assert "FLOPs an action" in first.stdout
    again = esp(*command, "--mode", "greedy", "--threshold", 0.5)
    assert f"next: esp report {out} --mode greedy --threshold 0.5" in again.stderr
    assert "The mean over seeds first has 0.5: mpn " in again.stdout
    report = esp("report", out, "--full")
    assert "stochastic return" in report.stdout, "what this kind of study reports"
    assert (out / "report" / "report.html").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--methods", "mpn,cnn"], "choose from 'mpn', 'mpn-esp', 'empn', 'mpn-ensemble'"),
        (["--methods", "mpn,mpn"], "'mpn' is named twice; name it once"),
        (["--grid", "6"], "use odd numbers"),
        (["--group", "so2"], "so2 cannot act on wildlife"),
        (["--set", "network.name=mlp"], "is what this study varies by itself"),
        (["--tasks", "navigation"], "this study is on wildlife alone"),
    ],
)
def test_what_cannot_be_compared_is_refused(tmp_path: Path, options, message) -> None:
    assert message in refused("compare-homomorphic", "--steps", 10, "--out", tmp_path / "study", *OPTIONS, *options)
    assert not (tmp_path / "study").exists()


def test_methods_differ_in_network_and_prior_alone() -> None:
    study = plan("homomorphic", Request(steps=((None, 100), (None, 200_000)), seeds=(0, 1)))
    shorter, cells = study.cells[:4], study.cells[4:]
    assert [cell.paper for cell in shorter] == [None] * 4, "the paper's numbers are of 200k steps"
    configs = {cell.variant: cell.config for cell in cells}
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
    paper = [reported(cell.paper) for cell in cells]
    assert [number and number[0] for number in paper] == [2.1, 2.4, 2.25, None]
    turned = plan("homomorphic", Request(variants=("empn", "mpn-esp"), group="d4"))
    assert [cell.reference for cell in turned.cells] == [None, "wildlife-mappo-200k-empn"]
    assert (turned.cells[0].config.network.group, turned.cells[1].config.prior.transforms) == ("d4", "d4")


@pytest.mark.parametrize("seeds", [(0,), (3, 5)])
def test_flops_by_hand(seeds: tuple[int, ...]) -> None:
    def flops(task: str, overrides: dict[str, object]) -> float:
        config = resolve_config(task, seeds=seeds, overrides=overrides)
        obs = build_environment(config, 1, "shape").reset().obs
        return flops_per_action(build_learner(config).policy, obs)

    assert flops("navigation", {"network.name": "mlp", "network.hidden": [10]}) == 2 * (14 * 10 + 10 * 5)
    # each of four images is made by a product of 14 x 14 and brought home by one of 5 x 5
    ensemble = flops("navigation", {"network.name": "mlp", "network.hidden": [10], "network.symmetrise": "c4"})
    assert ensemble == 4 * 2 * (14 * 10 + 10 * 5 + 14 * 14 + 5 * 5)
    convolutions = 8 * 8 * 49 * 16 + 4 * 4 * 16 * 25 * 32
    assert flops("wildlife", {"network.hidden": [64]}) == 2 * (convolutions + (2 * 32 + 2) * 64 + 64 * 5)


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


def test_a_setting_that_an_option_says_is_refused() -> None:
    told = refused("compare-homomorphic", "--drones", 4, "--set", "task.num_agents=2", "--dry-run")
    assert told == "--drones and --grid say what task.num_agents is; leave --set task.num_agents out"
