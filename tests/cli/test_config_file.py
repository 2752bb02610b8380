"""`esp train` with `--config` and `--print-config`: what files say, and what wins."""

from pathlib import Path

import pytest

from esp_cli.training.settings import parse_config, read_config_file
from tests.cli.running import printed, refused, stored_config, written


def test_a_run_is_configured_again_from_its_folder_and_from_its_file(finished: Path) -> None:
    stored = stored_config(finished)
    assert printed("--config", finished) == stored
    assert printed("--config", finished / "config.json") == stored


@pytest.mark.parametrize(
    "options",
    [
        ["--task", "predator-prey", "--algo", "qmix", "--preset", "paper"],
        ["--task", "formation", "--algo", "maddpg", "--seed-list", "3,7"],
        ["--task", "wildlife", "--network", "empn", "--prior", "none"],
    ],
)
def test_what_is_printed_is_a_file_that_resolves_to_the_same(tmp_path: Path, options: list[str]) -> None:
    whole = printed(*options, "--steps", "20k")
    assert parse_config({k: v for k, v in whole.items() if k not in ("format", "version")}, tmp_path)
    assert printed("--config", written(tmp_path / "c.json", whole)) == whole


def test_auto_means_the_same_over_a_whole_configuration(tmp_path: Path) -> None:
    small = [part for one in ("num_agents=2", "num_obstacles=0", "horizon=5") for part in ("--set", f"task.{one}")]
    whole = written(tmp_path / "c.json", printed("--task", "formation", "--steps", "20k", *small))
    auto = printed("--config", whole, "--prior", "auto")["prior"]
    assert (auto["trust"], auto["fade"], auto["transforms"]) == ("measured", 0.5, "d4")
    assert printed("--config", whole, "--prior", "auto", "--set", "prior.fade=0.2")["prior"]["fade"] == 0.2


def test_what_was_measured_in_a_task_is_measured_anew_in_a_changed_one(tmp_path: Path) -> None:
    small = ("--set", "task.num_agents=1", "--set", "task.num_landmarks=1")
    whole = printed("--prior", "auto", "--steps", "20k", *small)
    whole["prior"] |= {"weights": {"rot90": 0.5}, "transforms": "discovered:rot90"}
    file = written(tmp_path / "c.json", whole)
    for kept in ([], ["--set", "task.wind=0"]):
        assert printed("--config", file, *kept)["prior"] == whole["prior"]
    changed = printed("--config", file, "--set", "task.wind=0.9")["prior"]
    assert changed["transforms"].startswith("discovered:flip-x")
    assert changed["weights"]["flip-x"] == 1
    assert "rot90" not in changed["weights"]


def test_weights_of_elements_are_a_value_in_a_small_file(tmp_path: Path) -> None:
    prior = {"transforms": "rot90,rot180", "trust": "measured", "weights": {"rot90": 0.5, "rot180": 1.0}}
    small = written(tmp_path / "c.json", {"task": "navigation", "prior": prior})
    assert printed("--config", small)["prior"]["weights"] == prior["weights"]


def test_a_setting_that_is_a_table_is_read_whole(tmp_path: Path) -> None:
    file = written(tmp_path / "nested.json", {"task": {"table": {"x": {}}}, "prior.weights": {"rot90": 1.0}})
    assert read_config_file(file).settings == {"task.table": {"x": {}}, "prior.weights": {"rot90": 1.0}}


def test_printing_makes_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    printed("--out", "here")
    assert list(tmp_path.iterdir()) == []


def test_a_tracker_that_is_not_there_is_told_before_anything_is_printed() -> None:
    assert "there is no tracker 'nope'" in refused("train", "--print-config", "--track", "nope")
    assert printed()["task"] == "navigation"


FLAT = {
    "task": "predator-prey",
    "steps": "20k",
    "seeds": [3, 7],
    "task.prey": "fleeing",
    "mappo.learning_rate": 5e-4,
    "network.hidden": [32],
}
NESTED = """
steps = 20000
seeds = [3, 7]
task_settings.prey = "fleeing"
task = "predator-prey"
[mappo]
learning_rate = 5e-4
[network]
hidden = [32]
"""


@pytest.mark.parametrize(("name", "content"), [("c.json", FLAT), ("c.toml", NESTED)])
def test_a_small_file_says_only_what_differs(tmp_path: Path, name: str, content: object) -> None:
    found = printed("--config", written(tmp_path / name, content))
    options = ["--task", "predator-prey", "--steps", "20k", "--seed-list", "3,7", "--set", "task.prey=fleeing"]
    assert found == printed(*options, "--set", "mappo.learning_rate=5e-4", "--set", "network.hidden=[32]")


def test_the_command_line_has_the_last_word_over_a_file(tmp_path: Path) -> None:
    file = written(tmp_path / "c.json", FLAT)
    found = printed("--config", file, "--steps", "1k", "--set", "mappo.learning_rate=1e-4", "--seeds", "2")
    assert (found["steps"], found["seeds"], found["algorithm_settings"]["learning_rate"]) == (1000, [0, 1], 1e-4)
    assert found["task"] == "predator-prey", "the file says what the command line leaves open"


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ({"taks": "navigation"}, "sets 'taks', which is not a choice of a run; did you mean 'task'?"),
        ({"colour": 1}, "write one of task, algorithm, preset, steps, seeds, device, init_from, or a setting"),
        ({"mappo.lr": 1}, "unknown setting 'mappo.lr'; did you mean 'mappo.learning_rate'?"),
        ({"mappo": {"gamma": 2}}, "bad value 2 for 'mappo.gamma'"),
        ({"mappo.gamma": 0.9, "mappo": {"gamma": 0.8}}, "sets 'mappo.gamma' twice; leave one of them out"),
        ({"task.wind": 0.1, "task_settings": {"wind": 0.2}}, "sets 'task.wind' twice; leave one of them out"),
        ({"steps": "some"}, "'some' is not a number of steps"),
        ({"steps": 1.5}, "sets 'steps' to 1.5; write it as esp train --steps takes it"),
        ({"seeds": [3, 3]}, "name one seed twice"),
        ({"seeds": True}, "sets 'seeds' to True"),
        ({"device": "tpu"}, "sets 'device' to 'tpu'"),
        ({"task": ["navigation"]}, "sets 'task' to ['navigation']; write it as esp train --task takes it"),
        ({"init_from": 3}, "sets 'init_from' to 3; write it as esp train --init-from takes it"),
        ({"algorithm": 3}, "sets 'algorithm' to 3; write it as esp train --algo takes it"),
        ({"task": "mine:Task"}, "is not installed; add --task mine:Task to let esp import and run it"),
        ("[1]", "is no JSON object; write TOML into a file whose name ends in .toml"),
        ("{", "is not valid JSON"),
        ({"format": "esp-study", "version": 1}, "is foreign"),
    ],
)
def test_a_wrong_file_is_one_sentence(tmp_path: Path, content: object, sentence: str) -> None:
    file = written(tmp_path / "c.json", content)
    assert sentence in refused("train", "--config", file, "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("steps = ", "is not valid TOML"),
        ("mappo.gamma = inf", "sets 'mappo.gamma' to inf; write a finite number"),
        ("task.day = 2020-01-01", "sets 'task.day' to a date or time"),
        (f"[a{'.a' * 3000}]\nx = 1", "is not valid TOML: it is nested more than 64 deep"),
        ("[mapo]\n[mappo]", "has an empty section 'mapo'; did you mean 'mappo'?"),
        (f"a{'.a' * 3000} = 1", "is not valid TOML: it is nested more than 64 deep"),
    ],
)
def test_wrong_toml_is_one_sentence(tmp_path: Path, content: str, sentence: str) -> None:
    assert sentence in refused("train", "--config", written(tmp_path / "c.toml", content))


def test_a_whole_configuration_does_not_take_another_learner_task_preset_or_network(finished, tmp_path):
    for flag, value, own in (
        ("--algo", "qmix", "mappo"),
        ("--task", "formation", "navigation"),
        ("--preset", "paper", "default"),
        ("--network", "equivariant", "mlp"),
    ):
        sentence = refused("train", "--config", finished, flag, value, "--out", tmp_path / "run")
        assert f"holds every setting of a run with {flag} {own}; leave {flag} out" in sentence
    assert printed("--config", finished, "--algo", "mappo")["algorithm"] == "mappo"
    assert "No such file" in refused("train", "--config", tmp_path / "nothing")


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("mappo.lr", "mappo.learning_rate"),
        ("mappo.learing_rate", "mappo.learning_rate"),
        ("mappo.lambda", "mappo.gae_lambda"),
        ("learning_rate", "mappo.learning_rate"),
        ("mapo.learning_rate", "mappo.learning_rate"),
        ("qmix.learning_rate", "mappo.learning_rate"),
        ("prior.transform", "prior.transforms"),
        ("task.num_agent", "task.num_agents"),
    ],
)
def test_a_near_miss_is_answered_by_the_setting_that_is_meant(name: str, meant: str) -> None:
    assert refused("train", "--print-config", "--set", f"{name}=1").endswith(f"; did you mean '{meant}'?")


def test_a_name_that_is_near_to_nothing_gets_the_list() -> None:
    sentence = refused("train", "--print-config", "--set", "prior.colour=1")
    assert "did you mean" not in sentence
    assert "prior has kind, transforms" in sentence
