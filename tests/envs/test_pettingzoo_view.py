"""The PettingZoo view passes PettingZoo's own tests and says the same as the batched environment."""

from __future__ import annotations

import importlib
import sys

import numpy as np
import pytest

pettingzoo_test = pytest.importorskip("pettingzoo.test")

from esp_envs import make, task_class, task_names  # noqa: E402 - the view needs PettingZoo
from esp_envs.pettingzoo_view import ParallelView  # noqa: E402

ACTIONS = [task for task in task_names() if "actions" in task_class(task).Settings.model_fields]
CASES = [*((task, {}) for task in task_names()), *((task, {"actions": "continuous"}) for task in ACTIONS)]


@pytest.mark.parametrize(("task", "settings"), CASES)
def test_pettingzoos_own_tests_pass(task: str, settings: dict[str, object]) -> None:
    pettingzoo_test.parallel_api_test(ParallelView(task, 0, **settings), num_cycles=60)
    pettingzoo_test.parallel_seed_test(lambda: ParallelView(task, 0, **settings), num_cycles=60)


@pytest.mark.parametrize(("task", "settings"), CASES)
def test_the_view_is_the_environment(task: str, settings: dict[str, object]) -> None:
    view, env = ParallelView(task, 3, **settings), make(task, 1, [3], settings)
    seen, infos = view.reset()
    observation = env.reset()
    assert infos == {agent: {} for agent in view.agents}
    for t in range(env.spec.horizon):
        for i, agent in enumerate(view.agents):
            np.testing.assert_array_equal(seen[agent], observation.obs[0, 0, i].numpy())
            assert view.observation_space(agent).contains(seen[agent])
        np.testing.assert_array_equal(view.state(), observation.state[0, 0].numpy())
        action = env.heuristic()
        step = env.step(action)
        joint = {agent: action[0, 0, i].numpy() for i, agent in enumerate(view.agents)}
        seen, rewards, terminations, truncations, infos = view.step(joint)
        assert list(rewards.values()) == step.reward[0, 0].tolist()
        assert set(terminations.values()) == {bool(step.terminated)}
        assert env.spec.terminates or not step.terminated
        assert all(truncations.values()) == (t == env.spec.horizon - 1 and not step.terminated)
        assert infos["agent_0"].keys() == step.metrics.keys()
        observation = step.next if step.final is None else step.final
        if step.terminated:
            break
    assert view.agents == []
    np.testing.assert_array_equal(view.state(), observation.state[0, 0].numpy())
    assert view.step({}) == ({}, {}, {}, {}, {})


def test_resetting_with_a_seed_repeats_the_episode() -> None:
    view = ParallelView("navigation", 0)
    first, _ = view.reset(seed=5)
    view.step(dict.fromkeys(view.agents, 1))
    again, _ = view.reset(seed=5)
    other, _ = view.reset()
    np.testing.assert_array_equal(first["agent_0"], again["agent_0"])
    assert not np.array_equal(first["agent_0"], other["agent_0"])


def test_wrong_actions_are_refused() -> None:
    view = ParallelView("navigation", 0)
    view.reset()
    with pytest.raises(ValueError, match="agent_2 is missing"):
        view.step({"agent_0": 0, "agent_1": 0})
    with pytest.raises(ValueError, match="agent_1's action 5"):
        view.step({"agent_0": 0, "agent_1": 5, "agent_2": 0})


@pytest.mark.parametrize("kind", [int, np.int64, np.int32, np.uint8, np.array, lambda k: np.array([k])])
def test_integers_of_every_kind_are_one_action(kind) -> None:
    seen = []
    for make_action in (int, kind):
        view = ParallelView("navigation", 0)
        view.reset(seed=1)
        seen.append(view.step({agent: make_action(k + 1) for k, agent in enumerate(view.agents)})[0]["agent_0"])
    np.testing.assert_array_equal(*seen)


@pytest.mark.parametrize("kind", [np.float64, np.float16, list])
def test_numbers_of_every_width_are_one_action(kind) -> None:
    seen = []
    for make_action in (np.float32, kind):
        view = ParallelView("navigation", 0, actions="continuous")
        view.reset(seed=1)
        step = view.step({agent: make_action([0.5, -1.0]) for agent in view.agents})
        seen.append(step[0]["agent_0"])
    np.testing.assert_array_equal(*seen)


@pytest.mark.parametrize(
    ("actions", "action", "text"),
    [
        ("discrete", 5, "agent_1's action 5 is not an integer from 0 to 4"),
        ("discrete", -1, "action -1 is not an integer"),
        ("discrete", 1.0, "action 1.0 is not an integer"),
        ("discrete", True, "action True is not an integer"),
        ("discrete", None, "action None is not an integer"),
        ("discrete", [1, 2], r"agent_1's action has shape \(2,\); give one integer"),
        ("continuous", [0.5], r"has shape \(1,\); give an array of shape \(2,\)"),
        ("continuous", 1, r"has shape \(\); give an array of shape \(2,\)"),
        ("continuous", [[1], [2, 3]], r"has shape \(0,\); give an array of shape \(2,\)"),
        ("continuous", [0.5, 1.5], "is not within -1 and 1"),
        ("continuous", [0.5, float("nan")], "is not within -1 and 1"),
        ("continuous", ["a", "b"], "is not within -1 and 1"),
        ("continuous", np.array([-128, 0], np.int8), "is not within -1 and 1"),
    ],
)
def test_a_wrong_shape_or_value_says_which(actions: str, action: object, text: str) -> None:
    view = ParallelView("navigation", 0, actions=actions)
    view.reset()
    good = view.action_space("agent_0").sample()
    with pytest.raises(ValueError, match=text):
        view.step({"agent_0": good, "agent_1": action, "agent_2": good})
    view.step({"agent_0": good, "agent_1": good, "agent_2": good})  # the refused step did not happen


def test_it_renders_when_asked() -> None:
    view = ParallelView("predator-prey", 0, render_mode="rgb_array")
    view.reset()
    picture = view.render()
    assert picture is not None
    assert picture.shape == (320, 320, 3)
    assert ParallelView("predator-prey", 0).render() is None
    with pytest.raises(ValueError, match="render mode 'human'"):
        ParallelView("predator-prey", 0, render_mode="human")


def test_unknown_tasks_and_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown task"):
        ParallelView("tag")
    with pytest.raises(ValueError, match="colour"):
        ParallelView("navigation", colour="red")


def test_a_missing_package_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "esp_envs.pettingzoo_view")
    monkeypatch.setitem(sys.modules, "pettingzoo", None)
    with pytest.raises(ImportError, match=r"pip install 'gymnasium>=[\d.]+' 'pettingzoo>=[\d.]+'"):
        importlib.import_module("esp_envs.pettingzoo_view")


def test_observations_are_the_callers_own_float32() -> None:
    view = ParallelView("navigation", 0, actions="continuous")
    first, _ = view.reset()
    first["agent_0"].fill(7)
    seen, *_ = view.step({agent: np.zeros(2, np.float32) for agent in view.agents})
    assert seen["agent_0"].dtype == np.float32
    assert not (seen["agent_0"] == 7).any()
    view.state().fill(7)
    assert not (view.state() == 7).any()
