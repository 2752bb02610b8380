"""Tasks derived from `BatchedTask`: ends, masks, memory, and what optional methods answer where a task lacks them."""

import re
import runpy
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from esp_envs import BatchedTask, Body, Environment, Field, Kind, Scene, generators_for, layout, make, to_others
from esp_envs.conformance import PROMISES, Broken, NotAsked, Subject, check
from esp_envs.mpe.task import MOVES
from esp_envs.spec import Continuous, TaskSpec, discrete_moves
from tests.own_tasks import lines_of, page_files, save_page_files


@pytest.fixture(scope="module")
def rendezvous(tmp_path_factory: pytest.TempPathFactory) -> type[Environment]:
    folder = tmp_path_factory.mktemp("page")
    save_page_files(folder)
    return runpy.run_path(str(folder / "rendezvous.py"))["Rendezvous"]


def worlds(cls: type[Environment], num_envs: int = 5, seeds: Sequence[int] = (3, 7), **settings) -> Environment:
    return cls(cls.Settings(**settings), num_envs, generators_for(seeds))


def test_the_task_of_the_page_keeps_every_promise(rendezvous: type[Environment]) -> None:
    findings = list(check(Subject(lambda num_envs, seeds: worlds(rendezvous, num_envs, seeds))))
    assert [finding for finding in findings if finding.broken] == []
    assert [f.promise for f in findings if f.not_asked] == []


def test_the_task_of_the_page_that_ends_early_keeps_every_promise(tmp_path: Path, monkeypatch) -> None:
    save_page_files(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    meeting = runpy.run_path(str(tmp_path / "meeting.py"))["Meeting"]
    findings = list(check(Subject(lambda num_envs, seeds: worlds(meeting, num_envs, seeds))))
    assert [finding for finding in findings if finding.broken] == []
    env = worlds(meeting, 20)
    env.reset()
    steps = [env.step(env.heuristic()) for _ in range(25)]
    assert sum(int(step.terminated.sum()) for step in steps) >= 40, "every world has met"
    assert all(torch.equal(step.terminated, step.metrics["met"].bool()) for step in steps)


def test_a_complete_task_is_short() -> None:
    assert lines_of(page_files()["rendezvous.py"]) <= 45


def test_the_heuristic_of_the_page_beats_chance(rendezvous: type[Environment]) -> None:
    returns = {}
    for name, choose in (("random", "random_action"), ("middle", "heuristic")):
        env = worlds(rendezvous, 50)
        env.reset()
        returns[name] = sum(float(env.step(getattr(env, choose)()).reward.mean()) for _ in range(25))
    assert returns["middle"] > returns["random"] + 5


class Plain(BatchedTask):
    """A point that drifts; it has nothing that is optional, and each subclass below breaks one promise."""

    def _describe(self) -> TaskSpec:
        return TaskSpec(
            name="plain",
            version=1,
            convention="none",
            num_agents=2,
            horizon=4,
            observation=layout(Field("position", Kind.VECTOR)),
            state=layout(Field("position", Kind.VECTOR, 2)),
            action=Continuous(layout(Field("push", Kind.VECTOR), Field("turn", Kind.PSEUDOSCALAR))),
            symmetry="o2*agents",
            shared_reward=False,
        )

    def _start(self, generator):
        return {"position": self.draw(2, 2, generator=generator)}

    def _advance(self, world, action):
        world["position"] = world["position"] + action[..., :2] + action[..., 2:]
        return -world["position"].norm(dim=-1), {"x": world["position"][..., 0].mean(-1)}

    def _observe(self, world):
        return world["position"]


def test_a_state_that_was_set_stays_the_callers() -> None:
    class InPlace(Plain):
        def _advance(self, world, action):
            world["position"] += 1.0
            return super()._advance(world, action)

    env = worlds(InPlace)
    state = env.reset().state
    before = state.clone()
    env.set_state(state)
    assert not torch.equal(env.step(env.random_action()).next.state, before)
    assert torch.equal(state, before)


def test_actions_beyond_the_bounds_are_taken_as_the_nearest_within() -> None:
    action = torch.tensor([[3.0, -4.0, 2.0], [0.3, -0.4, -1.5], [0.0, 0.0, 0.25]])
    given = action.clone()
    expected = torch.tensor([[0.6, -0.8, 1.0], [0.3, -0.4, -1.0], [0.0, 0.0, 0.25]])
    assert torch.allclose(worlds(Plain).spec.action.admissible(action), expected)
    assert torch.equal(action, given)
    many = Continuous(layout(Field("wheels", Kind.WHEELS), Field("pushes", Kind.VECTOR, 2)))
    row = torch.tensor([2.0, -3.0, 0.0, 5.0, 0.6, 0.8])
    assert torch.allclose(many.admissible(row), torch.tensor([1.0, -1.0, 0.0, 1.0, 0.6, 0.8]))


def test_vectors_of_a_kind_of_ones_own_are_bounded_by_their_length() -> None:
    row = torch.tensor([2.0, -3.0, 6.0, 0.2, 0.3, 0.6])  # lengths 7 and 0.7
    velocities = Continuous(layout(Field("velocities", Kind("velocity", 3, is_vector=True), 2)))
    assert torch.allclose(velocities.admissible(row), torch.tensor([2 / 7, -3 / 7, 6 / 7, 0.2, 0.3, 0.6]))
    numbers = Continuous(layout(Field("numbers", Kind("triple", 3), 2)))
    assert numbers.admissible(row).tolist() == row.clamp(-1, 1).tolist(), "the control"


@pytest.mark.parametrize("method", ["heuristic", "scene", "set_state"])
def test_what_a_task_lacks_is_said_in_one_sentence(method: str, rendezvous: type[Environment]) -> None:
    class Bare(Plain):
        set_state = Environment.set_state

    env = worlds(Bare)
    env.reset()
    assert not env.has(method)
    assert worlds(rendezvous).has(method)
    with pytest.raises(ValueError, match=f"task plain .*its class has no '{method}'"):
        getattr(env, method)(*([torch.zeros(2, 5, 4)] if method == "set_state" else []))


def test_actions_arrive_within_their_bounds() -> None:
    seen = []

    class Watching(Plain):
        def _advance(self, world, action):
            seen.append(action)
            return super()._advance(world, action)

    env = worlds(Watching)
    env.reset()
    env.step(torch.tensor([3.0, -4.0, 7.0]).expand(2, 5, 2, 3))
    torch.testing.assert_close(seen[0][0, 0, 0], torch.tensor([0.6, -0.8, 1.0]))


@pytest.mark.parametrize(
    ("method", "value", "sentence"),
    [
        ("_living", torch.ones(2, 5, 1, dtype=torch.bool), r"'_living' has shape \(2, 5, 1\), expected \(2, 5, 2\)"),
        ("_living", torch.ones(2, 5, 2), "'_living' is torch.float32, expected torch.bool"),
        (
            "_allow",
            torch.ones(2, 5, 1, 5, dtype=torch.bool),
            r"'_allow' has shape \(2, 5, 1, 5\), expected \(2, 5, 2, 5\)",
        ),
        ("_allow", torch.ones(2, 5, 2, 5), "'_allow' is torch.float32, expected torch.bool"),
        ("_ended", torch.ones(2, dtype=torch.bool), r"'_ended' has shape \(2,\), expected \(2, 5\)"),
        ("_start", {"position": torch.zeros(5, 2, 2, dtype=torch.int64)}, "_start' of plain drew is torch.int64; give"),
        ("_start", {"position": torch.zeros(5, 2)}, r"'position' has shape \(5, 2\) in what '_start' of plain drew"),
        (
            "_observe",
            torch.zeros(2, 5, 2, 2, 2),
            r"observation that '_observe' of plain gives has shape \(2, 5, 2, 4\), expected \(2, 5, 2, 2\)",
        ),
        (
            "_advance",
            (torch.zeros(2, 5, 2), {"met": torch.zeros(())}),
            r"the metric met that '_advance' of plain gives has shape \(\), expected \(2, 5\)",
        ),
    ],
)
def test_tensors_of_another_shape_are_refused(method: str, value, sentence: str) -> None:
    def describe(self) -> TaskSpec:
        extras = {
            "_living": {"agents_end": True},
            "_allow": {"masks": True, "action": MOVES},
            "_ended": {"terminates": True},
        }
        return replace(Plain._describe(self), **extras.get(method, {}))

    cls = type("Odd", (Plain,), {"_describe": describe, method: lambda self, *_: value})

    def play() -> None:
        env = worlds(cls)
        env.reset()
        env.step(env.random_action())

    with pytest.raises(ValueError, match=sentence):
        play()


@pytest.mark.parametrize("choice", [torch.tensor(5), torch.tensor(-1), torch.tensor(1.0)])
def test_choices_that_are_none_are_refused(choice: torch.Tensor) -> None:
    env = make("navigation", 2, [0])
    env.reset()
    env.step(torch.full(env.action_shape, 4))
    with pytest.raises(ValueError, match="joint action holds other than the indices 0 to 4"):
        env.step(choice.expand(env.action_shape))


@pytest.mark.parametrize("given", ["go", ["go"], (1,)])
def test_heuristics_are_a_tuple_of_names(given) -> None:
    told = re.escape(f"Odd.heuristics is {given!r}; give a tuple of names, as ('nearest',)")
    with pytest.raises(ValueError, match=told):
        worlds(type("Odd", (Plain,), {"heuristics": given}))


@pytest.mark.parametrize("moves", [4.0, None])
def test_moves_are_a_number_or_names(moves: object) -> None:
    with pytest.raises(ValueError, match="is neither a number of directions nor their names"):
        discrete_moves(moves)


@pytest.mark.parametrize("switch", ["terminates", "masks", "agents_end"])
@pytest.mark.parametrize("has_method", [True, False])
def test_a_method_and_its_switch_in_the_spec_go_together(switch: str, has_method: bool) -> None:
    method, shape = {"terminates": ("_ended", ()), "masks": ("_allow", (2, 5)), "agents_end": ("_living", (2,))}[switch]

    def describe(self) -> TaskSpec:
        return replace(Plain._describe(self), action=MOVES, **({} if has_method else {switch: True}))

    def advance(self, world, action):
        return -world["position"].norm(dim=-1), {}

    own = {method: lambda self, world: torch.ones(2, 5, *shape, dtype=torch.bool)} if has_method else {}
    env = worlds(type("Half", (Plain,), {"_describe": describe, "_advance": advance, **own}))
    with pytest.raises(ValueError, match=f"plain: implement '{method}' and set '{switch}' in the spec, or do neither"):
        env.reset(), env.step(env.random_action())


class Climb(Plain):
    """Heights that rise by what chance has drawn before the episode; an episode is over at 2."""

    def _describe(self) -> TaskSpec:
        height = layout(Field("height", Kind.SCALAR))
        own = {"terminates": True, "shared_reward": True, "symmetry": "c1", "hidden": ("rises",)}
        return replace(super()._describe(), observation=height, state=height, **own)

    def _start(self, generator):
        rise = torch.rand(self.num_envs, self.spec.horizon, generator=generator)
        return {
            "height": self.draw(1, 1, generator=generator),
            "rise": rise,
            "steps": torch.zeros(self.num_envs).long(),
        }

    def _advance(self, world, action):
        rise = world["rise"].gather(-1, world["steps"].unsqueeze(-1) % 4)
        world["height"] = world["height"] + rise.unsqueeze(-1) + 0.2 * (1 + action[..., :1, 2:])
        world["steps"] = world["steps"] + 1
        return world["height"].flatten(2).sum(-1), {}

    def _observe(self, world):
        return world["height"].expand(-1, -1, 2, -1)

    def _ended(self, world):
        return world["height"][..., 0, 0] > 2


def test_a_task_whose_worlds_end_apart_and_remember_keeps_every_promise() -> None:
    findings = {f.promise: f for f in check(Subject(lambda num_envs, seeds: worlds(Climb, num_envs, seeds)))}
    assert [finding for finding in findings.values() if finding.broken] == []
    assert not findings["a saved environment goes on bit for bit"].not_asked


def test_a_world_that_ends_begins_anew_alone() -> None:
    env = worlds(Climb, 1000, (3,))
    env.reset()
    age = torch.zeros(1, 1000)
    for _ in range(12):
        step = env.step(torch.zeros(env.action_shape))
        age += 1
        assert torch.equal(step.terminated, step.final.state[..., 0] > 2)
        assert torch.equal(step.truncated, (age == 4) & ~step.terminated)
        ended = step.ended
        assert torch.equal(step.next.state[~ended], step.final.state[~ended])
        assert bool((step.next.state[ended].abs() <= 1).all()), "a start"
        age[ended] = 0
        assert torch.equal(env.world["steps"].float(), age), "what a world remembers begins anew with it"
        assert 0 < int(step.terminated.sum()) < 1000 or bool((age <= 1).all())


def test_what_a_world_remembers_is_saved_and_left_alone_by_set_state() -> None:
    env, other = worlds(Climb), worlds(Climb, seeds=(100, 101))
    env.reset()
    env.step(env.random_action())
    saved = env.state_dict()
    assert {name for name in saved if name.startswith("world")} == {"world", "world.rise", "world.steps"}
    other.load_state_dict(saved)  # before any reset of its own
    assert torch.equal(other.world["rise"], env.world["rise"])
    rise = env.world["rise"].clone()
    env.set_state(torch.zeros(env.state_shape))
    assert torch.equal(env.world["rise"], rise)
    del saved["world.rise"], saved["world.steps"]  # as a run of before wrote it
    env.load_state_dict(saved)
    assert torch.equal(env.state_dict()["world"], saved["world"])


def test_what_a_world_remembers_is_drawn_first() -> None:
    class Remembers(Plain):
        def _advance(self, world, action):
            world["last"] = action
            return super()._advance(world, action)

    class Draws(Remembers):
        def _start(self, generator):
            return super()._start(generator) | {"last": torch.zeros(self.num_envs, 2, 3)}

    env = worlds(Remembers)
    env.reset()
    with pytest.raises(ValueError, match="'_advance' of plain adds 'last' to the world, which '_start' did not draw"):
        env.step(env.random_action())
    env = worlds(Draws)
    env.reset()
    action = env.random_action()
    env.step(action)
    assert torch.equal(env.state_dict()["world.last"], env.spec.admissible(action))


def test_others_are_seen_in_index_order() -> None:
    position = torch.tensor([[0.0], [1.0], [10.0]])
    assert to_others(position).squeeze(-1).tolist() == [[1.0, 10.0], [-1.0, 9.0], [-10.0, -9.0]]
    assert to_others(position[:1]).shape == (1, 0, 1)


class EarlyClock(Plain):
    def step(self, action):
        self._time = self.spec.horizon - 1 if self._time >= 2 else self._time
        return super().step(action)


class Ended(Plain):
    def step(self, action):
        step = super().step(action)
        return replace(step, terminated=step.truncated, truncated=step.terminated)


class Endless(Climb):
    def step(self, action):
        step = super().step(action)
        return replace(step, terminated=step.terminated & False, final=None)


class Unequal(Plain):
    def _describe(self):
        return replace(super()._describe(), shared_reward=True)

    def _advance(self, world, action):
        self._unproven = 0  # as after the first episode, in which the task itself would notice
        return super()._advance(world, action)


class GlobalDice(Plain):
    def _advance(self, world, action):
        reward, metrics = super()._advance(world, action)
        return reward + torch.rand(()), metrics


class Leaky(Plain):
    def _play(self, action):
        action[..., 0] += 1
        return super()._play(action)


class NoRestart(Plain):
    def set_state(self, state):
        time = self._time
        seen = super().set_state(state)
        self._time = time
        return seen


class Rolling(Plain):
    """It has a speed, which the state leaves out, from rest."""

    def _start(self, generator):
        return super()._start(generator) | {"speed": torch.zeros(self.num_envs, 2, 2)}

    def _advance(self, world, action):
        world["speed"] = world["speed"] + action[..., :2]
        world["position"] = world["position"] + world["speed"]
        return super()._advance(world, action)


class RollingOn(Rolling):
    """Its first speed is drawn."""

    def _start(self, generator):
        return super()._start(generator) | {"speed": self.draw(2, 2, generator=generator)}


class RollingOut(Rolling):
    """Its episodes end early, so that steps begin others, which chance draws."""

    def _describe(self):
        return replace(super()._describe(), terminates=True)

    def _ended(self, world):
        return world["position"].abs().amax((-1, -2)) > 1


def plain(**methods: object) -> type[Environment]:
    return type("_".join(methods), (Plain,), methods)


class Matrix(Plain):
    """A game of one state, in which every episode starts and ends."""

    def _start(self, generator):
        return {"position": torch.zeros(self.num_envs, 2, 2)}

    def _advance(self, world, action):
        return action.sum(-1), {}

    def scene(self, world=(0, 0)):
        return Scene((Body((0.0, 0.0), 0.1, "#000000"),) * 2, (-1, 1, -1, 1))


def going_on(env: Plain):
    """Return the world as it is, but for the first time."""
    return env.world if env.world["position"].any() else Plain._episodes(env)


def test_a_game_of_one_state_breaks_no_promise() -> None:
    findings = check(Subject(lambda num_envs, seeds: worlds(Matrix, num_envs, seeds)))
    assert [finding for finding in findings if finding.broken] == []


BREAKERS = {
    "observations_rewards_and_metrics_fit_the_spec": [plain(_observe=lambda _, world: world["position"] / 0), Unequal],
    "actions_of_heuristics_and_chance_lie_in_the_action_space": [
        plain(heuristics=("far",), heuristic=lambda self, name=None: torch.full(self.action_shape, 3.0))
    ],
    "episodes_end_when_the_spec_says": [
        *(EarlyClock, Endless, Ended),
        plain(_episodes=going_on, _start=Matrix._start),  # begins alike, and ends elsewhere
        plain(_episodes=going_on, _advance=Matrix._advance),  # each stands where it began
    ],
    "the_same_seed_gives_the_same_run": [GlobalDice],
    "a_seed_alone_equals_itself_among_others": [
        plain(_episodes=lambda self: {"position": self.draw(2, 2) + torch.randn(1, generator=self.generators[0])})
    ],
    "worlds_do_not_touch_each_other": [
        plain(_advance=lambda self, world, a: Plain._advance(self, world, a + a.mean((0, 1), keepdim=True)))
    ],
    "results_are_memory_of_their_own": [Leaky],
    "a_saved_environment_goes_on_bit_for_bit": [
        plain(state_dict=lambda self: Plain.state_dict(self) | {"time": torch.tensor(0)})
    ],
    "an_environment_of_another_size_is_refused": [
        plain(load_state_dict=lambda self, tensors: setattr(self, "world", self._split(tensors["world"])))
    ],
    "a_joint_action_of_the_wrong_shape_is_refused": [
        plain(step=lambda self, action: Plain.step(self, action.reshape(self.action_shape)))
    ],
    "set_state_reproduces_what_follows": [
        *(Rolling, RollingOn, RollingOut),
        plain(_put=lambda self, state: Plain._put(self, state * 2)),
    ],
    "set_state_starts_an_episode": [NoRestart],
    "a_scene_can_be_drawn": [
        plain(scene=lambda self, world=(0, 0): Scene((), (0, 1, 0, world[0] + 1))),
        plain(scene=Matrix.scene),
    ],
}
BY_NAME = {promise.__name__: promise for promise in PROMISES}


@pytest.mark.parametrize(("name", "cls"), [(name, cls) for name, many in BREAKERS.items() for cls in many])
def test_a_task_that_breaks_a_promise_is_found(name: str, cls: type[Environment]) -> None:
    with pytest.raises(Broken):
        BY_NAME[name](Subject(lambda num_envs, seeds: worlds(cls, num_envs, seeds)))
    try:
        BY_NAME[name](Subject(lambda num_envs, seeds: worlds(Plain, num_envs, seeds)))
    except NotAsked as reason:
        assert "picture" in str(reason)  # noqa: PT017


def test_what_a_world_keeps_is_no_memory_where_chance_alone_decides() -> None:
    class Counting(Plain):
        def _start(self, generator):
            return super()._start(generator) | {"steps": self.draw(1, generator=generator)}

        def _advance(self, world, action):
            world["steps"] = world["steps"] + 1
            return super()._advance(world, action + self.draw(2, 3))

    with pytest.raises(NotAsked, match="the task has chance of its own"):
        BY_NAME["set_state_reproduces_what_follows"](Subject(lambda count, seeds: worlds(Counting, count, seeds)))


def test_a_task_that_raises_is_a_finding_too() -> None:
    class Raising(Plain):
        def _advance(self, world, action):
            raise KeyError("speed")

    findings = list(check(Subject(lambda num_envs, seeds: worlds(Raising, num_envs, seeds))))
    assert findings[0].broken == "KeyError: 'speed'"
    assert len(findings) == len(PROMISES)


def test_a_check_that_has_no_time_says_what_it_did_not_cover_and_nothing_holds_unseen() -> None:
    late = Subject(lambda count, seeds: make("navigation", count, seeds), deadline=time.monotonic() - 1)
    findings = {finding.promise: finding for finding in check(late)}
    assert len(findings) == len(PROMISES)
    assert not any(finding.broken for finding in findings.values())
    ends = findings["episodes end when the spec says"]
    assert ends.not_covered == "the time was over after 0 of 53 steps"
    assert findings["a joint action of the wrong shape is refused"].not_covered is None
    done = check(Subject(lambda count, seeds: make("navigation", count, seeds)))
    assert not any(finding.not_covered for finding in done), "without a deadline all is looked at"


@pytest.mark.parametrize("task", ["navigation", "predator-prey", "wildlife", "formation"])
def test_worlds_that_do_not_measure_give_the_same_steps_without_metrics(task: str) -> None:
    measuring, quiet = (make(task, 3, [5]) for _ in range(2))
    quiet.measures = False
    for env in (measuring, quiet):
        env.reset()
    for _ in range(4):
        action = measuring.random_action()
        assert torch.equal(action, quiet.random_action())
        both = [env.step(action) for env in (measuring, quiet)]
        assert set(measuring.spec.totals) <= both[0].metrics.keys() != {}
        assert both[1].metrics == {}
        assert torch.equal(both[0].reward, both[1].reward)
        assert torch.equal(both[0].next.obs, both[1].next.obs)
        assert torch.equal(both[0].next.state, both[1].next.state)
