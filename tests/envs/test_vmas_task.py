"""VMAS scenarios as tasks, compared with VMAS itself."""

from __future__ import annotations

import sys
from dataclasses import replace

import pytest
import torch

from esp_cli.checking import check_symmetry
from esp_cli.symmetry import build_transform, parse_elements
from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config
from esp_envs import Environment, Field, Items, Kind, UserError, generators_for, layout, make, register
from esp_envs.adapters import seed_of
from esp_envs.adapters.simulation import groups_of
from esp_envs.conformance import Subject, check, set_state_reproduces_what_follows
from esp_envs.promises import a_scene_can_be_drawn
from esp_envs.views import OthersAtRandom, RoleView, worlds_of_role
from tests.own_tasks import save_page_files

vmas = pytest.importorskip("vmas", reason="VMAS comes with the extra 'vmas'")
from esp_envs.adapters import vmas_scenarios  # noqa: E402
from esp_envs.adapters.vmas import VmasTask  # noqa: E402
from tests.symmetry.checks import environment_errors  # noqa: E402

CASES = [
    ("Navigation", {}),
    ("Navigation", {"num_agents": 3, "collisions": False}),
    ("Transport", {"num_agents": 3}),
    ("Transport", {"num_agents": 2, "n_packages": 2}),
    ("Balance", {}),
    ("Dispersion", {"num_agents": 3}),
    ("Dispersion", {"n_food": 2, "share_reward": True}),
]
ANEW = "a run that is resumed begins new episodes"
cases = pytest.mark.parametrize(("name", "settings"), CASES, ids=str)


def worlds(name: str, settings, num_envs: int = 5, seeds=(3, 7), device: str = "cpu") -> Environment:
    return make(register(f"esp_envs.adapters.vmas_scenarios:{name}"), num_envs, seeds, settings, device)


@pytest.mark.parametrize(("name", "settings"), CASES[::2], ids=str)
def test_a_scenario_keeps_every_promise(name: str, settings) -> None:
    short = {**settings, "horizon": 6}
    findings = list(check(Subject(lambda n, seeds: worlds(name, short, n, seeds), rounding=1e-4)))
    assert [finding for finding in findings if finding.broken] == []
    assert [f.not_asked for f in findings if f.not_asked] == [ANEW] * 2


def test_agents_of_dispersion_fly_to_the_nearest_piece_or_each_to_its_own_until_it_is_eaten() -> None:
    env = worlds("Dispersion", {"num_agents": 2, "n_food": 3}, num_envs=1, seeds=(0,))
    # places and velocities of both agents at 0, then three pieces of food and which are eaten
    state = torch.tensor([0.0] * 8 + [0.0, 0.8, 0.6, 0.8, 0.3, 0.0] + [0, 0, 0]).view(env.state_shape)
    env.set_state(state)
    assert env.heuristic("nearest")[0, 0].tolist() == [[1, 0], [1, 0]]
    torch.testing.assert_close(env.heuristic()[0, 0], torch.tensor([[0, 1], [0.6, 0.8]]))
    state[..., [14, 16]] = 1.0  # the first and the last
    env.set_state(state)
    torch.testing.assert_close(env.heuristic("apart")[0, 0], torch.tensor([[0.6, 0.8], [0.6, 0.8]]))


def test_arguments_that_a_scenario_does_not_know_are_refused() -> None:
    class Careless(vmas_scenarios.Transport):
        def arguments(self):
            return super().arguments() | {"wind": 3}

    with pytest.raises(ValueError, match=r"the VMAS scenario 'transport' has no arguments \{'wind': 3\}"):
        Careless(Careless.Settings(), 2, generators_for((0,)))


@cases
def test_a_task_gives_the_numbers_of_vmas_itself(name: str, settings) -> None:
    task = worlds(name, settings, 6, (5,))
    start = task.reset()
    theirs = vmas.make_env(task.scenario, 6, seed=0, **task.arguments())
    seed = seed_of(int(task._base[0]), 0)
    seen = task.reading(torch.stack(theirs.reset(seed=seed), 1))
    torch.testing.assert_close(start.obs[0], seen, rtol=0, atol=0)
    for _ in range(20):
        action = task.random_action()
        force = action[0] / action[0].norm(dim=-1, keepdim=True).clamp_min(1.0)
        step = task.step(action)
        seen, reward, done, _ = theirs.step(
            [f * a.u_range for f, a in zip(force.unbind(1), theirs.agents, strict=True)]
        )
        torch.testing.assert_close(step.final.obs[0], task.reading(torch.stack(seen, 1)), rtol=0, atol=0)
        torch.testing.assert_close(step.reward[0], torch.stack(reward, 1), rtol=0, atol=0)
        assert torch.equal(step.terminated[0], done)
        if done.any():
            break


@cases
def test_every_declared_element_holds(name: str, settings) -> None:
    probe = worlds(name, settings, 1, (0,))
    found = parse_elements(probe.spec.symmetry.replace("o2", "d4"), probe.spec.num_agents)
    elements = found if isinstance(found, tuple) else found.generators()
    elements = elements[:: max(1, len(elements) // 8)]
    env = worlds(name, settings, 16, range(len(elements)))
    state = env.reset().state
    for _ in range(5):
        state = env.step(env.random_action()).next.state
    actions = [env.random_action() for _ in range(4)]
    errors = environment_errors(env, build_transform(elements, env.spec), state, actions)
    assert max(errors.values()) < 2e-3, errors


@pytest.mark.parametrize("role", ["agent_blue", "agent_red"])
def test_a_pitch_has_one_mirror_for_each_team(role: str) -> None:
    made = worlds_of_role(lambda num_envs, seeds: worlds("Football", {}, num_envs, seeds), role)
    found = check_symmetry(made, "flip-x,flip-y,agents-1-0-2")
    mirror, other, order = ({field.outcome for field in one.fields if field.field != "end"} for one in found.elements)
    assert (mirror, "broken" in other, order) == ({"holds"}, True, {"holds"})
    assert {f.outcome for one in found.elements for f in one.fields if f.field == "end"} == {"not covered"}, "no goal"


def test_cells_around_an_agent_are_a_ring() -> None:
    east, west, north, south, south_west, south_east, north_west, north_east = range(8)
    shown = torch.cat([torch.zeros(16), torch.arange(8.0)])
    ring = [east, north_east, north, north_west, west, south_west, south, south_east]
    assert vmas_scenarios._samples_around(None, shown)[16:].tolist() == ring


def test_gravity_breaks_a_quarter_turn() -> None:
    env = worlds("Balance", {}, 16, (0,))
    state = env.reset().state
    transform = build_transform(parse_elements("rot90", 3), env.spec)
    errors = environment_errors(env, transform, state, [env.random_action() for _ in range(4)])
    assert errors["next_state"] > 0.005


def test_worlds_that_end_at_different_times_begin_their_own_episodes() -> None:
    env = worlds("Balance", {"horizon": 60}, 20, (0,))
    env.reset()
    ended = torch.zeros(1, 20)
    for _ in range(100):
        step = env.step(env.random_action())
        ended += step.terminated | step.truncated
    assert ended.unique().numel() > 1
    alone = worlds("Balance", {"horizon": 60}, 20, (0,))
    first = alone.reset()
    assert not torch.equal(first.state, step.next.state)


def test_chance_inside_a_step_belongs_to_the_seed() -> None:
    class Noisy(vmas_scenarios.Transport):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            for sim in self._sims:
                for agent in sim.agents:
                    agent.action._u_noise = 0.5

    settings = Noisy.Settings(num_agents=2, horizon=12)
    subject = Subject(lambda n, seeds: Noisy(settings, n, generators_for(seeds)))
    findings = {f.promise: f for f in check(subject)}
    assert [f for f in findings.values() if f.broken] == []
    assert findings["set state reproduces what follows"].not_asked == "the task has chance of its own"


UNTOLD = {
    "BallTrajectory": {"angles to the last digit"},
    "BuzzWire": {"angles to the last digit"},
    "Flocking": {"the clock"},
    "JointPassage": {"angles to the last digit"},
    "JointPassageSize": {"angles to the last digit", "which passage is big"},
    "Football": {"forces of the last step"},
    "GiveWay": {"what controllers remember"},
    "MultiGiveWay": {"what controllers remember"},
    "WindFlocking": {"what controllers remember"},
    "ReverseTransport": set(),  # all of it is in the state, and its episodes may end in the first steps
}


@pytest.mark.parametrize("name", UNTOLD)
def test_a_scenario_says_what_its_state_leaves_out(name: str) -> None:
    promises = (set_state_reproduces_what_follows, a_scene_can_be_drawn)
    subject = Subject(lambda n, seeds: worlds(name, {"horizon": 7}, n, seeds), rounding=1e-3)
    followed, drawn = check(subject, promises)
    assert (followed.broken, drawn.broken) == (None, None)
    assert set(worlds(name, {}).spec.hidden) == UNTOLD[name]
    assert (followed.not_asked is None) == (not UNTOLD[name])


def test_the_angle_of_a_goal_is_in_the_state_where_an_episode_draws_it() -> None:
    env, other = (worlds("JointPassage", {}, 4, (seed,)) for seed in (0, 5))
    start = env.reset()
    assert not torch.allclose(start.obs, other.reset().obs)
    torch.testing.assert_close(other.set_state(start.state).obs, start.obs)
    slices, seen = env.spec.state.slices(), env.spec.observation.slices()["goal_direction"]
    torch.testing.assert_close(start.state[..., slices["joint_goal.heading"]], start.obs[:, :, 0, seen])
    assert "joint_goal.spin" not in slices


def test_a_layout_of_another_width_is_refused() -> None:
    class Narrow(vmas_scenarios.Transport):
        def seen(self):
            return layout(Field("position", Kind.VECTOR))

    with pytest.raises(ValueError, match="the scenario shows 11 numbers to an agent, but the layout has 2"):
        Narrow(Narrow.Settings(), 2, generators_for([0]))


@pytest.mark.parametrize("name", ["Passage", "Football", "WindFlocking"])
def test_a_scenario_of_a_fixed_team_takes_no_other_number(name: str) -> None:
    cls = getattr(vmas_scenarios, name)
    with pytest.raises(ValueError, match="num_agents"):
        cls.Settings(num_agents=cls.Settings().num_agents + 1)


def test_arguments_that_a_scenario_does_not_take_are_refused() -> None:
    class Odd(vmas_scenarios.Balance):
        def arguments(self):
            return super().arguments() | {"n_agents": 1}

    with pytest.raises(ValueError, match=r"VMAS does not make 'balance' with \{'n_agents': 1"):
        Odd(Odd.Settings(), 2, generators_for([0]))


def test_a_metric_that_no_info_holds_and_a_scenario_that_calls_exit_are_one_sentence_each(monkeypatch) -> None:
    class Misspelt(vmas_scenarios.Navigation):
        metrics = ("agent_colisions",)

    task = Misspelt(Misspelt.Settings(), 2, generators_for([0]))
    task.reset()
    with pytest.raises(UserError, match=r"has no metric 'agent_colisions'; it has pos_rew, .*agent_collisions"):
        task.step(task.random_action())
    task.metrics = ()
    monkeypatch.setattr(type(task._sims[0].scenario), "reward", lambda *_: sys.exit(0))
    with pytest.raises(UserError, match="the VMAS scenario raises SystemExit: 0"):
        task.step(task.random_action())


def test_goals_that_are_not_one_for_each_agent_are_refused() -> None:
    class Shared(vmas_scenarios.Transport):
        own_goals = "package"

    with pytest.raises(ValueError, match=r"1 landmarks are named 'package\.\.\.' for 4 agents"):
        Shared(Shared.Settings(), 2, generators_for([0]))


def test_without_vmas_one_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "vmas", None)
    with pytest.raises(ValueError, match=r"pip install 'vmas>=[\d.]+'"):
        worlds("Transport", {})


def test_a_scenario_of_ones_own_layout_keeps_every_promise(tmp_path, monkeypatch) -> None:
    save_page_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    name = register("passage:Passage")
    findings = list(check(Subject(lambda n, seeds: make(name, n, seeds, {"horizon": 6}), rounding=1e-4)))
    assert [finding for finding in findings if finding.broken] == []
    assert [f.not_asked for f in findings if f.not_asked] == [ANEW] * 2


@pytest.mark.gpu
@cases
def test_a_gpu_runs_the_same_task(name: str, settings) -> None:
    findings = list(check(Subject(lambda n, seeds: worlds(name, {**settings, "horizon": 8}, n, seeds, "cuda"), 1e-3)))
    assert [finding for finding in findings if finding.broken] == []


class Drift(vmas.simulator.scenario.BaseScenario):
    """Two agents that a member of a subclass gives something odd."""

    of_agent = {}  # noqa: RUF012

    def make_world(self, batch_dim, device, **_):
        world = vmas.simulator.core.World(batch_dim, device)
        for k in range(2):
            world.add_agent(vmas.simulator.core.Agent(name=f"agent_{k}", **self.of_agent))
        return world

    def reset_world_at(self, env_index=None):
        for agent in self.world.agents:
            agent.set_pos(torch.zeros(2), batch_index=env_index)

    def observation(self, agent):
        return torch.cat([agent.state.pos, agent.state.vel], -1)

    def reward(self, agent):
        return -agent.state.pos.norm(dim=-1)


def drifting(**members):
    scenario = type("Odd", (Drift,), members)()

    class Drifting(VmasTask):
        symmetry, convention, terminates = "agents", "none", True

        def seen(self):
            return layout(Field("position", Kind.VECTOR), Field("velocity", Kind.VECTOR))

    Drifting.scenario = scenario
    env = Drifting(Drifting.Settings(), 3, generators_for((0,)))
    env.reset()
    return env.step(env.random_action())


def test_a_scenario_that_is_given_as_an_object_is_each_simulators_own() -> None:
    class Scattered(Drift):
        def reset_world_at(self, env_index=None):
            for agent in self.world.agents:
                agent.set_pos(torch.rand((3, 2) if env_index is None else (1, 2)), batch_index=env_index)

    class Drifting(VmasTask):
        scenario, symmetry, convention = Scattered(), "agents", "none"

        def seen(self):
            return layout(Field("position", Kind.VECTOR), Field("velocity", Kind.VECTOR))

    env, _ = (Drifting(Drifting.Settings(), 3, generators_for((0, 1))) for _ in range(2))
    env.reset()
    step = env.step(env.random_action())
    assert torch.allclose(step.reward, -step.next.obs[..., :2].norm(dim=-1), atol=1e-6)


@pytest.mark.parametrize(
    ("members", "sentence"),
    [
        ({"observation": lambda _, agent: {"x": agent.state.pos}}, r"observation 0 is a dict; give each"),
        (
            {"observation": lambda _, agent: torch.zeros(3, 4 if agent.name == "agent_0" else 5)},
            r"observation 1 is \[3, 5\]; give each agent a tensor \[3, 4\]",
        ),
        ({"reward": lambda *_: torch.ones(())}, r"reward 0 is \[\]; give each agent a tensor \[3, 1\]"),
        ({"reward": lambda *_: torch.ones(3, 2)}, r"reward 0 is \[3, 2\]"),
        ({"done": lambda _: torch.tensor(False)}, r"done 0 is \[\]; give"),
        ({"of_agent": {"action_size": 3}}, "agent_0 acts by other numbers than a force in the plane"),
        ({"of_agent": {"u_range": [1.0, 0.5]}}, "agent_0 acts by other numbers than a force in the plane"),
    ],
)
def test_what_a_scenario_gives_in_another_form_is_refused(members, sentence) -> None:
    with pytest.raises(UserError, match=sentence):
        drifting(**members)


def test_columns_and_other_types_of_numbers_are_read() -> None:
    step = drifting(
        reward=lambda *_: torch.ones(3, 1, dtype=torch.int64), done=lambda scenario: torch.tensor([[0], [1], [0]])
    )
    assert step.reward.dtype == torch.float32
    assert step.terminated.tolist() == [[False, True, False]]


class Tag(VmasTask):
    """VMAS simple_tag, both of whose sides learn."""

    scenario, symmetry, convention = "simple_tag", "d4*agents", "vmas simple_tag"
    shared_reward = {"adversary": True}  # noqa: RUF012  (as users write a task)

    def seen(self):
        own = (Field("velocity", Kind.VECTOR), Field("position", Kind.VECTOR), Field("obstacles", Kind.VECTOR, 2))
        fellows, hunters = (Field("fellows", Kind.VECTOR, 2, items=Items.OTHERS), Field("hunters", Kind.VECTOR, 3))
        prey = (Field("prey", Kind.VECTOR, family="agent"), Field("prey_velocity", Kind.VECTOR, family="agent"))
        return {"adversary": layout(*own, fellows, *prey), "agent": layout(*own, replace(hunters, family="adversary"))}

    def arguments(self):
        return {}


def test_groups_of_agents_are_roles() -> None:
    env = Tag(Tag.Settings(horizon=6), 5, generators_for((3, 7)))
    assert [(role.name, role.num_agents, role.observation.width) for role in env.spec.roles] == [
        ("adversary", 3, 16),
        ("agent", 1, 14),
    ]
    found = check(Subject(lambda n, seeds: Tag(Tag.Settings(horizon=6), n, generators_for(seeds)), rounding=1e-4))
    assert [finding for finding in found if finding.broken] == []
    start = env.reset()
    prey = RoleView(OthersAtRandom(env), "agent")
    assert torch.equal(prey.set_state(start.state).obs[:, :, 0], start.obs[:, :, 3, :14])
    assert [f.items for f in prey.spec.state.fields[:4]] == [Items.FIXED] * 2 + [Items.AGENTS] * 2
    step = env.step(env.random_action())
    assert bool((step.reward[..., :3] == step.reward[..., :1]).all())
    config = resolve_config(register(Tag), steps=50, overrides={"mappo.num_envs": 2, "prior.transforms": "d4*agents"})
    assert bool(build_learner(config).iterate(0.0).finite.all())
    with pytest.raises(UserError, match="gives the roles agent, adversary for adversary_0"):
        groups_of(env._sims[0].agents, ["agent", "adversary"])
