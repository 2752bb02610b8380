"""`esp train --init-from`, and `--config` of runs that started from a policy: which weights, and what does not fit."""

import shutil
from pathlib import Path

import pytest
import torch

from esp_cli.training.checkpoint import POLICY_FORMAT, load_checkpoint
from esp_cli.training.run_folder import RunFolder
from esp_cli.training.settings import parse_config, read_config_file
from tests.cli.running import STEPS, TINY_OPTIONS, esp, printed, refused, stored_config, train_tiny


def initial_of(run: Path) -> dict[str, torch.Tensor]:
    return load_checkpoint(run / "initial-policy.safetensors", format_name=POLICY_FORMAT)[0]


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
    options = ["--network", "mlp", *TINY_OPTIONS, *STEPS, "--seed-list", "3,7", "--init-from"]
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
    for file in (*(tmp_path / "cut" / "checkpoints").iterdir(), tmp_path / "cut" / "policy.safetensors"):
        file.unlink()
    assert "does not hold the policy that the run started from" in refused("train", "--resume", tmp_path / "cut")


def test_what_a_user_has_to_know_of_the_policy_is_said(copied: Path, tmp_path: Path) -> None:
    (newest,) = (copied / "checkpoints").iterdir()
    newest.write_bytes(newest.read_bytes()[:-5])
    words = ["train", "--print-config", *TINY_OPTIONS, "--network", "mlp", "--seeds", 2, "--init-from", copied]
    assert f"taking {copied / 'policy.safetensors'}" in esp(*words).stderr


def test_a_policy_that_does_not_fit_is_one_sentence_and_leaves_no_folder(finished: Path, tmp_path: Path) -> None:
    out = ["--network", "mlp", "--out", tmp_path / "run", "--init-from"]
    wider = refused("train", "--seeds", 2, "--set", "network.hidden=[9]", *out, finished)
    assert "is [1, 8] there but [1, 9] in this run; choose the task settings and the network" in wider
    other = refused("train", "--algo", "qmix", "--set", "network.hidden=[9]", "--seeds", 2, *out, finished)
    assert "it is a policy of mappo on navigation with the network mlp, and 'head.epsilon' is missing there" in other
    assert other.endswith("choose the algorithm, the task settings and the network of that policy (--network mlp)")
    seeds = refused("train", *TINY_OPTIONS, "--seeds", 3, *out, finished)
    assert "which holds 2; train 2 seeds, or start from a policy of one seed" in seeds
    assert "does not exist" in refused("train", *TINY_OPTIONS, *out, tmp_path / "nothing")
    assert not (tmp_path / "run").exists()


def test_a_configuration_of_a_started_run_starts_there_again(finished: Path, tmp_path: Path) -> None:
    run = train_tiny(tmp_path / "run", "--seed-list", "3,7", "--init-from", finished, steps=50)
    assert read_config_file(run).choices["init_from"] == str(finished)
    assert printed("--config", run) == stored_config(run)


def test_a_run_is_not_repeated_from_other_weights_unless_that_is_asked_for(copied: Path, tmp_path: Path) -> None:
    run = train_tiny(tmp_path / "run", "--seed-list", "3,7", "--init-from", copied, steps=50)
    before = stored_config(run)["init_from"]
    shutil.rmtree(copied)
    assert "does not exist" in refused("train", "--config", run, "--print-config")
    train_tiny(copied, "--seed-list", "3,7", "--set", "mappo.learning_rate=0.05")
    assert refused("train", "--config", run, "--print-config") == (
        f"{copied} holds other weights than the run of {run} started from; add --init-from POLICY"
    )
    now = printed("--config", run, "--init-from", copied)["init_from"]
    assert now["source"] == before["source"]
    assert now["sha256"] != before["sha256"]


def test_a_policy_of_another_algorithm_starts_a_run_where_it_fits(tmp_path: Path) -> None:
    small = ["--network", "mlp", "--set", "network.hidden=[8]", "--set", "evaluation.episodes=2", "--steps", 100]
    esp("train", "--algo", "maddpg", *small, "--set", "maddpg.num_envs=2", "--out", tmp_path / "first")
    found = printed("--algo", "qmix", *small, "--init-from", tmp_path / "first")
    assert found["init_from"]["source"] == str(tmp_path / "first")
