"""A policy whose weights know no number of agents acts with any: evaluated, drawn, loaded and trained on."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from esp_cli import discrete_moves, load_policy
from esp_cli.algorithms.presets import ALGORITHMS
from esp_cli.algorithms.roles import new_policy
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.training.build import generators
from esp_cli.training.config import resolve_config
from esp_envs import Field, Kind, UserError, layout
from esp_envs.roles import Role, spec_with_roles
from esp_envs.spec import TaskSpec
from tests.cli.running import esp, refused, train_tiny

SETS = ("--network", "set", "--set", "mappo.critic_input=state", "--set", "network.width=4")


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train_tiny(tmp_path_factory.mktemp("sets") / "three", *SETS, "--seeds", 2)


@pytest.fixture(scope="module")
def perceptron(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train_tiny(tmp_path_factory.mktemp("sets") / "perceptron")


def test_it_is_evaluated_and_drawn_with_other_numbers(three: Path, tmp_path: Path) -> None:
    many = ("--set", "task.num_agents=5", "--set", "task.num_landmarks=4")
    result = json.loads(esp("eval", three, "--episodes", 2, *many, "--json", "-").stdout)
    assert result["task_settings"]["num_agents"] == 5
    assert len(result["greedy"]["per_seed"]) == 2
    esp("render", three, "--out", tmp_path / "five.png", *many)
    assert (tmp_path / "five.png").stat().st_size > 1000


def test_loaded_it_acts_on_any_number_and_as_it_was_trained_on_the_first(three: Path) -> None:
    one, many = load_policy(three), load_policy(three, settings={"num_agents": 7})
    assert (one.spec.num_agents, many.spec.num_agents) == (3, 7)
    rows = np.random.default_rng(0).normal(size=(7, many.spec.observation.width))
    assert many.act(rows).shape == (7,)
    before, after = (policy.trained.policy.state_dict() for policy in (one, many))
    assert all(torch.equal(tensor, after[name]) for name, tensor in before.items())
    with pytest.raises(UserError, match=r"needs \(\.\.\., 14\)"):
        one.act(rows)


def test_an_equivariant_policy_acts_where_its_symmetry_is_not_declared(tmp_path: Path, monkeypatch) -> None:
    trained = TrainedPolicy.read(train_tiny(tmp_path / "run", "--network", "equivariant"))
    monkeypatch.setattr("esp_cli.policies.loading.spec_of", lambda _: replace(trained.spec, symmetry="c1"))
    windy = trained.transfer({"wind": 0.3})
    assert (windy.spec.symmetry, windy.policy) == ("c1", trained.policy)


def test_a_run_with_another_number_starts_from_actor_critic_and_statistics(three: Path, tmp_path: Path) -> None:
    still = ("--set", "mappo.learning_rate=1e-12", "--set", "mappo.value_decay=0.999999")
    run = train_tiny(
        tmp_path / "five", *SETS, "--seeds", 2, "--set", "task.num_agents=5", *still, "--init-from", three, steps=50
    )
    first, then = (TrainedPolicy.read(path) for path in (three, run))
    for name, tensor in first.policy.state_dict().items():
        torch.testing.assert_close(then.policy.state_dict()[name], tensor)
    critic = [name for name in first.further if name.startswith("critic.")]
    assert critic
    for name in critic:
        torch.testing.assert_close(then.further[name], first.further[name])
    fresh = train_tiny(tmp_path / "fresh", *SETS, "--seeds", 2, "--set", "task.num_agents=5", *still, steps=50)
    assert any(not torch.equal(TrainedPolicy.read(fresh).further[name], first.further[name]) for name in critic)


def test_a_critic_that_does_not_fit_is_left_out(three: Path, tmp_path: Path) -> None:
    others = ("--network", "set", "--set", "mappo.critic_input=own", "--set", "network.width=4")
    still = ("--set", "mappo.learning_rate=1e-12")
    run = train_tiny(tmp_path / "own", *others, *still, "--seeds", 2, "--init-from", three, steps=50)
    first, then = (TrainedPolicy.read(path) for path in (three, run))
    for name, tensor in first.policy.state_dict().items():
        torch.testing.assert_close(then.policy.state_dict()[name], tensor)


def test_a_network_with_a_count_says_so(perceptron: Path, tmp_path: Path) -> None:
    sentence = refused("eval", perceptron, "--set", "task.num_agents=5")
    assert sentence.endswith("the weights of its network are made for a number of agents, of set for any")
    assert "there but" in refused(
        "train",
        "--network",
        "mlp",
        "--set",
        "task.num_agents=5",
        "--set",
        "network.hidden=[8]",
        "--init-from",
        perceptron,
    )


def test_other_things_are_still_refused(three: Path) -> None:
    assert "with other action than" in refused("eval", three, "--set", "task.actions=continuous")
    assert refused("eval", three, "--set", "task.num_agents=1").endswith(
        "was trained with other agents than the task has with task.num_agents changed; "
        "weights for others are missing where none are seen, so keep one or more, or none"
    )


def two_roles(hunters: int, prey: int, seen: str = "position") -> TaskSpec:
    own, moves = layout(Field(seen, Kind.VECTOR)), discrete_moves(4)
    numbers = {"hunter": hunters, "prey": prey}
    roles = [Role(name=name, num_agents=count, observation=own, action=moves) for name, count in numbers.items()]
    return spec_with_roles(roles, name="two", version=1, convention="none", horizon=5, symmetry="c1")


@pytest.fixture
def opposed() -> TrainedPolicy:
    """Hunters that always take the first action and prey that takes the third, of a task of two and one."""
    config, spec = resolve_config("navigation", overrides={"network.name": "mlp"}), two_roles(2, 1)
    policy = new_policy(ALGORITHMS["mappo"], spec, config.network, generators(config.seeds, "shape"))
    for role, action in (("hunter", 0), ("prey", 2)):
        weights = policy.of(role).actor.state_dict()
        for tensor in weights.values():
            tensor.zero_()
        [*weights.values()][-1][..., action] = 1
    return TrainedPolicy(config, policy, spec, 0, Path("run"))


@pytest.mark.parametrize(("hunters", "prey"), [(2, 1), (1, 2), (3, 1), (2, 3)])
def test_each_role_acts_for_its_own_agents(opposed: TrainedPolicy, monkeypatch, hunters: int, prey: int) -> None:
    monkeypatch.setattr("esp_cli.policies.loading.spec_of", lambda _: two_roles(hunters, prey))
    policy, rows = opposed.transfer({"horizon": 5}).policy, torch.zeros(1, 1, hunters + prey, 2)
    action, _ = policy.act(rows, policy.initial_memory(1, rows))
    assert action.flatten().tolist() == [0] * hunters + [2] * prey


def test_a_role_that_sees_or_is_something_else_is_refused(opposed: TrainedPolicy, monkeypatch) -> None:
    for spec, part in ((two_roles(2, 1, "velocity"), "observation"), (two_roles(2, 1).roles[0], "roles")):
        monkeypatch.setattr("esp_cli.policies.loading.spec_of", lambda _, spec=spec: spec)
        with pytest.raises(UserError, match=f"run was trained with other {part} than"):
            opposed.transfer({"horizon": 5})


def test_roles_over_sets_are_evaluated_with_other_numbers(tmp_path: Path) -> None:
    both = ("--task", "predator-prey", "--set", "task.control=both", "--network", "set", "--set", "network.width=4")
    run = train_tiny(tmp_path / "both", *both, steps=50)
    result = json.loads(esp("eval", run, "--episodes", 2, "--set", "task.num_predators=5", "--json", "-").stdout)
    assert result["task_settings"]["num_predators"] == 5
    assert "weights for others are missing" in refused("eval", run, "--set", "task.num_predators=1")
