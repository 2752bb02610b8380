"""Action masks and agents that end one by one, read from PettingZoo and Gymnasium environments."""

import numpy as np
import pytest
import torch

from esp_envs import Continuous, Discrete, Environment, Field, Kind, generators_for, layout
from esp_envs.adapters.gymnasium import SingleAgentSettings, SingleAgentTask
from esp_envs.adapters.pettingzoo import ParallelSettings, ParallelTask
from esp_envs.conformance import Subject, check
from esp_envs.promises import same_observation

gymnasium = pytest.importorskip("gymnasium", reason="spaces come from the extra 'pettingzoo'")
STEPS = 5


class Corridor:
    """Two walkers leave at the end of a corridor; nobody may walk through its walls."""

    possible_agents = ("walker_0", "walker_1")

    def action_space(self, agent):
        return gymnasium.spaces.Discrete(3)

    def reset(self, seed=None, options=None):
        self.agents, self.time = list(self.possible_agents), 0
        places = np.random.default_rng(seed).integers(0, 3, 2)
        self.places = dict(zip(self.agents, places.tolist(), strict=True))
        return self._seen(), {name: {} for name in self.agents}

    def step(self, actions):
        assert set(actions) == set(self.agents), "an agent that has left gets no action"
        self.time += 1
        for name, action in actions.items():
            assert self._allowed(name)[action], "a forbidden action is taken"
            self.places[name] += (0, 1, -1)[action]
        acted = list(self.agents)
        out = {name: self.places[name] == 4 for name in acted}
        cut = dict.fromkeys(acted, self.time == STEPS)
        seen, reward = self._seen(), {name: float(self.places[name]) for name in acted}
        self.agents = [name for name in acted if not (out[name] or cut[name])]
        return seen, reward, out, cut, {name: {} for name in acted}

    def _allowed(self, name):
        return np.array([1, self.places[name] < 4, self.places[name] > 0], np.int8)

    def _seen(self):
        return {n: {"observation": [self.places[n], self.time], "action_mask": self._allowed(n)} for n in self.agents}


class CorridorSettings(ParallelSettings):
    horizon: int = STEPS


class Walkers(ParallelTask):
    Settings = CorridorSettings
    observation = layout(Field("place", Kind.SCALAR), Field("time", Kind.SCALAR))
    action = Discrete(Kind.SCALAR, ((0.0,), (1.0,), (2.0,)), ("stay", "on", "back"))
    symmetry, convention = "c1", "place"
    terminates, agents_end, masks = True, True, True

    def make_one(self):
        return Corridor()


def worlds(cls: type[Environment], num_envs=5, seeds=(3, 7), **settings) -> Environment:
    return cls(cls.Settings(**settings), num_envs, generators_for(seeds))


@pytest.mark.parametrize("workers", [0, 2])
def test_the_corridor_keeps_every_promise(workers):
    subject = Subject(lambda count, seeds: worlds(Walkers, count, seeds, workers=workers))
    assert [finding.broken for finding in check(subject) if finding.broken] == []


def test_fields_may_stand_beside_the_mask():
    class Beside(Corridor):
        def _seen(self):
            return {
                n: {"time": self.time, "action_mask": self._allowed(n), "place": self.places[n]} for n in self.agents
            }

    env, twin = (
        worlds(cls, workers=0) for cls in (type("Flat", (Walkers,), {"make_one": lambda _: Beside()}), Walkers)
    )
    assert same_observation(env.reset(), twin.reset())


def test_who_leaves_is_paid_once_and_the_other_goes_on():
    env = worlds(Walkers, 40, (0,), workers=0)
    seen = env.reset()
    left_alone = False
    for _ in range(STEPS):
        on = torch.where(torch.arange(2) == 0, 1, 0).expand(1, 40, 2)  # the first walks on, the second stays
        step = env.step(torch.where(seen.alive, on, 2))
        after = (step.final or step.next).alive
        assert torch.equal(step.reward[~seen.alive], torch.zeros(int((~seen.alive).sum())))
        gone = seen.alive & ~after
        assert bool((step.reward[gone] == 4).all())
        left_alone |= bool((~after[..., 0] & after[..., 1]).any())
        seen = step.next
    assert left_alone
    assert bool(step.truncated.all()), "the horizon cuts the episode; whoever is still there has not ended"
    assert bool(step.final.alive[..., 1].all())


def last_step(env, walking: int):
    """Play one episode in which this many of the walkers arrive with the last step, and the others stay."""
    seen = env.reset()
    for t in range(STEPS):
        must_walk = seen.obs[..., 0] + STEPS - t <= 4  # the end is at 4
        step = env.step((must_walk & (torch.arange(2) < walking)).long())
        seen = step.next
    return step


def test_at_the_horizon_only_who_arrives_with_that_very_step_has_ended():
    """The other is cut, so a value lies beyond: the episode is truncated unless all end."""
    step = last_step(worlds(Walkers, 20, (0,), workers=0), walking=1)
    assert bool(step.truncated.all())
    assert not bool(step.terminated.any())
    assert step.final.alive[0].tolist() == [[False, True]] * 20
    both = last_step(worlds(Walkers, 20, (0,), workers=0), walking=2)
    assert bool(both.terminated.all()), "the control"
    together = worlds(type("Together", (Walkers,), {"agents_end": False}), 20, (0,), workers=0)
    assert bool(last_step(together, walking=1).terminated.all()), "where nothing says who has ended, one ends all"


def test_without_the_attributes_masks_are_left_alone():
    env = worlds(type("Plain", (Walkers,), {"agents_end": False, "masks": False}), 40, (0,), workers=0)
    seen = env.reset()
    assert (seen.alive, seen.action_mask) == (None, None)


TaxiEnv = pytest.importorskip("gymnasium.envs.toy_text.taxi").TaxiEnv


class TaxiSettings(SingleAgentSettings):
    horizon: int = 20


class Taxi(SingleAgentTask):
    Settings = TaxiSettings
    observation = layout(Field("place", Kind.SCALAR))
    action = Discrete(Kind.SCALAR, tuple((float(k),) for k in range(6)), ("s", "n", "e", "w", "take", "drop"))
    symmetry, convention = "c1", "gymnasium Taxi"
    terminates, masks = True, True

    def make_single(self):
        return TaxiEnv()


def test_gymnasiums_masks_come_from_infos():
    env = worlds(Taxi, 6, (0,), workers=0)
    seen = env.reset()
    first = TaxiEnv()
    for _ in range(3):
        expected = [first.action_mask(int(place)) for place in seen.obs.flatten()]
        assert torch.equal(seen.action_mask[0, :, 0], torch.tensor(np.array(expected)).bool())
        seen = env.step(env.random_action()).next


class Hunt(Corridor):
    """A prey that does not learn is paid the opposite of the wolves; the first wolf leaves after a step."""

    possible_agents = ("prey", "wolf_0", "wolf_1")

    def step(self, actions):
        self.time += 1
        acted = list(self.agents)
        reward = {name: -10.0 if name == "prey" else 10.0 for name in acted}
        out = {name: name == "wolf_0" for name in acted}
        cut = dict.fromkeys(acted, self.time == STEPS)
        seen = self._seen()
        self.agents = [name for name in acted if not (out[name] or cut[name])]
        return seen, reward, out, cut, {name: {} for name in acted}

    def reset(self, seed=None, options=None):
        self.agents, self.time, self.places = list(self.possible_agents), 0, dict.fromkeys(self.possible_agents, 2)
        return self._seen(), {name: {} for name in self.agents}


def test_a_shared_reward_that_goes_on_is_that_of_the_learners():
    class Wolves(Walkers):
        learners, shared_reward, masks = "wolf", True, False

        def make_one(self):
            return Hunt()

        def opponent(self, agent, observation, generator):
            return 0

    env = worlds(Wolves, 1, (3,))
    env.reset()
    steps = [env.step(torch.zeros(1, 1, 2, dtype=torch.int64)) for _ in range(3)]
    assert [step.reward.flatten().tolist() for step in steps] == [[10.0, 10.0]] * 3


class Door(gymnasium.Env):
    """Pays what it is given; `state` and `width_m` are its own."""

    observation_space = gymnasium.spaces.Box(-9.0, 9.0, (1,))
    width_m = 0.5

    def __init__(self, space):
        self.action_space = space

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action), f"{action!r} is no action"
        return np.ones(1, np.float32), float(np.sum(action)), False, False, {}

    def state(self):
        return [self.width_m, 7.0]


def door(space, action, **attributes) -> type[SingleAgentTask]:
    class Doors(SingleAgentTask):
        Settings = CorridorSettings
        observation = layout(Field("place", Kind.SCALAR))
        symmetry, convention = "c1", "place"

        def make_single(self):
            return Door(space)

    Doors.action = action
    for name, value in attributes.items():
        setattr(Doors, name, value)
    return Doors


TWO_WAYS = Discrete(Kind.SCALAR, ((0.0,), (1.0,)), ("stay", "on"))
ONE_NUMBER = Continuous(layout(Field("force", Kind.SCALAR)))


def test_indices_begin_where_the_space_begins():
    env = worlds(door(gymnasium.spaces.Discrete(2, start=3), TWO_WAYS), 1, (3,))
    env.reset()
    assert [float(env.step(torch.tensor([[[a]]])).reward) for a in (0, 1)] == [3.0, 4.0]


def test_a_long_vector_is_scaled_back_before_a_copy_gets_it():
    push = Continuous(layout(Field("push", Kind.VECTOR)))
    env = worlds(door(gymnasium.spaces.Box(-1.0, 1.0, (2,)), push), 1, (3,))
    env.reset()
    assert float(env.step(torch.ones(1, 1, 1, 2)).reward) == pytest.approx(2**0.5)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_action_never_leaves_its_box(dtype):
    env = worlds(door(gymnasium.spaces.Box(-2.0, 0.2, (1,), dtype), ONE_NUMBER), 1, (3,))
    env.reset()
    rewards = [float(env.step(torch.full((1, 1, 1, 1), a)).reward) for a in (-1.0, 0.0, 1.0)]
    assert rewards == pytest.approx([-2.0, -0.9, 0.2])


def test_state_and_measure_reach_the_gymnasium_environment():
    state = layout(Field("width_m", Kind.SCALAR), Field("number", Kind.SCALAR))
    cls = door(gymnasium.spaces.Discrete(2), TWO_WAYS, state=state, metrics=("width_m",))
    cls.measure = lambda self, env, infos: {"width_m": env.unwrapped.width_m}
    env = worlds(cls, 1, (3,))
    assert env.reset().state.flatten().tolist() == [0.5, 7.0]
    assert float(env.step(torch.zeros(1, 1, 1, dtype=torch.int64)).metrics["width_m"]) == 0.5
