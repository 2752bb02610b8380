"""`esp train` with `--config`, `--print-config` and `--init-from`: what files say, and what wins."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from esp_cli.training.checkpoint import load_checkpoint
from esp_cli.training.config import RunConfig
from esp_cli.training.config_file import read_config_file
from esp_cli.training.loading import parse_config
from esp_cli.training.run_folder import RUN_FORMAT, RunFolder
from esp_envs.policy_format import POLICY_FORMAT
from tests.cli.running import STEPS, TINY_OPTIONS, esp, refused, train_tiny


def printed(*options: object) -> dict[str, Any]:
    """Return the configuration that a command line resolves to."""
    return json.loads(esp("train", "--print-config", *options).stdout)


def written(path: Path, content: object) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_a_run_is_configured_again_from_its_folder_and_from_its_file(finished: Path) -> None:
    stored = json.loads((finished / "config.json").read_text())
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
    whole = written(tmp_path / "c.json", printed("--task", "formation", "--steps", "20k"))
    auto = printed("--config", whole, "--prior", "auto")["prior"]
    assert (auto["trust"], auto["fade"], auto["transforms"]) == ("measured", 0.5, "d4")
    assert printed("--config", whole, "--prior", "auto", "--set", "prior.fade=0.2")["prior"]["fade"] == 0.2


def test_weights_of_elements_are_a_value_in_a_small_file(tmp_path: Path) -> None:
    prior = {"transforms": "rot90,rot180", "trust": "measured", "weights": {"rot90": 0.5, "rot180": 1.0}}
    small = written(tmp_path / "c.json", {"task": "navigation", "prior": prior})
    assert printed("--config", small)["prior"]["weights"] == prior["weights"]


def test_printing_makes_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    printed("--out", "here")
    assert list(tmp_path.iterdir()) == []


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
        ({"task": ["navigation"]}, "sets 'task' to ['navigation']"),
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
    ],
)
def test_wrong_toml_is_one_sentence(tmp_path: Path, content: str, sentence: str) -> None:
    assert sentence in refused("train", "--config", written(tmp_path / "c.toml", content))


def test_a_whole_configuration_does_not_take_another_learner_task_or_preset(finished: Path, tmp_path: Path) -> None:
    for flag, value, own in (
        ("--algo", "qmix", "mappo"),
        ("--task", "formation", "navigation"),
        ("--preset", "paper", "default"),
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


def policy_of(run: Path) -> dict[str, torch.Tensor]:
    return load_checkpoint(run / "policy.safetensors", format_name=POLICY_FORMAT)[0]


@pytest.mark.parametrize("algorithm", ["mappo", "maddpg", "qmix"])
def test_a_run_starts_from_another_policy(tmp_path: Path, algorithm: str) -> None:
    small = ["--algo", algorithm, "--set", "network.hidden=[8]", "--set", "evaluation.episodes=2", "--steps", "200"]
    esp("train", *small, "--out", tmp_path / "first", "--set", f"{algorithm}.num_envs=2")
    rest = ["--seed-list", "3,7", "--set", f"{algorithm}.learning_rate=1e-9", "--set", f"{algorithm}.num_envs=2"]
    rest += ["--set", f"{algorithm}.actor_learning_rate=1e-9"] if algorithm == "maddpg" else []
    esp("train", *small, *rest, "--out", tmp_path / "second", "--init-from", tmp_path / "first")
    first, second = policy_of(tmp_path / "first"), policy_of(tmp_path / "second")
    for name, tensor in second.items():
        assert torch.allclose(tensor, first[name].expand_as(tensor), atol=1e-6), "it hardly learned since"
    esp("train", *small, *rest, "--out", tmp_path / "third")
    assert any(not torch.allclose(t, second[n], atol=1e-3) for n, t in policy_of(tmp_path / "third").items())
    config = parse_config(RunFolder.open(tmp_path / "second").config, tmp_path)
    assert config.init_from is not None
    assert config.init_from.source == str(tmp_path / "first")
    assert f"--init-from {tmp_path / 'first'}" in config.command()


def test_a_run_resumes_without_the_policy_that_it_started_from(finished: Path, copied: Path, tmp_path: Path) -> None:
    options = [*TINY_OPTIONS, *STEPS, "--seed-list", "3,7", "--init-from"]
    esp("train", *options, finished, "--out", tmp_path / "whole")
    esp("train", *options, copied / "policy.safetensors", "--out", tmp_path / "cut")
    for file in [*(tmp_path / "cut" / "checkpoints").iterdir(), copied / "policy.safetensors"]:
        file.unlink()  # as if killed before the first checkpoint, and the other policy is gone
    (tmp_path / "cut" / "policy.safetensors").unlink()
    esp("train", "--resume", tmp_path / "cut")
    weights = [policy_of(tmp_path / name) for name in ("whole", "cut")]
    assert all(torch.equal(tensor, weights[1][name]) for name, tensor in weights[0].items())
    initial = tmp_path / "cut" / "initial-policy.safetensors"
    initial.write_bytes((tmp_path / "whole" / "policy.safetensors").read_bytes())
    for file in (tmp_path / "cut" / "checkpoints").iterdir():
        file.unlink()
    assert "does not hold the policy that the run started from" in refused("train", "--resume", tmp_path / "cut")


def test_a_policy_that_does_not_fit_is_one_sentence_and_leaves_no_folder(finished: Path, tmp_path: Path) -> None:
    out = ["--out", tmp_path / "run", "--init-from"]
    wider = refused("train", "--seeds", 2, "--set", "network.hidden=[9]", *out, finished)
    assert "is [1, 8] there but [1, 9] in this run; choose the task settings and the network" in wider
    other = refused("train", "--algo", "qmix", "--set", "network.hidden=[9]", "--seeds", 2, *out, finished)
    assert "it is a policy of mappo on navigation with the network mlp, and 'head.epsilon' is missing there" in other
    assert other.endswith("choose the algorithm, the task settings and the network of that policy")
    seeds = refused("train", *TINY_OPTIONS, "--seeds", 3, *out, finished)
    assert seeds.endswith("which holds 2; train 2 seeds, or start from a policy of one seed")
    assert "does not exist" in refused("train", *TINY_OPTIONS, *out, tmp_path / "nothing")
    assert not (tmp_path / "run").exists()


def test_a_configuration_of_a_started_run_starts_there_again(finished: Path, tmp_path: Path) -> None:
    run = train_tiny(tmp_path / "run", "--seed-list", "3,7", "--init-from", finished, steps=50)
    assert read_config_file(run).choices["init_from"] == str(finished)
    assert printed("--config", run) == json.loads((run / "config.json").read_text())


def test_a_configuration_names_the_policy_that_it_started_from_where_that_is_gone(copied: Path, tmp_path: Path) -> None:
    run = train_tiny(tmp_path / "run", "--seed-list", "3,7", "--init-from", copied, steps=50)
    shutil.rmtree(copied)
    assert refused("train", "--config", run, "--print-config") == (
        f"the run of {run} started from the policy {copied}, which cannot be read here; add --init-from POLICY"
    )


def test_a_configuration_without_the_new_key_is_read_as_before(finished: Path) -> None:
    stored = RUN_FORMAT.read(finished / "config.json")
    del stored["init_from"]
    assert parse_config(stored, finished) == parse_config(RUN_FORMAT.read(finished / "config.json"), finished)
    assert RunConfig.model_fields["init_from"].default is None
