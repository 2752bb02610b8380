"""The PettingZoo view passes PettingZoo's own tests and says the same as the batched environment."""

import importlib
import sys

import numpy as np
import pytest
import torch

pettingzoo_test = pytest.importorskip("pettingzoo.test")

from esp_envs import make, register, task_class, task_names  # noqa: E402 - the view needs PettingZoo
from esp_envs.drawing import draw  # noqa: E402
from esp_envs.pettingzoo_view import ParallelView  # noqa: E402
from esp_envs.registry import TASKS  # noqa: E402
from tests.fenced import Fenced, Nothing  # noqa: E402
from tests.leaving import Leaving  # noqa: E402

TASKS_HERE = [task for task in task_names() if TASKS.ships(task)]
ACTIONS = [task for task in TASKS_HERE if "actions" in task_class(task).Settings.model_fields]
CASES = [*((task, {}) for task in TASKS_HERE), *((task, {"actions": "continuous"}) for task in ACTIONS)]


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


@pytest.fixture
def own(monkeypatch):
    monkeypatch.setattr(TASKS, "_registered", {})
    return register


class Away(Leaving):
    """Agents begin on the left, at the places that a test names, and arrive at x = 1."""

    starts = (0.75, 0.25, -9.0)

    def _start(self, generator):
        return {"position": torch.tensor([[x, 0.0] for x in self.starts]).expand(self.num_envs, 3, 2)}


@pytest.mark.parametrize("task", [Fenced, Nothing, Leaving, Away], ids=lambda task: task.__name__)
def test_pettingzoos_own_tests_pass_with_masks_and_with_agents_that_end(own, task) -> None:
    name = own(task)
    pettingzoo_test.parallel_seed_test(lambda: ParallelView(name, 0), num_cycles=20)
    if task is Leaving or task is Away:  # the other test takes actions without asking for masks
        pettingzoo_test.parallel_api_test(ParallelView(name, 0), num_cycles=20)


def test_an_agent_that_ends_is_terminated_once_and_then_left_out(own) -> None:
    """By hand: steps of 0.5 take the first agent to 1 in the first step, the second in the second, the third never."""
    view = ParallelView(own(Away))
    view.reset()
    lives = []
    while view.agents:
        acting = list(view.agents)
        seen, rewards, terminated, truncated, infos = view.step(dict.fromkeys(acting, 1))
        assert [*seen] == [*rewards] == [*terminated] == [*truncated] == [*infos] == acting
        lives.append([(rewards[agent], terminated[agent], truncated[agent]) for agent in acting])
    on, arrives, cut = (-0.1, False, False), (0.9, True, False), (-0.1, False, True)
    assert lives[0] == [pytest.approx(row) for row in (arrives, on, on)]
    assert lives[1] == [pytest.approx(row) for row in (arrives, on)]
    assert lives[2:] == [[pytest.approx(row)] for row in (on, on, on, cut)]
    assert set(view.reset()[0]) == set(view.possible_agents), "all are back in the next episode"


def test_an_agent_that_arrives_with_the_last_step_has_ended_and_the_others_are_cut(own) -> None:
    view = ParallelView(own(type("Late", (Away,), {"starts": (0.75, -9.0, -9.0)})), horizon=1)
    view.reset()
    _, _, terminated, truncated, _ = view.step(dict.fromkeys(view.agents, 1))
    assert [*terminated.values()] == [True, False, False]
    assert [*truncated.values()] == [False, True, True]
    assert view.agents == []


def test_infos_hold_the_allowed_actions(own) -> None:
    name = own(Fenced)
    view, env = ParallelView(name, 3), make(name, 1, [3])
    for seed, agent in enumerate(view.possible_agents):  # else a rare end at the middle forbids nothing
        view.action_space(agent).seed(seed)
    _, infos = view.reset()
    observation = env.reset()
    for _ in range(env.spec.horizon):
        for i, agent in enumerate(view.agents):
            mask = infos[agent]["action_mask"]
            assert mask.dtype == np.int8
            np.testing.assert_array_equal(mask, observation.action_mask[0, 0, i].numpy())
        joint = {agent: view.action_space(agent).sample(infos[agent]["action_mask"]) for agent in view.agents}
        *_, infos = view.step(joint)  # the task raises where an action is forbidden
        step = env.step(torch.tensor([[list(joint.values())]]))
        observation = step.reached
    assert "spread" in infos["agent_0"]
    assert not bool(observation.action_mask.all()), "some are forbidden"


def test_resetting_with_a_seed_repeats_the_episode() -> None:
    view = ParallelView("navigation", 0)
    first, _ = view.reset(seed=5)
    view.step(dict.fromkeys(view.agents, 1))
    again, _ = view.reset(seed=5)
    other, _ = view.reset()
    np.testing.assert_array_equal(first["agent_0"], again["agent_0"])
    assert not np.array_equal(first["agent_0"], other["agent_0"])


INTEGERS = [np.int64, np.int32, np.uint8, np.array, lambda k: np.array([k])]
KINDS = [*(("discrete", int, kind) for kind in INTEGERS), *(("continuous", np.float32, k) for k in (np.float16, list))]


@pytest.mark.parametrize(("actions", "usual", "kind"), KINDS)
def test_numbers_of_every_kind_are_one_action(actions: str, usual, kind) -> None:
    seen = []
    for make_action in (usual, kind):
        view = ParallelView("navigation", 0, actions=actions)
        view.reset(seed=1)
        given = {agent: [0.5, -1.0] if actions == "continuous" else k + 1 for k, agent in enumerate(view.agents)}
        seen.append(view.step({agent: make_action(action) for agent, action in given.items()})[0]["agent_0"])
    np.testing.assert_array_equal(*seen)


@pytest.mark.parametrize(
    ("actions", "action", "text"),
    [
        ("discrete", 5, r"agent_1's action 5 is not in Discrete\(5\); give one from there"),
        ("discrete", -1, "action -1 is not in"),
        ("discrete", 1.0, "action 1.0 is not in"),
        ("discrete", True, "action True is not in"),
        ("discrete", None, "action None is not in"),
        ("discrete", [1, 2], r"action \[1, 2\] is not in"),
        ("continuous", [0.5], r"is not in Box\(-1.0, 1.0, \(2,\), float32\)"),
        ("continuous", 1, "action 1 is not in"),
        ("continuous", [[1], [2, 3]], "is not in Box"),
        ("continuous", [0.5, 1.5], "is not in Box"),
        ("continuous", [0.5, float("nan")], "is not in Box"),
        ("continuous", ["a", "b"], "is not in Box"),
        ("continuous", np.array([-128, 0], np.int8), "is not in Box"),
    ],
)
def test_a_wrong_shape_or_value_says_which(actions: str, action: object, text: str) -> None:
    view = ParallelView("navigation", 0, actions=actions)
    view.reset()
    good = view.action_space("agent_0").sample()
    with pytest.raises(ValueError, match=text):
        view.step({"agent_0": good, "agent_1": action, "agent_2": good})
    with pytest.raises(ValueError, match="agent_2 is missing"):
        view.step({"agent_0": good, "agent_1": good})
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


def test_the_last_picture_is_of_how_the_episode_ended() -> None:
    view = ParallelView("navigation", 0, render_mode="rgb_array", horizon=1)
    view.reset()
    view.step(dict.fromkeys(view.agents, 1))
    last = view.render()
    shown = make("navigation", 1, [0])
    shown.reset()
    shown.set_state(torch.from_numpy(view.state()).view(1, 1, -1))
    assert last is not None
    assert np.array_equal(last, draw(shown.scene()))
    view.reset()
    assert not np.array_equal(last, view.render())


def test_pictures_change_no_episode() -> None:
    """Formation draws the noise of its sensors when it is put into a state."""

    def seen(render_mode: str | None) -> tuple[np.ndarray, np.ndarray]:
        view = ParallelView("formation", 0, render_mode=render_mode, horizon=2, sensor_noise_m=0.01)
        still = dict.fromkeys(view.possible_agents, np.zeros(2, np.float32))
        view.reset()
        for _ in range(2):
            view.step(still)
        first, _ = view.reset()
        second, *_ = view.step(still)
        return first["agent_0"], second["agent_0"]

    for without, drawn in zip(seen(None), seen("rgb_array"), strict=True):
        np.testing.assert_array_equal(without, drawn)


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
