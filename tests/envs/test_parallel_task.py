"""PettingZoo and Gymnasium environments as tasks: a small one of our own, and the real packages."""

import gc
import os
import signal
import threading
from pathlib import Path

import numpy as np
import pytest
import torch

from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config
from esp_envs import Continuous, Environment, Field, Kind, UserError, generators_for, layout, make, register
from esp_envs.adapters.pettingzoo import ParallelSettings, ParallelTask
from esp_envs.conformance import Subject, check
from esp_envs.promises import same_step
from esp_envs.registry import TASKS
from esp_envs.spec import Discrete
from tests.own_tasks import lines_of, page_files, save_page_files

LIKE_GYMNASIUM = pytest.importorskip("gymnasium", reason="spaces come from the extra 'pettingzoo'")
spaces = LIKE_GYMNASIUM.spaces


class Walk:
    """Two walkers and a ghost on a line; what chance does follows from the seed."""

    def __init__(self, length: int = 6, box: bool = False) -> None:
        self.possible_agents = ["walker_0", "walker_1", "ghost"]
        self.length, self.box = length, box

    def action_space(self, agent):
        return spaces.Box(np.float32([0.0]), np.float32([10.0])) if self.box else spaces.Discrete(3)

    def reset(self, seed=None, options=None):
        self.rng = np.random.default_rng(seed)
        self.places, self.time = self.rng.normal(size=3), 0
        return self._seen(), {}

    def step(self, actions):
        self.time += 1
        moves = [float(np.ravel(actions[name])[0]) for name in self.possible_agents]
        self.places = self.places + np.array(moves) + 0.1 * self.rng.normal(size=3)
        over = dict.fromkeys(self.possible_agents, self.time == self.length)
        never = dict.fromkeys(self.possible_agents, False)
        reward = dict(zip(self.possible_agents, self.places, strict=True))
        infos = {name: {"height": float(p)} for name, p in reward.items()}
        return self._seen(), reward, never, over, infos

    def state(self):
        return self.places

    def _seen(self):
        return {name: np.array([p, self.time]) for name, p in zip(self.possible_agents, self.places, strict=True)}


class WalkSettings(ParallelSettings):
    horizon: int = 6


class Walking(ParallelTask):
    Settings = WalkSettings
    observation = layout(Field("place", Kind.SCALAR), Field("time", Kind.SCALAR))
    action = Discrete(Kind.SCALAR, ((0.0,), (1.0,), (2.0,)), ("stay", "walk", "run"))
    symmetry, convention = "o2", "place"
    learners, metrics = "walker", ("height",)

    def make_one(self):
        return Walk(self.settings.horizon)

    def opponent(self, agent, observation, generator):
        return int(generator.integers(3))


def worlds(cls: type[Environment], num_envs=5, seeds=(3, 7), **settings) -> Environment:
    return cls(cls.Settings(**settings), num_envs, generators_for(seeds))


@pytest.mark.parametrize("workers", [0, 2])
def test_a_parallel_task_keeps_every_promise(workers: int) -> None:
    subject = Subject(lambda num_envs, seeds: worlds(Walking, num_envs, seeds, workers=workers))
    findings = list(check(subject))
    assert [finding for finding in findings if finding.broken] == []
    assert {f.not_asked for f in findings if f.not_asked} == {
        "a run that is resumed begins new episodes",
        "the task cannot be put into a state",
        "the task has no picture",
    }


def test_actions_may_be_written_as_lists() -> None:
    class Listed(Walking):
        action = Discrete(Kind.SCALAR, [[0.0], [1.0], [2.0]], ["stay", "walk", "run"])

    one, same = worlds(Listed), worlds(Walking)
    one.reset(), same.reset()
    assert same_step(one.step(one.random_action()), same.step(same.random_action()))


def test_workers_change_no_number() -> None:
    here, there = worlds(Walking, workers=0), worlds(Walking, workers=3)
    assert torch.equal(here.reset().obs, there.reset().obs)
    for _ in range(15):
        action = here.random_action()
        assert same_step(here.step(action), there.step(action))


def test_numbers_in_the_unit_interval_are_stretched_to_a_box() -> None:
    class Boxed(Walking):
        action = Continuous(layout(Field("speed", Kind.SCALAR)))

        def make_one(self):
            return Walk(self.settings.horizon, box=True)

        def opponent(self, agent, observation, generator):
            return 0.0

    env = worlds(Boxed)
    first = env.reset().obs[..., 0]
    moved = env.step(torch.tensor([0.0, 1.0]).view(1, 1, 2, 1).expand(2, 5, 2, 1)).next.obs[..., 0] - first
    assert moved.mean((0, 1)).tolist() == pytest.approx([5.0, 10.0], abs=0.2)


def test_metrics_state_and_reading_come_from_the_environment() -> None:
    class Reading(Walking):
        observation = layout(Field("place", Kind.SCALAR), Field("clock", Kind.VECTOR))
        state = layout(Field("places", Kind.SCALAR, 3))

        def reading(self, agent, observation):
            return np.array([observation[0], np.cos(observation[1]), np.sin(observation[1])])

    env = worlds(Reading)
    start = env.reset()
    assert start.state.shape == (2, 5, 3)
    assert start.obs[..., 1:].flatten().unique().tolist() == [0.0, 1.0]
    step = env.step(env.random_action())
    assert torch.equal(step.next.state[..., :2], step.next.obs[..., 0])
    torch.testing.assert_close(step.metrics["height"], step.next.state.mean(-1))


def test_opponents_draw_anew_in_every_episode_of_every_copy() -> None:
    drawn = []

    class Watching(Walking):
        def opponent(self, agent, observation, generator):
            drawn.append(generator.normal())
            return 0

    env = worlds(Watching, 2, (3,), workers=0, horizon=2)
    env.reset()
    for _ in range(6):
        env.step(env.random_action())
    assert len(set(drawn)) == len(drawn) == 2 * 6


def test_what_an_opponent_draws_is_not_what_the_environment_draws() -> None:
    drawn = []

    class Watching(Walking):
        def opponent(self, agent, observation, generator):
            drawn.append(generator.normal(size=3).tolist())
            return 0

    env = worlds(Watching, 1, (3,), workers=0)
    start = env.reset().state
    env.step(torch.zeros(1, 1, 2, dtype=torch.int64))
    assert len(drawn) == 1
    assert abs(start[0, 0, 0].item() - drawn[0][0]) > 1e-3


class Unlike:
    """An arm of three joints and a car that moves in the plane."""

    possible_agents, joints = ("arm", "car"), {"arm": 3, "car": 2}

    def action_space(self, agent):
        return spaces.Box(-2.0, 2.0, (self.joints[agent],))

    def reset(self, seed=None, options=None):
        self.agents = list(self.possible_agents)
        return dict.fromkeys(self.agents, np.zeros(2)), {}

    def step(self, actions):
        assert {name: action.shape for name, action in actions.items()} == {"arm": (3,), "car": (2,)}
        paid = {name: float(action.sum()) for name, action in actions.items()}
        return dict.fromkeys(self.agents, np.zeros(2)), paid, *[dict.fromkeys(self.agents, False)] * 2, {}


class ArmAndCar(ParallelTask):
    observation = {"arm": layout(Field("place", Kind.VECTOR)), "car": layout(Field("place", Kind.VECTOR))}  # noqa: RUF012
    action = {  # noqa: RUF012
        "arm": Continuous(layout(Field("joints", Kind.SCALAR, 3))),
        "car": Continuous(layout(Field("velocity", Kind.VECTOR))),
    }
    symmetry, convention = "c1", "sum"

    def make_one(self):
        return Unlike()


def test_each_role_is_given_as_many_numbers_as_it_acts_by() -> None:
    env = ArmAndCar(ArmAndCar.Settings(), 1, generators_for([0]))
    env.reset()
    assert env.step(torch.full((1, 1, 2, 3), 0.5)).reward.tolist() == [[[3.0, 2.0]]]


class Haunted(Walk):
    """The ghost leaves in its second step, in which it is still seen; then it may act no more."""

    def step(self, actions):
        assert ("ghost" in actions) == (self.time < 2)
        seen, reward, never, over, infos = super().step({"ghost": 0} | actions)
        if self.time > 2:
            del seen["ghost"], reward["ghost"]
        return seen, reward, never | {"ghost": self.time >= 2}, over, infos


def test_an_opponent_that_has_left_acts_no_more() -> None:
    acted = []

    class Haunting(Walking):
        metrics = ()

        def make_one(self):
            return Haunted(self.settings.horizon)

        def opponent(self, agent, observation, generator):
            acted.append(agent)
            return 0

    env = worlds(Haunting, workers=0)
    env.reset()
    for _ in range(8):
        env.step(env.random_action())
    assert acted == ["ghost"] * 40, "twice in each of two episodes of ten copies"


def die():
    os.kill(os.getpid(), signal.SIGKILL)


def garble():
    raise ValueError("not \udc80 text")


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        (die, r"a worker process that steps environments died \(exit code -9\)"),
        (garble, "of Failing raises in 'step': ValueError: not "),
    ],
)
def test_what_goes_wrong_in_a_worker_is_one_sentence(fault, sentence) -> None:
    class Bad(Walk):
        def step(self, actions):
            return fault() if self.time == 2 else super().step(actions)

    class Failing(Walking):
        def make_one(self):
            return Bad(self.settings.horizon)

    env = worlds(Failing, workers=2)
    env.reset(), env.step(env.random_action()), env.step(env.random_action())
    with pytest.raises(ValueError, match=sentence) as caught:
        env.step(env.random_action())
    assert "\n" not in str(caught.value)


def test_after_an_interruption_no_answer_of_that_step_is_taken_for_another() -> None:
    env = worlds(Walking, workers=2)
    env.reset()
    ((_, first), *_) = env._copies._workers
    os.kill(first.pid, signal.SIGSTOP)
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, 0.2)
    goes_on = threading.Timer(0.5, os.kill, [first.pid, signal.SIGCONT])
    goes_on.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            env.step(env.random_action())
    finally:
        signal.signal(signal.SIGALRM, before)
        goes_on.join()
    with pytest.raises(UserError, match="were stopped; make the environment anew"):
        env.step(env.random_action())


def test_a_run_that_is_resumed_begins_the_episodes_that_a_reset_would_begin() -> None:
    env, other = worlds(Walking), worlds(Walking, seeds=(100, 101))
    env.reset(), other.reset()
    env.step(env.random_action())
    saved = env.state_dict()
    assert set(saved) == {"generators"}
    other.load_state_dict(saved)
    expected = env.reset()
    assert torch.equal(other.reset().obs, expected.obs)
    with pytest.raises(ValueError, match="other seeds"):
        worlds(Walking, seeds=(1,)).load_state_dict(saved)


@pytest.mark.parametrize("algorithm", ["mappo", "maddpg"])
def test_a_resumed_learner_goes_on_in_new_episodes(algorithm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TASKS, "_registered", {})
    small = {"num_envs": 2, **({"num_steps": 6} if algorithm == "mappo" else {"warmup_episodes": 0})}
    overrides = {f"{algorithm}.{name}": value for name, value in small.items()}
    overrides |= {"prior.kind": "none", "task.workers": 0, "network.hidden": [8]}
    config = resolve_config(register(Walking), algorithm, steps=100, overrides=overrides)
    trained, resumed = build_learner(config), build_learner(config)
    trained.iterate(0.0)
    saved = {name: tensor.clone() for name, tensor in trained.state_dict().items()}
    resumed.load_state_dict(saved)
    now = resumed.state_dict()
    assert all(torch.equal(now[name], saved[name]) for name in saved), "nothing is drawn before the next rollout"
    assert bool(resumed.iterate(0.0).finite.all())
    first = resumed.state_dict()
    again = build_learner(config)
    again.load_state_dict(saved)
    again.iterate(0.0)
    assert all(torch.equal(first[name], value) for name, value in again.state_dict().items()), "as often as one likes"


def test_workers_leave_with_the_environment() -> None:
    env = worlds(Walking, workers=2)
    env.reset()
    processes = [worker for _, worker in env._copies._workers]
    assert all(worker.is_alive() for worker in processes)
    del env
    assert not any(worker.is_alive() for worker in processes)


@pytest.mark.parametrize("workers", [0, 2])
def test_copies_are_closed_with_the_environment(workers: int, tmp_path: Path) -> None:
    closed = tmp_path / "closed"

    class Closing(Walking):
        def make_one(self):
            walk = Walk(self.settings.horizon)
            walk.close = lambda: closed.open("a").write("x")
            return walk

    env = worlds(Closing, workers=workers)
    env.reset()
    assert closed.read_text() == "x", "the copy that was looked at"
    del env
    gc.collect()
    assert closed.read_text() == 11 * "x"


def test_a_signal_to_the_whole_group_leaves_the_workers_to_their_parent() -> None:
    env = worlds(Walking, workers=2)
    env.reset()
    for _, worker in env._copies._workers:
        os.kill(worker.pid, signal.SIGTERM)
    env.step(env.random_action())
    assert all(worker.is_alive() for _, worker in env._copies._workers)


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save_page_files(tmp_path)


def test_the_users_file_is_short() -> None:
    assert lines_of(page_files()["spread.py"]) <= 15


def test_the_spread_of_the_page_agrees_with_mpe2_step_by_step(page: None) -> None:
    simple_spread_v3 = pytest.importorskip("mpe2.simple_spread_v3", reason="the package mpe2 is missing")
    env = make(register("spread:Spread"), 1, [0], {"workers": 0})
    start = env.reset()
    theirs = simple_spread_v3.parallel_env(N=3, local_ratio=0.5, max_cycles=25)
    first_episode = np.random.SeedSequence([int(env._base), 0])
    seen, _ = theirs.reset(seed=int(first_episode.generate_state(1)[0] >> 1))
    for _ in range(25):
        np.testing.assert_array_equal(start.obs[0, 0].numpy(), np.float32([seen[a] for a in theirs.possible_agents]))
        action = env.random_action()
        chosen = dict(zip(theirs.possible_agents, action[0, 0].tolist(), strict=True))
        step = env.step(action)
        seen, reward, _, truncated, _ = theirs.step(chosen)
        np.testing.assert_allclose(step.reward[0, 0].numpy(), list(reward.values()), rtol=1e-6)
        start = step.next
    assert all(truncated.values())
    assert bool(step.truncated.all())
    np.testing.assert_array_equal(step.final.obs[0, 0].numpy(), np.float32(list(seen.values())))


@pytest.mark.slow
@pytest.mark.parametrize(("task", "package"), [("spread:Spread", "mpe2"), ("pendulum:Pendulum", "gymnasium")])
def test_the_tasks_of_the_page_keep_every_promise(page: None, task: str, package: str) -> None:
    pytest.importorskip(package, reason=f"the package {package} is missing")
    name = register(task)
    horizon = {} if package == "gymnasium" else {"horizon": 8}
    findings = list(check(Subject(lambda n, seeds: make(name, n, seeds, {"workers": 0, **horizon}))))
    assert [finding for finding in findings if finding.broken] == []


@pytest.mark.parametrize(
    "field", [Field("ring", Kind.RING, rays=4), Field("pair", Kind.RECORD, parts=(Field("a", Kind.VECTOR),))]
)
def test_an_action_holds_vectors_and_numbers_alone(field: Field) -> None:
    with pytest.raises(ValueError, match=f"an action cannot hold '{field.name}', a {field.kind.name}; give vectors"):
        Continuous(layout(field))
