"""Policies for other programs: numpy in and out, shape errors in a sentence, memory in the caller's hands."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import esp_cli
from esp_cli.policies.loaded import LoadedPolicy
from esp_cli.training.build import build_environment
from tests.export.policies import drawn_policy, write_policy


def test_importing_the_package_imports_no_torch() -> None:
    code = "import esp_cli, sys; print({'torch', 'numpy', 'typer'} & set(sys.modules), esp_cli.__version__)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == f"set() {esp_cli.__version__}\n"
    assert esp_cli.load_policy.__module__ == "esp_cli.policies.loaded"
    with pytest.raises(AttributeError, match="no attribute 'load_polici'"):
        _ = esp_cli.load_polici  # type: ignore[attr-defined]


@torch.no_grad()
@pytest.mark.parametrize("kind", ["choice", "wheels", "values, recurrent"])
def test_it_acts_as_the_policy_does(kind: str) -> None:
    trained = drawn_policy(kind, seeds=(3, 7))
    policy = LoadedPolicy(trained, 7)
    env = build_environment(trained.config, 2, "test")
    observation = env.reset()
    memory = trained.policy.initial_memory(2, observation.obs)
    carried = policy.initial_memory(2, env.spec.num_agents)
    for _ in range(10):
        action, memory = trained.policy.act(observation.obs, memory)
        mine, carried = policy.step(observation.obs[1].numpy(), carried)
        assert mine.shape == action[1].shape
        assert mine.dtype == (np.int64 if action.dtype == torch.int64 else np.float32)
        assert np.allclose(mine, action[1].numpy(), atol=1e-6)
        observation = env.step(action).next


@pytest.mark.parametrize(("kind", "width"), [("choice", ()), ("wheels", (2,))])
@pytest.mark.parametrize("lead", [(), (3,), (2, 3), (0,)])
def test_any_leading_axes_will_do(kind: str, width: tuple[int, ...], lead: tuple[int, ...]) -> None:
    policy = LoadedPolicy(drawn_policy(kind))
    obs = np.random.default_rng(0).standard_normal((*lead, policy.spec.observation.width))
    action = policy.act(obs)
    assert action.shape == (*lead, *width)
    assert np.array_equal(policy.act(obs.tolist()) if 0 not in lead else action, action)


def test_drawn_actions_follow_their_generator() -> None:
    policy = LoadedPolicy(drawn_policy("choice"))
    obs = np.zeros((500, 14))
    drawn = [policy.act(obs, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert np.array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], drawn[2])
    assert len(np.unique(policy.act(obs))) == 1
    with pytest.raises(ValueError, match="rng is 3; give a generator"):
        policy.act(obs, 3)


@pytest.mark.parametrize(
    ("obs", "sentence"),
    [
        (np.zeros((3, 7)), r"the observation has shape \(3, 7\), but formation needs \(\.\.\., 8\): heading 2"),
        (np.zeros(()), r"the observation has shape \(\)"),
        (0.5, r"the observation has shape \(\)"),
        ([[1.0, 2.0], [3.0]], "the observation is not an array of real numbers"),
        ("left", "the observation is not an array of real numbers"),
        (np.full((1, 8), "1"), "the observation is not an array of real numbers"),
        (np.ones((1, 8), complex), "the observation is not an array of real numbers"),
        (None, "the observation"),
        (np.full((2, 8), np.nan), r"the observation holds nan at \(0, 0\); give finite numbers"),
        (np.where(np.arange(16).reshape(2, 8) == 11, np.inf, 0), r"holds inf at \(1, 3\)"),
    ],
)
def test_what_is_no_observation_is_told_in_one_sentence(obs: object, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence) as caught:
        LoadedPolicy(drawn_policy("wheels")).act(obs)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_memory_is_the_callers() -> None:
    policy = LoadedPolicy(drawn_policy("choice, recurrent"))
    obs, memory = np.ones((3, 14), np.float32), policy.initial_memory(3)
    assert memory.shape == (3, policy.memory_width) == (3, 10)
    with pytest.raises(ValueError, match=r"is recurrent; begin an episode with memory = policy\.initial_memory"):
        policy.act(obs)
    _, after = policy.step(obs, memory)
    assert not memory.any()
    assert after.any()
    again = policy.step(obs, memory)[1]
    assert np.array_equal(after, again), "the policy itself keeps nothing"
    assert not np.array_equal(policy.step(obs, after)[1], after)
    for wrong, sentence in (
        (np.zeros((2, 10)), r"the memory has shape \(2, 10\), but observations of shape \(3, 14\) need \(3, 10\)"),
        (np.zeros((3, 9)), r"the memory has shape \(3, 9\)"),
        (np.full((3, 10), np.inf), "the memory holds inf"),
    ):
        with pytest.raises(ValueError, match=sentence):
            policy.step(obs, wrong)


def test_a_file_of_several_seeds_gives_the_one_that_is_asked_for(tmp_path: Path) -> None:
    file = write_policy(drawn_policy("wheels", seeds=(3, 7)), tmp_path / "policy.safetensors")
    obs = np.ones((2, 8))
    actions = {seed: esp_cli.load_policy(file, seed=seed).act(obs) for seed in (None, 3, 7)}
    assert np.array_equal(actions[None], actions[3])
    assert not np.array_equal(actions[7], actions[3])
    with pytest.raises(ValueError, match="has no seed 4; it has 3, 7"):
        esp_cli.load_policy(file, seed=4)
    with pytest.raises(ValueError, match="does not exist"):
        esp_cli.load_policy(tmp_path / "nothing")


def test_products_are_in_float32_whatever_the_training_took(tmp_path: Path) -> None:
    trained = drawn_policy("choice")
    network = trained.config.network.model_copy(update={"precision": "bfloat16"})
    policy = LoadedPolicy(trained)
    trained.policy.actor.precision = torch.bfloat16  # type: ignore[assignment]
    coarse = trained.config.model_copy(update={"network": network})
    again = LoadedPolicy(type(trained)(coarse, trained.policy, trained.spec, 1, tmp_path))
    assert again.trained.config.network.precision == "float32"
    obs = np.random.default_rng(0).standard_normal((300, 14))
    assert np.array_equal(again.act(obs), policy.act(obs))
