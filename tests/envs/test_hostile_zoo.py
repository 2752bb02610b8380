"""Small environments with one fault each, and what is right: it runs, is refused in a sentence, or `check` names it."""

import re
import sys
import time
import types
from itertools import count

import numpy as np
import pytest
import torch

from esp_cli import train
from esp_cli.training.build import first_look
from esp_cli.training.config import resolve_config
from esp_envs import (
    Continuous,
    Discrete,
    Environment,
    Field,
    Kind,
    UserError,
    generators_for,
    installed,
    layout,
    make,
    register,
)
from esp_envs.adapters import foreign
from esp_envs.adapters.gymnasium import SingleAgentSettings, SingleAgentTask
from esp_envs.adapters.pettingzoo import ParallelSettings, ParallelTask
from esp_envs.conformance import Subject, check
from esp_envs.registry import TASKS

gymnasium = pytest.importorskip("gymnasium", reason="spaces come from the extra 'pettingzoo'")
spaces = gymnasium.spaces
LENGTH = 4
SEEN, REWARD, OVER, CUT, INFOS = range(5)


class Team:
    """Two agents on a line, right in every point; a fault changes what `step` returns, or replaces a method."""

    possible_agents = ("a", "b")

    def action_space(self, agent):
        return spaces.Discrete(3)

    def reset(self, seed=None, options=None):
        self.agents, self.time, self.rng = list(self.possible_agents), 0, np.random.default_rng(seed)
        self.x = dict(zip(self.agents, self.rng.normal(size=2), strict=True))
        return self.seen(), {name: {} for name in self.agents}

    def step(self, actions):
        assert set(actions) == set(self.agents), "an agent that is gone gets no action"
        self.time += 1
        for name, action in actions.items():
            self.x[name] += float(np.ravel(action)[0])
        acted = list(self.agents)
        cut = self.time == LENGTH
        out = [self.seen(), dict.fromkeys(acted, 1.0), dict.fromkeys(acted, False), dict.fromkeys(acted, cut), {}]
        self.agents = [] if cut else acted
        out = self.fault(out) or out
        return tuple(out) if isinstance(out, list) else out

    def seen(self):
        return {name: np.array([self.x[name], self.time]) for name in self.agents}

    def fault(self, out):
        return None


class TeamSettings(ParallelSettings):
    horizon: int = LENGTH
    workers: int | None = 0


class Task(ParallelTask):
    Settings = TeamSettings
    observation = layout(Field("place", Kind.SCALAR), Field("time", Kind.SCALAR))
    action = Discrete(Kind.SCALAR, ((0.0,), (1.0,), (2.0,)), ("stay", "walk", "run"))
    symmetry, convention = "c1", "1 a step"
    env = Team

    def make_one(self):
        return self.env()


def task(fault=None, of=None, **attributes) -> type[ParallelTask]:
    """Return a task whose environment has a `fault` in what it returns, or other members `of` its class."""
    members = dict(of or {}) | ({} if fault is None else {"fault": fault})
    return type("Zoo", (Task,), {"env": type("Team", (Team,), members)} | attributes)


def worlds(cls: type[Environment], num_envs=2, seeds=(3,)) -> Environment:
    return cls(cls.Settings(), num_envs, generators_for(seeds))


def run(cls: type[Environment], num_envs=2) -> str:
    """Return how the steps of all worlds end, one letter each: '.' goes on, 'T' terminated, 'c' cut."""
    env, told = worlds(cls, num_envs), ""
    env.reset()
    for _ in range(2 * LENGTH + 1):
        step = env.step(env.random_action())
        told += ("T" if step.terminated.any() else "") + ("c" if step.truncated.any() else "") or "."
    return told


def at(when: int, change):
    """Return a fault of one step: `change(env, out)`."""
    return lambda self, out: change(self, out) if self.time == when else None


def put(part: int, value):
    """Return a change that replaces a part of what `step` returns."""
    return lambda self, out: out.__setitem__(part, value)


def lose(part: int, name="b"):
    return lambda self, out: out.__setitem__(part, {k: v for k, v in out[part].items() if k != name})


def flag(part: int, *names):
    return lambda self, out: out[part].update(dict.fromkeys(names, True))


def go(*names, others=True):
    """Return a change by which agents leave `env.agents`; where they are gone, nothing mentions them."""

    def change(self, out):
        self.agents = [name for name in self.agents if name not in names]
        return [{k: v for k, v in part.items() if k not in names} for part in out] if others else None

    return change


def give(value):
    return {"make_one": lambda self: value}


PUSH = Continuous(layout(Field("push", Kind.VECTOR)))
TURN = Continuous(layout(Field("turn", Kind.PSEUDOSCALAR)))
WHEELS = Continuous(layout(Field("wheels", Kind.WHEELS)))


def box(low, high, symmetry, action=PUSH):
    space = spaces.Box(np.float32(low), np.float32(high))
    return task(of={"action_space": lambda self, agent: space}, action=action, symmetry=symmetry)


AEC = types.SimpleNamespace(agent_iter=print, last=print, possible_agents=["a"], reset=print, step=print)
WITHOUT_AGENTS = types.SimpleNamespace(reset=print, step=print, agents=["a"], action_space=print)


def go_and_come(self, out):
    if self.time == 3:
        self.agents.append("b")
        return [self.seen(), *out[1:]]
    return go("b")(self, out) if self.time == 1 else None


def one_pulse(self, actions):
    """Flag the end of b once, and go on showing it, without a list of agents."""
    seen, reward, over, cut, infos = bare(self, {"b": 0} | actions)
    return seen, reward, over | {"b": self.time == 1}, cut, infos


def fresh(self, seed):
    self.time, self.x = 0, dict(zip("ab", np.random.default_rng(seed).normal(size=2), strict=True))
    return self.seen(), {}


def bare(self, actions):
    self.time += 1
    self.x = {name: x + float(actions[name]) for name, x in self.x.items()}
    over = dict.fromkeys("ab", False)
    return self.seen(), {"a": 1.0, "b": 1.0}, over, dict.fromkeys("ab", self.time == LENGTH), {}


NO_LIST = {
    "agents": property(lambda self: None, lambda self, value: None),
    "seen": lambda self: {name: np.array([self.x[name], self.time]) for name in "ab"},
    "reset": lambda self, seed=None: fresh(self, seed),
    "step": bare,
}
MADE = {
    "nothing": (task(**give(None)), "'make_one' returns nothing; return a PettingZoo ParallelEnv"),
    "a class": (task(**give(Team)), "'make_one' returns the class Team instead of an object of it"),
    "AEC": (task(**give(AEC)), "AEC environment, whose agents act in turn; wrap it in pettingzoo.utils.aec"),
    "make_vec": (task(**give(types.SimpleNamespace(single_action_space=1))), "a vector of environments; return one"),
    "one agent": (task(make_one=lambda self: Door()), "a Gymnasium environment; derive from .*SingleAgentTask"),
    "no agents": (task(**give(WITHOUT_AGENTS)), "a SimpleNamespace, which has no 'possible_agents'"),
    "a number": (task(**give(7)), "'make_one' returns a int, which has no 'reset and step'"),
    "nobody": (task(of={"possible_agents": ()}), "the agents are none"),
    "old reset": (task(of={"reset": lambda self, seed=None: {}}), "'reset' returns a dict; return .observations"),
    "no seed": (task(of={"reset": lambda self: ({}, {})}), "'reset' takes no seed; define reset.self, seed=None"),
    "rows": (task(of={"reset": lambda self, seed: ([1, 2], {})}), "'reset' returns observations as a list"),
    "reset raises": (task(of={"reset": lambda self, seed: 1 / 0}), "copy 0 of Zoo raises in 'reset': ZeroDivision"),
    "absent": (task(of={"seen": lambda self: {"a": np.zeros(2)}}), "b gets no observation from 'reset'"),
    "multi": (task(of={"action_space": lambda *_: spaces.MultiDiscrete([3, 2])}), r"acts in MultiDiscrete\(\[3 2\]\)"),
    "tuple": (
        task(of={"action_space": lambda *_: spaces.Tuple([])}),
        r"acts in Tuple\(\), but the task says 3 discrete",
    ),
    "no space": (task(of={"action_space": lambda *_: None}), "a acts in None, but the task says 3 discrete"),
    "spaces of others": (task(of={"action_space": {"z": 1}}), "a has no action space, neither in 'action_space'"),
    "a text": (task(reading=lambda *_: "12"), "what a sees is a str, not an array of real numbers"),
    "a dictionary": (task(reading=lambda *_: {"x": 1}), "what a sees is a dict, not an array"),
    "none": (task(reading=lambda *_: None), "what a sees is a NoneType, not an array"),
    "ragged": (task(reading=lambda *_: [[1.0], [1.0, 2.0]]), "what a sees is a list, not an array"),
    "complex": (task(reading=lambda *_: np.ones(2) * 1j), "what a sees is a ndarray, not an array of real"),
    "too wide": (task(reading=lambda *_: [1, 2, 3]), "a sees 3 numbers, but the layout has 2"),
    "a box": (task(observation=spaces.Box(0, 1, (2,))), r"the observation of Zoo is a Box; give a layout"),
    "a space": (task(action=spaces.Discrete(3)), r"the action of Zoo is a Discrete; give Discrete\(...\) or"),
    "metrics as a text": (task(metrics=("hits")), r"the metrics of Zoo are a text; give a tuple: \('hits',\)"),
    "totals as a text": (task(metrics=("hits",), totals="hits"), r"the totals of Zoo are a text; give .* \('hits',\)"),
    "totals misspelt": (
        task(metrics=("hits",), totals=("hit",)),
        "the totals of Zoo name 'hit', but its metrics are hits",
    ),
    "masks of nobody": (task(masks={"agent": True}), "masks of Zoo names 'agent', but its roles are none"),
    "twins": (task(of={"possible_agents": ("a", "a")}), "'possible_agents' names an agent twice"),
    "agents by a method": (task(of={"possible_agents": lambda self: ["a"]}), "a Team, which has no 'possible_agents'"),
    "state as an array": (task(of={"state": np.zeros(2)}, state=Task.observation), "has no 'state' method"),
    "state raises": (task(of={"state": lambda self: 1 / 0}, state=Task.observation), "raises in 'state': ZeroDivision"),
    "no state": (task(state=Task.observation), "its environment has no 'state' method"),
    "unequal": (
        box([-1, -2], [1, 2], "d4*agents"),
        "by 'push', a vector, between .*, which 'd4.agents' does not leave alone",
    ),
    "off centre": (box([0, 0], [1, 1], "c2"), "by 'push', a vector, between .*, which 'c2' does not leave alone"),
    "boundless": (box([-3e38, -3e38], [3e38, 3e38], "c1"), "acts in Box.*, but the task says 2 bounded real numbers"),
    "below a mirror": (box([-1, -1], [1, 3], "flip-x"), "which 'flip-x' does not leave alone"),
    "beside a mirror": (box([-1, -1], [3, 1], "flip-y"), "which 'flip-y' does not leave alone"),
    "a diagonal": (box([-1, -2], [1, 2], "flip-diagonal"), "which 'flip-diagonal' does not leave alone"),
    "a quarter turn": (box([-1, -2], [1, 2], "rot90"), "which 'rot90' does not leave alone"),
    "turns behind orders": (box([-1, -2], [1, 2], "agents*d4"), "which 'agents.d4' does not leave alone"),
    "unlike wheels": (box([-1, -1], [1, 2], "flip-x", WHEELS), "by 'wheels', a wheels, between .*, which 'flip-x'"),
    "any turn": (box([-1, -2], [1, 2], "o2"), "'o2' does not leave alone; declare a smaller symmetry"),
    "fewer actions": (
        task(action=Discrete(Kind.SCALAR, ((0.0,), (1.0,)), ("a", "b"))),
        r"\(3\), but the task says 2 dis",
    ),
    "whole numbers": (
        task(of={"action_space": lambda *_: spaces.Box(0, 10, (2,), np.int64)}, action=PUSH),
        "acts in Box.*, but the task says 2 bounded real numbers",
    ),
    "wide state": (
        task(of={"state": lambda _: np.zeros(3)}, state=Task.observation),
        "state has 3 numbers, but the lay",
    ),
    "no learner": (task(learners="runner"), "no agent's name begins with 'runner'; the agents are a, b"),
    "unsaid": (
        task(action=None, symmetry=None),
        "the class Zoo does not say its action, symmetry; set it in the class",
    ),
    "no mask": (task(masks=True), "a gets no 'action_mask', neither in its observation nor in its info"),
    "wide mask": (task(masks=True, allowed=lambda *_: np.ones(4)), "a has a mask of 4 actions, but the task has 3"),
    "one-sided": (box([0], [1], "flip-x", TURN), "by 'turn', a pseudoscalar, between .*, which 'flip-x' does"),
}


@pytest.mark.parametrize(
    ("low", "high", "taken", "refused", "action"),
    [
        ([-1, -1], [3, 1], {"flip-x", "c1"}, {"flip-y", "c2"}, PUSH),
        ([-1, -1], [1, 3], {"front-back"}, {"left-right", "half-turn"}, PUSH),
        ([-1, -2], [1, 2], {"half-turn,flip-x", "c1"}, {"flip-diagonal", "o2"}, PUSH),
        ([0, 0], [2, 2], {"flip-x", "d4"}, set(), WHEELS),
        ([-1, -1], [1, 2], {"c4"}, {"d4"}, WHEELS),
    ],
)
def test_bounds_are_taken_where_a_symmetry_leaves_them_alone(low, high, taken, refused, action):
    def is_taken(symmetry):
        try:
            foreign.require_round(action, symmetry, "a", (np.float32(low), np.float32(high)))
        except UserError as error:
            return "does not leave alone" not in str(error)
        return True

    assert {symmetry for symmetry in taken | refused if is_taken(symmetry)} == taken


STEPPED = {
    "old step": (task(lambda self, out: tuple(out[:4])), "'step' returns 4 parts; return .observations, rewards, term"),
    "a list": (task(lambda self, out: out[SEEN]), "'step' returns a dict; return"),
    "bare flags": (task(put(OVER, False)), "'step' returns terminated as a bool"),
    "bare reward": (task(put(REWARD, 1.0)), "'step' returns rewards as a float"),
    "no observation": (task(at(2, lose(SEEN))), "'step' gives b of Zoo no observation; give one to all that have not"),
    "no first observation": (task(at(1, put(SEEN, {}))), "'step' gives a of Zoo no observation"),
    "no last observation": (task(at(LENGTH, lose(SEEN))), "'step' gives b of Zoo no observation"),
    "no reward": (task(at(2, lose(REWARD))), "'step' gives b of Zoo no reward; give one to all that acted"),
    "no rewards": (task(put(REWARD, {})), "'step' gives a of Zoo no reward"),
    "no last reward": (task(at(LENGTH, lose(REWARD))), "'step' gives b of Zoo no reward"),
    "reward None": (task(put(REWARD, {"a": None, "b": 1})), "the reward of a is a NoneType, not an array of real"),
    "two rewards": (task(put(REWARD, {"a": [1, 2], "b": 1})), "the reward of a has 2 numbers, expected 1"),
    "no flags": (task(lambda self, out: [*out[:2], {}, {}, {}]), "'step' does not say whether a of Zoo has ended"),
    "others' flags": (task(lambda self, out: [*out[:2], {"z": True}, {}, {}]), "not say whether a of Zoo has ended"),
    "a flag lost": (task(lambda self, out: [*out[:2], {"a": False}, {"a": False}, {}]), "whether b of Zoo has ended"),
    "flag as text": (task(put(OVER, {"a": "False", "b": False})), "the flag of a is 'False'; give True or False"),
    "flag None": (task(put(CUT, {"a": None, "b": False})), "the flag of a is None; give True or False"),
    "a new agent": (task(at(1, lambda self, out: self.agents.append("z"))), "z is in 'env.agents', but not in"),
    "back": (task(go_and_come, agents_end=True, terminates=True), "b of Zoo is back after its end; end agents"),
    "flag once": (task(of=NO_LIST | {"step": one_pulse}, agents_end=True, terminates=True), "b of Zoo is back after"),
    "apart": (task(at(2, flag(OVER, "b"))), "b of Zoo ends before the others; set 'agents_end = True'"),
    "left apart": (task(at(2, go("b"))), "b of Zoo ends before the others; set 'agents_end = True'"),
    "early": (task(at(2, flag(OVER, "a", "b"))), "ends before its horizon; set 'terminates = True' in the class"),
    "cut early": (task(at(2, flag(CUT, "a", "b"))), "give both the same number of steps, or set 'terminates = True'"),
    "all early": (task(at(2, flag(OVER, "__all__"))), "ends before its horizon; set 'terminates = True'"),
    "cut alone": (task(at(2, flag(CUT, "b")), agents_end=True, terminates=True), "b of Zoo is truncated while others"),
    "not shared": (task(put(REWARD, {"a": 1, "b": 2}), shared_reward=True), "get different rewards; leave"),
    "narrower": (task(at(2, lambda self, out: out[SEEN].update(b=[7.0]))), "b sees 1 numbers, but the layout has 2"),
    "no action": (task(masks=True, allowed=lambda *_: np.zeros(3)), "the mask of a allows nothing; leave it one"),
    "state shrinks": (task(of={"state": lambda self: [*self.x.values()][: 2 - self.time]}, state=Task.observation),
                      "the state has 1 numbers, expected 2"),
    "metric misspelt": (task(put(INFOS, {"a": {"hits": 1}}), metrics=("hit",)),
                        "no info of Zoo holds the metric 'hit' in a whole episode; they hold hits; correct"),
    "metric nowhere": (task(metrics=("hits",)), "the metric 'hits' in a whole episode; they hold nothing; correct"),
    "reading raises": (task(reading=lambda _, name, seen: {0.0: seen}[seen[1]]), "raises in 'reading': KeyError: .*1"),
    "measure raises": (task(metrics=("hit",), measure=lambda *_: {}), "raises in 'measure': KeyError: 'hit'"),
    "no opponent": (task(learners="a"), "Zoo does not say how b acts; define 'opponent'"),
    "exits": (task(at(2, lambda self, out: sys.exit(0))), "copy 0 of Zoo raises in 'step': SystemExit: 0"),
    "raises": (task(lambda self, out: {}["x\ny"]), "copy 0 of Zoo raises in 'step': KeyError"),
}  # fmt: skip


@pytest.mark.parametrize("name", MADE)
def test_what_no_task_can_be_made_of_is_refused(name):
    cls, sentence = MADE[name]
    with pytest.raises(UserError, match=sentence) as caught:
        worlds(cls)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", STEPPED)
def test_what_a_step_leaves_out_is_refused_and_is_one_broken_promise(name):
    cls, sentence = STEPPED[name]
    with pytest.raises(UserError, match=sentence) as caught:
        run(cls)
    assert "\n" not in str(caught.value)
    broken = [finding.broken for finding in check(Subject(lambda n, seeds: worlds(cls, n, seeds))) if finding.broken]
    assert len({text.translate(str.maketrans("", "", "0123456789")) for text in broken}) == 1


ENDING = {"terminates": True}
ONE_BY_ONE = {"terminates": True, "agents_end": True}
SPACES = {"a": spaces.Discrete(3), "b": spaces.Discrete(3)}
RIGHT = {
    "the control": (task(), "...c...c."),
    "terminated for all": (task(at(2, lambda self, out: [*out[:2], {"__all__": True}, {}, {}]), **ENDING), ".T.T.T.T."),
    "all beside each": (task(at(3, flag(OVER, "__all__")), **ENDING), "..T..T..T"),
    "cut for all": (task(at(2, lambda self, out: [*out[:2], {}, {"__all__": True}, {}]), **ENDING), ".c.c.c.c."),
    "all go on": (task(lambda self, out: [*out[:2], {"__all__": False}, {"__all__": False}, {}]), "...c...c."),
    "time limit": (task(at(2, flag(CUT, "a", "b")), **ENDING), ".c.c.c.c."),
    "out of bounds, one ends": (task(at(2, lambda s, o: (flag(CUT, "a")(s, o), flag(OVER, "b")(s, o))[0]), **ENDING),
                                ".T.T.T.T."),
    "one ends, one is cut": (task(at(2, lambda s, o: (flag(CUT, "a")(s, o), flag(OVER, "b")(s, o))[0]), **ONE_BY_ONE),
                             ".c.c.c.c."),
    "all leave": (task(at(2, go("a", "b", others=False)), **ENDING), ".T.T.T.T."),
    "all leave in silence": (task(at(2, go("a", "b")), **ENDING), ".T.T.T.T."),
    "one leaves": (task(at(2, go("b", others=False)), **ONE_BY_ONE), "...c...c."),
    "one leaves in silence": (task(at(1, go("b")), **ONE_BY_ONE), "...c...c."),
    "leaves and is cut": (task(lambda s, o: at(3, flag(CUT, "a", "b"))(s, o) or at(3, go("a", "b", others=False))(s, o),
                               **ENDING), "..c..c..c"),
    "numbers as flags": (task(put(OVER, {"a": 0, "b": np.False_})), "...c...c."),
    "arrays as flags": (task(put(OVER, {"a": np.array(False), "b": torch.tensor(False)})), "...c...c."),
    "spaces in a dictionary": (task(of={"action_space": SPACES}), "...c...c."),
    "action_spaces": (task(of={"action_space": None, "action_spaces": SPACES}), "...c...c."),
    "a list is read": (task(reading=lambda self, name, seen: seen.tolist()), "...c...c."),
    "a tensor is read": (task(reading=lambda self, name, seen: torch.tensor(seen).requires_grad_()), "...c...c."),
    "a half tensor is read": (task(reading=lambda self, name, seen: torch.tensor(seen).bfloat16()), "...c...c."),
    "a column is read": (task(reading=lambda self, name, seen: seen.reshape(2, 1)), "...c...c."),
    "rewards as arrays": (task(put(REWARD, {"a": np.ones(1), "b": torch.ones(())})), "...c...c."),
    "names are numbers": (task(of={"possible_agents": (0, 1)}), "...c...c."),
    "closing raises": (task(of={"close": lambda self: 1 / 0}), "...c...c."),
    "no last sight of one that ended": (task(at(2, lambda s, o: (flag(OVER, "a", "b")(s, o), put(SEEN, {})(s, o))[1]),
                                             **ENDING), ".T.T.T.T."),
    "no mask after the end": (task(masks=True, allowed=lambda self, name, seen, info: np.full(3, seen[1] < LENGTH)),
                              "...c...c."),
    "shared up to rounding": (task(put(REWARD, {"a": 0.1 + 0.2, "b": 0.3}), shared_reward=True), "...c...c."),
    "no list of agents": (task(of=NO_LIST), "...c...c."),
    "equal bounds": (box([-2, -2], [2, 2], "d4*agents"), "...c...c."),
    "unequal where nothing turns": (box([-1, -2], [1, 2], "agents"), "...c...c."),
    "unequal under half a turn": (box([-1, -2], [1, 2], "d2"), "...c...c."),
    "a metric at the end": (task(at(LENGTH, put(INFOS, {"a": {"won": 1}})), metrics=("won",)), "...c...c."),
    "off centre without a turn": (box([0, 0], [1, 3], "c1"), "...c...c."),
}  # fmt: skip


@pytest.mark.parametrize("name", RIGHT)
def test_what_is_unusual_and_right_runs_and_keeps_every_promise(name):
    cls, ends = RIGHT[name]
    assert run(cls) == ends
    findings = check(Subject(lambda n, seeds: worlds(cls, n, seeds)))
    assert [finding.broken for finding in findings if finding.broken] == []


def test_who_leaves_without_a_flag_is_gone_with_that_step():
    env = worlds(task(at(2, go("b", others=False)), **ONE_BY_ONE))
    seen = [env.reset(), *(env.step(env.random_action()).next for _ in range(3))]
    assert [observation.alive[0, 0].tolist() for observation in seen] == [[True, True]] * 2 + [[True, False]] * 2


def test_the_last_sight_of_a_truncated_episode_is_that_of_its_own_end():
    env = worlds(task(at(2, flag(CUT, "a", "b")), **ENDING))
    env.reset()
    steps = [env.step(env.random_action()) for _ in range(2)]
    assert steps[1].final.obs[..., 1].unique().tolist() == [2.0]
    assert steps[1].next.obs[..., 1].unique().tolist() == [0.0]


def nan(self, out):
    out[SEEN]["b"] = np.array([np.nan, 1.0])


NAMED = {
    "NaN in one observation": (task(at(2, nan)), "a result of 'step' is not finite"),
    "NaN in the last observation": (task(at(LENGTH, nan)), "a result of 'step' is not finite"),
    "NaN at the start": (task(of={"seen": lambda s: {n: np.array([s.x[n], np.nan]) for n in s.agents}}), "not finite"),
    "NaN reward": (task(at(1, put(REWARD, {"a": np.nan, "b": 1.0}))), "a result of 'step' is not finite"),
    "infinite reward": (task(at(1, put(REWARD, {"a": np.inf, "b": 1.0}))), "a result of 'step' is not finite"),
    "NaN that is shared": (task(put(REWARD, {"a": np.nan, "b": np.nan}), shared_reward=True), "is not finite"),
    "numpy's generator": (task(at(1, lambda s, o: o[REWARD].update(b=np.random.rand()))), "two runs of one seed"),  # noqa: NPY002
    "torch's generator": (task(at(1, lambda s, o: o[REWARD].update(b=float(torch.rand(()))))), "two runs of one seed"),
    "the clock": (task(at(1, lambda s, o: o[REWARD].update(b=time.perf_counter_ns() % 1e6))), "two runs of one seed"),
    "the seed is ignored": (
        task(of={"reset": lambda self, seed=None: Team.reset(self, next(vars(self).setdefault("calls", count())))}),
        "another seed gives",
    ),
    "deaf": (task(of={"step": lambda self, a: Team.step(self, dict.fromkeys(a, 0))}), "actions change nothing"),
}  # fmt: skip


@pytest.mark.parametrize("name", NAMED)
def test_what_check_names_it_names_alone(name):
    cls, sentence = NAMED[name]
    broken = [f.broken for f in check(Subject(lambda n, seeds: worlds(cls, n, seeds))) if f.broken]
    assert sentence in broken[0]
    if "NaN" in name:
        assert len(broken) == 1, "NaN equals NaN"


class Door(gymnasium.Env):
    """One agent, right in every point."""

    action_space = spaces.Discrete(3)
    agents = ("of the environment's own",)

    def reset(self, *, seed=None, options=None):
        self.x = float(np.random.default_rng(seed).normal())
        self.time = 0
        return np.array([self.x, 0.0]), {}

    def step(self, action):
        self.x, self.time = self.x + action, self.time + 1
        return np.array([self.x, self.time]), 1.0, False, self.time == LENGTH, {}


class DoorSettings(SingleAgentSettings):
    horizon: int = LENGTH
    workers: int | None = 0


def single(env=None, terminates=False, **members) -> type[SingleAgentTask]:
    made = type("Door", (Door,), members) if env is None else None
    own = {"make_single": lambda self: env if made is None else made()}
    shared = {name: getattr(Task, name) for name in ("observation", "action", "symmetry", "convention")}
    return type("One", (SingleAgentTask,), shared | own | {"Settings": DoorSettings, "terminates": terminates})


SINGLE = {
    "a team": (single(Team()), "'make_single' returns a PettingZoo ParallelEnv; derive from .*ParallelTask"),
    "a class": (single(Door), "'make_single' returns the class Door instead of an object"),
    "old reset": (single(reset=lambda self, seed=None: np.zeros(2)), "'reset' returns a ndarray; return .obs"),
    "reset twice": (single(reset=lambda self, seed=None: (1.0, 2.0)), "'reset' returns 2 parts; return .obs"),
    "old step": (single(step=lambda self, a: (np.zeros(2), 1.0, False, {})), "'step' returns 4 parts"),
    "a dictionary": (single(reset=lambda self, seed=None: ({"x": 1}, {})), "agent sees x, and the layout has"),
    "short": (single(step=lambda self, a: (np.zeros(2), 1.0, False, True, {})), "ends before its horizon; give both"),
}


@pytest.mark.parametrize("name", SINGLE)
def test_faults_of_a_gymnasium_environment_are_sentences(name):
    cls, sentence = SINGLE[name]
    with pytest.raises(UserError, match=sentence):
        run(cls)


def test_a_gymnasium_environment_may_have_agents_of_its_own():
    assert run(single()) == "...c...c."
    assert run(single(gymnasium.wrappers.TimeLimit(Door(), 2), terminates=True), num_envs=1) == ".c.c.c.c."


class Sick(Team):
    """Shows NaN from the start on, unless it is well; an action that is NaN is none."""

    well = True

    def reset(self, seed=None, options=None):
        seen, infos = super().reset(seed)
        return (seen if self.well else {name: row * np.nan for name, row in seen.items()}), infos

    def step(self, actions):
        assert all(np.isfinite(action).all() for action in actions.values())
        return super().step(actions)


class Ward(Task):
    """The copies of the second seed are sick."""

    env = Sick

    def _stepper(self, board, copies):
        stepper = super()._stepper(board, copies)
        for k, copy in stepper._copies.items():
            copy.env.well = k // self.num_envs != 1
        return stepper


class Pushed(Sick):
    def action_space(self, agent):
        return spaces.Box(-1.0, 1.0, (1,))


class PushedWard(Ward):
    env, action = Pushed, Continuous(layout(Field("push", Kind.SCALAR)))


SMALL = {"prior.kind": "none", "network.hidden": [8]}


@pytest.mark.parametrize(
    ("cls", "algorithm"), [(Ward, "mappo"), (Ward, "maddpg"), (Ward, "qmix"), (PushedWard, "mappo")]
)
def test_healthy_seeds_go_on_and_a_run_with_a_sick_one_resumes(cls, algorithm, tmp_path, monkeypatch):
    monkeypatch.setattr(TASKS, "_registered", {})
    own = {"num_envs": 2, **({"num_steps": LENGTH} if algorithm == "mappo" else {"warmup_episodes": 0})}
    settings = SMALL | {f"{algorithm}.{name}": value for name, value in own.items()}
    news = []

    def stop_once(progress):
        news.append(progress)
        return len(news) < 5

    one = train(cls, algorithm, steps=80, seeds=(3, 4, 5), settings=settings, out=tmp_path / "run", listener=stop_once)
    assert not one.is_complete
    assert one.train(news.append)
    notes = [note for progress in news for note in progress.notes]
    assert sum("seed 4 stopped" in note for note in notes) == 1
    assert not any(f"seed {seed} stopped" in note for note in notes for seed in (3, 5))
    last = one.metrics["eval/return_greedy"][-1]
    assert np.isfinite(last).tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("name", "sentence"), [("numpy's generator", "two runs of one seed"), ("NaN reward", "finite")]
)
def test_a_training_begins_with_a_note_of_what_is_broken(name, sentence, tmp_path, monkeypatch):
    monkeypatch.setattr(TASKS, "_registered", {})
    for cls, expected in ((NAMED[name][0], rf"breaks a promise: .*{sentence}"), (task(), "^looked at .* fit the spec")):
        (note,) = first_look(resolve_config(register(cls), "mappo", steps=8, overrides=SMALL))
        assert re.search(expected, note)
        assert "esp check task" in note
    assert first_look(resolve_config("navigation", "mappo", steps=8)) == []
    monkeypatch.setattr("esp_cli.training.build._LOOK_SECONDS", -1.0)
    (note,) = first_look(resolve_config(register(task()), "mappo", steps=8, overrides=SMALL))
    assert re.search("nothing to its end; there was no time for: observations .*, the same seed .* run; 'esp", note)


def test_what_one_start_or_one_step_cannot_show_is_not_asked():
    always = task(of={"reset": lambda self, seed=None: Team.reset(self, 1)})
    for make_one, reason in (
        (lambda n, seeds: worlds(always, n, seeds), "every episode starts alike"),
        (lambda n, seeds: make("navigation", n, seeds, {"horizon": 1}), "an episode is one step"),
    ):
        found = list(check(Subject(make_one)))
        assert [finding.broken for finding in found if finding.broken] == []
        assert reason in {finding.not_asked for finding in found}


@pytest.mark.parametrize("workers", [0, 1])
def test_what_raises_in_the_users_code_is_named_with_its_line(monkeypatch, workers):
    def opponent(self, name, seen, rng):
        return {}["x"]

    monkeypatch.setattr(installed, "_FOREIGN", {__name__.partition(".")[0]})
    cls = task(learners="a", opponent=opponent)
    env = cls(TeamSettings(workers=workers), 1, generators_for((3,)))
    env.reset()
    with pytest.raises(UserError, match=r"in 'opponent': KeyError: 'x', in 'opponent' \(test_hostile_zoo.py, line \d+"):
        env.step(env.random_action())
