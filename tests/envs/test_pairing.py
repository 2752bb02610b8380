"""Simulators of others are put into states, so that checks pair them; others are judged by transitions."""

import numpy as np
import pytest
import torch

from esp_cli import discrete_moves
from esp_cli.checking import check_symmetry
from esp_envs import Continuous, Environment, Field, Items, Kind, generators_for, layout
from esp_envs.adapters.gymnasium import SingleAgentTask
from esp_envs.adapters.pettingzoo import ParallelTask
from esp_envs.drawing import draw
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


class Both:
    """Two points in a list, which share an action space of two parts."""

    action_space = gymnasium.spaces.Tuple((Point.action_space, Point.action_space))

    def __init__(self):
        self.points = [Point(), Point()]

    def reset(self, seed=None, options=None):
        return [point.reset(seed)[0] for point in self.points], {}

    def step(self, actions):
        seen = [point.step(action)[0] for point, action in zip(self.points, actions, strict=True)]
        return seen, 0.0, False, False, {}


class BothPlaced(ParallelTask):
    observation, action, symmetry, convention = layout(Field("place", Kind.VECTOR)), FORCE, "d4", "two points"
    simulated = layout(Field("places", Kind.VECTOR, 2, items=Items.AGENTS))

    def make_one(self):
        return Both()

    def take(self, env):
        return np.concatenate([point.place for point in env.points])

    def put(self, env, state):
        assert isinstance(env, Both)
        for point, place in zip(env.points, state.reshape(2, 2).astype(float), strict=True):
            point.place = place


class Sliding(Point):
    """What it does to its speed, which nobody sees, moves it."""

    def reset(self, seed=None, options=None):
        self.speed = np.zeros(2)
        return super().reset(seed)

    def step(self, action):
        self.speed = 0.9 * self.speed + action
        return super().step(self.speed)


class Aging(Point):
    """In the second half of an episode it is pushed aside."""

    def reset(self, seed=None, options=None):
        self.age = 0
        return super().reset(seed)

    def step(self, action):
        self.age += 1
        return super().step(action + np.array([0.5, 0.0]) * (self.age > 12))


class Stale(Point):
    """It says what is seen by what it saw last, which is another scene's where its place alone is written."""

    def _get_obs(self):
        return self.last

    def _seen(self):
        self.last = np.round(self.place, 3).astype(np.float32)
        return super()._seen()


class Uncopied(Point):
    def __deepcopy__(self, memo):
        raise TypeError("it holds a window")


def worlds(cls: type[Environment], num_envs: int = 8, **settings) -> Environment:
    env = cls(cls.Settings(**settings), num_envs, generators_for([0]))
    assert env.settable()
    return env


def report(cls: type[Environment], transforms: str):
    return check_symmetry(lambda n, seeds: cls(cls.Settings(), n, generators_for(seeds)), transforms)


def test_a_task_takes_and_puts_the_environment_that_it_made_where_agents_are_parts_of_spaces() -> None:
    env = worlds(BothPlaced, 2)
    state = env.reset().state + 0.5
    assert torch.allclose(env.set_state(state).state, state)
    assert torch.allclose(env.step(torch.zeros(1, 2, 2, 2)).next.obs.flatten(2), state)


class Told(Both):
    def _get_obs(self):
        return [point._seen() for point in self.points]


class Asked(Both):
    def _get_obs(self, agent):
        raise AssertionError("of whom is not known here")


class Short(Both):
    def _get_obs(self):
        return np.zeros(7)


@pytest.mark.parametrize(("env", "told"), [(Told, True), (Asked, False), (Short, False)])
def test_what_agents_see_in_a_state_is_taken_where_it_is_all_that_they_see(env, told: bool) -> None:
    cls = type("Placed", (BothPlaced,), {"make_one": lambda self: env()})
    both = worlds(cls, 2)
    state = both.reset().state + 0.5
    seen = both.set_state(state)
    assert bool(seen.obs.isnan().all()) is not told
    assert not told or torch.allclose(seen.obs.flatten(2), state)


class Board:
    """A body on a board of 7 x 7 squares around the middle, which says in an info which ways lead off it."""

    action_space, ways = gymnasium.spaces.Discrete(5), np.array([(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1)])

    def reset(self, seed=None, options=None):
        self.place = np.random.default_rng(seed).integers(-3, 4, 2).astype(float)
        return self._get_obs(), self._info()

    def step(self, action):
        self.place = self.place + self.ways[action] * self._info()["action_mask"][action]
        return self._get_obs(), -float(np.abs(self.place).sum()), False, False, self._info()

    def _get_obs(self):
        return self.place.astype(np.float32)

    def _info(self):
        return {"action_mask": (np.abs(self.place + self.ways).max(1) <= 3).astype(np.int8)}


class OnBoard(SingleAgentTask):
    observation, masks = layout(Field("place", Kind.VECTOR)), True
    simulated = layout(Field("place", Kind.VECTOR))
    action, symmetry, convention = discrete_moves(["stay", "right", "up", "left", "down"]), "d4", "distance"

    def make_single(self):
        return Board()

    def take(self, env):
        return env.place

    def put(self, env, state):
        env.place = np.array(state, float).round()


def test_a_mask_of_the_info_before_is_not_that_of_a_state() -> None:
    env = worlds(OnBoard, 2)
    env.reset()
    seen = env.set_state(torch.full((1, 2, 2), 3.0))
    assert seen.obs.isnan().all()
    assert seen.action_mask.all(), "nobody knows it yet"
    assert env.step(torch.zeros(1, 2, 1, dtype=torch.long)).next.action_mask[0, 0, 0].tolist() == [1, 0, 0, 1, 1]
    assert {element.outcome for element in report(OnBoard, "d4").elements} == {"holds"}


class Numbered:
    """A body whose agent is called 0; an episode ends for good where it comes near the middle."""

    possible_agents = (0,)

    def action_space(self, agent):
        return gymnasium.spaces.Box(-1.0, 1.0, (2,))

    def reset(self, seed=None, options=None):
        self.agents, self.place = [0], np.random.default_rng(seed).uniform(-1, 1, 2)
        return {0: self.place.astype(np.float32)}, {0: {}}

    def step(self, actions):
        assert self.agents, "a step after the end"
        self.place = self.place + 0.1 * actions[0]
        near = bool(np.linalg.norm(self.place) < 0.3)
        self.agents = [] if near else [0]
        return {0: self.place.astype(np.float32)}, {0: -1.0}, {0: near}, {0: False}, {0: {}}


class Counted(ParallelTask):
    observation, action, symmetry, convention = layout(Field("place", Kind.VECTOR)), FORCE, "d4", "a step"
    terminates = True

    def make_one(self):
        return Numbered()


def test_an_agent_whose_name_is_0_ends_as_any() -> None:
    assert worlds(Counted).settable()


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
    found = report(Spread, "rot90,flip-x,agents-1-0-2,agents-0-2-1,marks-1-0-2,marks-0-2-1")
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


@pytest.mark.parametrize("kind", [Point, Hidden])
def test_an_environment_that_can_be_copied_is_paired_by_its_attributes(kind, monkeypatch) -> None:
    """A state that is only written down, beside the one that decides, does no harm."""
    monkeypatch.setattr(Tri, "kind", kind)
    found = report(Tri, "rot90,rot180,flip-y,flip-x")
    assert (found.method, found.found) == ("paired states", "flip-x")
    assert [element.outcome for element in found.elements] == ["broken"] * 3 + ["holds"]


@pytest.mark.parametrize("kind", [Point, Sliding, Aging, Stale, Uncopied])
def test_what_is_not_all_of_the_state_cannot_be_set(kind, monkeypatch) -> None:
    """A hidden speed or a clock would make a state that is set another than the one that was read."""
    monkeypatch.setattr(Tri, "kind", kind)
    assert Tri(Tri.Settings(), 8, generators_for([0])).settable() == (kind is Point)


def test_what_cannot_be_set_is_judged_by_transitions(monkeypatch) -> None:
    monkeypatch.setattr(Tri, "kind", Sliding)
    found = report(Tri, "rot90")
    assert (found.method, found.found) == ("transitions", "c1")
    assert "holds" not in {element.outcome for element in found.elements}


class Walled(Point):
    """Square walls, far from where it starts."""

    places = np.zeros((3, 2))

    def reset(self, seed=None, options=None):
        super().reset(seed)
        self.place = 0.2 * self.place
        return self._seen(), {}

    def step(self, action):
        _, _, *rest = super().step(action)
        self.place = self.place.clip(-3, 3)
        return self._seen(), -float(np.linalg.norm(self.place)), *rest


def test_what_holds_only_where_play_went_is_not_covered(monkeypatch) -> None:
    monkeypatch.setattr(Tri, "kind", Walled)
    turn, quarter = report(Tri, "rot45,rot90").elements
    assert (turn.outcome, quarter.outcome) == ("not covered", "holds")
    assert turn.reason == "holds where play went, but further out obs.place, state.place, reward would differ"


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


class Slider:
    """A point that goes as far as the first two numbers of a Box say, of whatever shape."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.action_space = gymnasium.spaces.Box(-2.0, 2.0, shape)

    def reset(self, seed=None, options=None):
        return np.zeros(2), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return action.flatten()[:2], 0.0, False, False, {}


PUSH = Continuous(layout(Field("push", Kind.VECTOR)))
TAKEN = [
    (discrete_moves(4), (2,), lambda *given: np.float32([given[-1], 0]), 2, [2.0, 0.0]),
    (PUSH, (4,), lambda *given: np.append(given[-1], np.float32([0, 0])), [0.5, -0.5], [0.5, -0.5]),
    (PUSH, (2, 1), lambda *given: given[-1][:, None], [0.5, -0.5], [0.5, -0.5]),
    (PUSH, (2,), lambda *given: given[-1], [0.5, -0.5], [1.0, -1.0]),  # it fits, and is stretched to its bounds
]


@pytest.mark.parametrize(("action", "shape", "acting", "given", "moved"), TAKEN)
def test_a_box_of_another_shape_is_acted_in_by_the_hook_alone(action, shape, acting, given, moved) -> None:
    class Sliding(SingleAgentTask):
        observation, symmetry, convention = layout(Field("moved", Kind.VECTOR)), "d4", "slider"

        def make_single(self):
            return Slider(shape)

    Sliding.action = action
    if shape != (2,) or action is not PUSH:
        with pytest.raises(ValueError, match="acts in Box"):
            Sliding(Sliding.Settings(), 1, generators_for([0]))
    Sliding.acting = acting
    env = Sliding(Sliding.Settings(), 1, generators_for([0]))
    env.reset()
    assert env.step(torch.tensor(given).view(env.action_shape)).next.obs.flatten().tolist() == moved


class Gripper:
    """It sees and acts in Dict spaces, sees a Tuple in one of them, and draws itself."""

    render_mode, number = "rgb_array", gymnasium.spaces.Box(-2.0, 2.0, (1,))
    action_space = gymnasium.spaces.Dict(grip=gymnasium.spaces.Discrete(2), push=number)

    def reset(self, seed=None, options=None):
        self.at = np.zeros(1)
        return self._seen(), {}

    def step(self, action):
        self.at = self.at + action["push"] * action["grip"]
        return self._seen(), float(self.at[0]), False, False, {}

    def render(self):
        return np.full((20, 40, 3), int(10 * self.at[0]), np.uint8)

    def _seen(self):
        return {"picture": None, "at": self.at, "again": self.at * 10}


class Gripping(SingleAgentTask):
    observation = layout(Field("again", P), Field("at", P))
    action = Continuous(layout(Field("push", P), Field("grip", Kind.SCALAR)))
    symmetry, convention = "flip-x", "gripper"

    def make_single(self):
        return Gripper()

    def acting(self, agent, action):
        return {"push": 2 * action[:1], "grip": int(action[1] > 0)}


def test_dict_spaces_are_read_by_the_fields_names_and_acted_in_by_the_hook() -> None:
    env = Gripping(Gripping.Settings(), 1, generators_for([0]))
    env.reset()
    seen = [env.step(torch.tensor([[[action]]])).next.obs.flatten().tolist() for action in ([0.5, 1.0], [0.5, -1.0])]
    assert seen == [[10.0, 1.0], [10.0, 1.0]]

    class Misnamed(Gripping):
        observation = layout(Field("place", P))

    with pytest.raises(ValueError, match="sees picture, at, again, and the layout has 'place'; name fields"):
        Misnamed(Misnamed.Settings(), 1, generators_for([0]))


def test_parts_of_a_tuple_are_read_in_their_order() -> None:
    seen = (np.ones(2), 3.0)
    assert Gripping.reading(None, "agent", seen).tolist() == [1, 1, 3]


def test_an_environment_draws_itself() -> None:
    env = Gripping(Gripping.Settings(), 1, generators_for([0]))
    env.reset()
    env.step(torch.tensor([[[[0.5, 1.0]]]]))
    assert env.has("scene")
    picture = draw(env.scene(), 20)
    assert (picture.shape, int(picture.max()), int(picture.min())) == ((10, 20, 3), 10, 10)
    assert not Cart(Cart.Settings(), 1, generators_for([0])).has("scene"), "it was made without a render mode"
    assert not Gripping(Gripping.Settings(workers=2), 2, generators_for([0])).has("scene"), "others draw elsewhere"


def test_unlike_agents_are_refused_with_what_to_do() -> None:
    class Unlike(Adding):
        def reading(self, agent, observation):
            return np.repeat(observation, 2 if agent == "agent_1" else 1)

    with pytest.raises(ValueError, match=r"agent_1 sees 2 numbers, but the layout has 1; .* begin 'learners'"):
        Unlike(Unlike.Settings(), 1, generators_for([0]))
