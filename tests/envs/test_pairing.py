"""Simulators of others are put into states, so that checks pair them; others are judged by transitions."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from esp_cli.checking import check_symmetry
from esp_envs import Continuous, Environment, Field, Items, Kind, generators_for, layout
from esp_envs.adapters.gymnasium import SingleAgentTask
from esp_envs.adapters.pettingzoo import ParallelTask
from esp_envs.mpe.task import FORCE, MOVES
from esp_envs.spec import Discrete

gymnasium = pytest.importorskip("gymnasium")
simple_spread = pytest.importorskip("mpe2.simple_spread_v3")
P = Kind.PSEUDOSCALAR


class Spread(ParallelTask):
    observation = layout(
        Field("velocity", Kind.VECTOR),
        Field("position", Kind.VECTOR),
        Field("marks", Kind.VECTOR, 3),
        Field("others", Kind.VECTOR, 2, items=Items.OTHERS),
        Field("messages", Kind.VECTOR, 2, items=Items.OTHERS),
    )
    action, symmetry, convention = MOVES, "d4*agents", "mpe2 simple_spread_v3"

    def make_one(self):
        return simple_spread.parallel_env(N=3, max_cycles=25)


class Leaning(Spread):
    """What it shows of positions is off by a hundredth."""

    def reading(self, agent, observation):
        return observation + 0.01 * (np.arange(18) == 2)


class Cart(SingleAgentTask):
    observation = layout(Field("x", P), Field("speed", P), Field("angle", P), Field("spin", P))
    action = Discrete(P, ((-1.0,), (1.0,)), ("left", "right"))
    symmetry, convention, terminates = "flip-x", "CartPole-v1", True

    def make_single(self):
        return gymnasium.make("CartPole-v1")


class Swing(SingleAgentTask):
    observation = layout(Field("cos", Kind.SCALAR), Field("sin", P), Field("spin", P))
    simulated = layout(Field("angle", P), Field("spin", P))
    action, symmetry, convention = Continuous(layout(Field("torque", P))), "flip-x", "Pendulum-v1"

    def make_single(self):
        return gymnasium.make("Pendulum-v1")


class Point:
    """A point that keeps its place to itself, pays at one of three places, and shows where it moved; a plain `Env`."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    places = 0.7 * np.array([[1.0, 0.0], [-0.5, 0.75**0.5], [-0.5, -(0.75**0.5)]])
    state = None

    def reset(self, seed=None, options=None):
        self.place = np.random.default_rng(seed).uniform(-1, 1, 2)
        return self._seen(), {}

    def step(self, action):
        self.place = self.place + 0.2 * action
        near = np.linalg.norm(self.place - self.places, axis=1) < 0.25
        return self._seen(), float(near.any()), False, False, {}

    def _seen(self):
        return self.place.astype(np.float32)


class Hidden(Point):
    """It has a `state` that decides nothing: what is written there changes nothing."""

    def _seen(self):
        self.state = self.place.copy()
        return super()._seen()


class Tri(SingleAgentTask):
    observation = layout(Field("place", Kind.VECTOR))
    action, symmetry, convention = FORCE, "d4", "three places"
    kind = Point

    def make_single(self):
        return self.kind()


class Placed(Tri):
    simulated = layout(Field("place", Kind.VECTOR))

    def take(self, env):
        return env.place

    def put(self, env, state):
        env.place = state.astype(float)


class Deaf(Tri):
    kind = Hidden


def worlds(cls: type[Environment], num_envs: int = 8, **settings) -> Environment:
    env = cls(cls.Settings(**settings), num_envs, generators_for([0]))
    assert env.settable()
    return env


def report(cls: type[Environment], transforms: str):
    return check_symmetry(lambda n, seeds: cls(cls.Settings(), n, generators_for(seeds)), transforms)


@pytest.mark.parametrize("workers", [0, 2])
def test_the_same_follows_the_same_state(workers: int) -> None:
    env, twin = worlds(Spread, workers=workers), worlds(Spread)
    env.reset()
    for _ in range(3):
        before = env.step(env.random_action()).next
    twin.reset(), twin.reset()
    shown = twin.set_state(before.state)
    assert torch.allclose(shown.obs, before.obs, atol=1e-6)
    action = env.random_action()
    one, other = env.step(action), twin.step(action)
    assert torch.allclose(one.reached.state, other.reached.state, atol=1e-6)
    assert torch.allclose(one.reward, other.reward, atol=1e-5)


def test_particles_are_paired_and_landmarks_named_as_agents_see_them() -> None:
    assert worlds(Spread, 1).spec.state.slices().keys() == {"agents", "velocities", "marks"}
    found = report(Spread, "d4*agents*marks-3")
    assert (found.method, found.found) == ("paired states", "d4*agents*marks-3")


def test_a_hundredth_is_seen() -> None:
    found = report(Leaning, "rot90,flip-x,agents-1-0-2")
    assert [element.outcome for element in found.elements] == ["broken", "holds", "holds"]
    (worst,) = (field for field in found.elements[0].fields if field.outcome == "broken")
    assert (worst.field, worst.share) == ("obs.position", 1.0)


@pytest.mark.parametrize("task", [Cart, Swing])
def test_classic_tasks_are_paired(task) -> None:
    found = report(task, "flip-x")
    assert (found.method, found.found, found.holds) == ("paired states", "flip-x", True)


def test_the_pole_of_mujoco_leans() -> None:
    """Its middle is 0.0005 beside its hinge, so no mirror holds: by 0.2 % of the speed of the turn."""
    pytest.importorskip("mujoco")

    class Pole(Cart):
        observation = layout(Field("x", P), Field("angle", P), Field("speed", P), Field("spin", P))
        action, convention = Continuous(layout(Field("push", P))), "InvertedPendulum-v5"

        def make_single(self):
            return gymnasium.make("InvertedPendulum-v5")

    (element,) = report(Pole, "flip-x").elements
    gaps = {field.field: field.gap for field in element.fields if field.outcome == "broken"}
    assert 1e-3 < gaps["obs.spin"] < 4e-3


def test_three_places_that_nobody_sees_are_no_symmetry_of_a_simulator_that_can_be_set() -> None:
    found = report(Placed, "rot90,rot180,flip-y,flip-x")
    assert (found.method, found.found) == ("paired states", "flip-x")
    assert [element.outcome for element in found.elements] == ["broken"] * 3 + ["holds"]


@pytest.mark.parametrize("task", [Tri, Deaf])
def test_what_cannot_be_set_is_judged_by_transitions(task) -> None:
    """A state that is only written down would make every symmetric start look like a symmetry."""
    found = report(task, "rot90,rot180,flip-y")
    assert found.method == "transitions"
    assert found.found == "c1"
    assert "holds" not in {element.outcome for element in found.elements}


class Listed:
    """Two agents in Tuple spaces: each moves by what it does, and both see the sum."""

    action_space = gymnasium.spaces.Tuple([gymnasium.spaces.Discrete(3)] * 2)

    def reset(self, seed=None):
        self.sums = np.zeros(2, np.float32)
        return tuple(self.sums[:, None]), {}

    def step(self, actions):
        self.sums = self.sums + np.array(actions, np.float32)
        return tuple(self.sums[:, None]), list(self.sums), False, False, {"highest": self.sums.max()}


class Adding(ParallelTask):
    observation = layout(Field("sum", Kind.SCALAR))
    action = Discrete(Kind.SCALAR, ((0.0,), (1.0,), (2.0,)), ("none", "one", "two"))
    symmetry, convention, metrics = "agents", "sum", ("highest",)

    def make_one(self):
        return Listed()

    def acting(self, agent, action):
        return 2 - action if agent == "agent_1" else action


def test_agents_in_tuple_spaces_act_as_the_task_says() -> None:
    env = Adding(Adding.Settings(workers=0), 2, generators_for([0]))
    env.reset()
    step = env.step(torch.tensor([[[2, 2], [1, 0]]]))
    assert step.reward.tolist() == [[[2.0, 0.0], [1.0, 2.0]]]
    assert step.metrics["highest"].tolist() == [[2.0, 2.0]]


def test_unlike_agents_are_refused_with_what_to_do() -> None:
    class Unlike(Adding):
        def reading(self, agent, observation):
            return np.repeat(observation, 2 if agent == "agent_1" else 1)

    with pytest.raises(
        ValueError, match=r"agent_0 sees 1 numbers .* agent_1 sees 2 .* must be alike; begin 'learners'"
    ):
        Unlike(Unlike.Settings(), 1, generators_for([0]))
