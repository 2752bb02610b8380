"""Tasks with agents of several kinds: numbers worked out by hand, learners in step, runs, resuming, evaluation."""

# ruff: noqa: RUF012  (as users write a task)

import json
import shutil
import signal
import subprocess
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor
from typer.testing import CliRunner

from esp_cli import Symmetry, load_policy
from esp_cli.app import app
from esp_cli.checking import check_symmetry, measured, paired
from esp_cli.checking.measured import prepared
from esp_cli.networks.roles import RolesPolicy
from esp_cli.policies.evaluation import evaluate
from esp_cli.policies.loading import open_policy
from esp_cli.run import begin
from esp_cli.symmetry import Element, build_transform, transform_set
from esp_cli.training.build import ScriptedController, build_learner, play
from esp_cli.training.config import RunConfig, resolve_config
from esp_envs import Discrete, Field, Items, Kind, UserError, generators_for, joint_layout, layout, make, register
from esp_envs.adapters.pettingzoo import ParallelTask
from esp_envs.conformance import QUICK, Subject, check
from esp_envs.roles import Role, spec_with_roles, without_agents
from esp_envs.views import Lockstep, OthersAtRandom, RoleView, worlds_of_role
from tests.cli.running import esp, refused
from tests.envs.chase import STEPS, STEPS_OR_STAY, Chase
from tests.envs.mpe_roles import MOVES, WORDS, SpeakerListener

TASK, CREW = "tests.envs.chase:Chase", "tests.envs.chase:Crew"
CALL = CliRunner()


@pytest.fixture(autouse=True)
def _registered():
    register(Chase)


def worlds(num_envs: int = 2, seeds: tuple[int, ...] = (3, 7)) -> Chase:
    return Chase(Chase.Settings(), num_envs, generators_for(seeds))


def placed(env: Chase) -> None:
    """Hunters at 0 and 3, the prey at 1, in every world."""
    env.reset()
    env.set_state(torch.tensor([0.0, 3.0, 1.0]).expand(*env.state_shape).contiguous())


def short(algorithm: str = "mappo", **overrides: object) -> RunConfig:
    many = {f"{algorithm}.num_envs": 4, "evaluation.every_steps": 64, "evaluation.episodes": 4} | overrides
    return resolve_config(TASK, algorithm, steps=128, seeds=(0, 1), overrides=many)


def test_spaces_of_all_and_of_each_role():
    spec = worlds().spec
    assert (spec.num_agents, spec.observation.width, spec.action.count) == (3, 3, 3)
    hunter, prey = spec.roles
    assert (hunter.num_agents, hunter.action, hunter.shared_reward, hunter.symmetry) == (
        2,
        STEPS,
        True,
        "flip-x*agents",
    )
    assert (prey.num_agents, prey.action, prey.shared_reward, prey.symmetry) == (1, STEPS_OR_STAY, False, "flip-x")
    assert [f.items for f in hunter.state.fields] == [Items.AGENTS, Items.FIXED]
    assert [f.items for f in prey.state.fields] == [Items.FIXED, Items.FIXED]
    assert [where for _, where in spec.parts] == [slice(0, 2), slice(2, 3)]


def test_a_setting_is_idle_where_it_is_in_every_role():
    assert "maddpg.critic_activation" not in short("maddpg", **{"network.name": "set"}).without_effect(), "the prey's"


def test_a_step_by_hand():
    env = worlds()
    placed(env)
    # the first hunter goes up to 1, the second down to 2; the prey's 2 is up, to 2: gaps 1 and 0
    step = env.step(torch.tensor([1, 0, 2]).expand(2, 2, 3))
    assert step.next.obs[0, 0].tolist() == [[1, 2, 2], [2, 1, 2], [2, 1, 2]]
    assert step.reward[0, 0].tolist() == [-0.5, -0.5, 1.0]
    placed(env)
    assert env.step(torch.full((2, 2, 3), 2)).next.state[0, 0].tolist() == [1, 4, 2]  # hunters have no action 2: up


def test_each_role_meets_its_own_part():
    env = worlds()
    placed(env)
    views = [RoleView(OthersAtRandom(env), name) for name in ("hunter", "prey")]
    step = views[0].step(torch.ones(2, 2, 2, dtype=torch.int64))
    assert step.next.obs.shape == (2, 2, 2, 3)
    assert step.next.obs[..., 0].flatten().unique().tolist() == [1, 4]
    assert step.reward.shape == (2, 2, 2)
    assert views[1].reset().obs.shape == (2, 2, 1, 3)
    with pytest.raises(UserError, match="no role 'fox'; it has hunter, prey"):
        RoleView(OthersAtRandom(env), "fox")


def test_learners_step_the_worlds_together():
    env, order = worlds(), []
    lockstep = Lockstep(env)

    def job(name: str, action: Tensor):
        def act() -> list[float]:
            view = RoleView(lockstep, name)
            view.reset()
            order.append(name)
            return [float(view.step(action).reward[0, 0, 0]) for _ in range(5)]

        return act

    jobs = [job("hunter", torch.ones(2, 2, 2).long()), job("prey", torch.full((2, 2, 1), 2))]
    hunters, prey = lockstep.run(jobs)
    assert [2 * -x for x in hunters] == prey
    assert sorted(order) == ["hunter", "prey"]
    alone = worlds()
    alone.reset()
    joint = torch.tensor([1, 1, 2]).expand(2, 2, 3)
    assert [float(alone.step(joint).reward[0, 0, 2]) for _ in range(5)] == prey


def test_the_first_error_ends_all_learners_and_they_go_on_afterwards():
    lockstep = Lockstep(worlds())
    views = [RoleView(lockstep, name) for name in ("hunter", "prey")]

    def fail() -> None:
        raise UserError("the prey broke")

    with pytest.raises(UserError, match="the prey broke"):
        lockstep.run([views[0].reset, fail])
    with pytest.raises(UserError, match="hunter for a new episode, prey for the end"):
        lockstep.run([views[0].reset, lambda: None])
    assert len(lockstep.run([views[0].reset, views[1].reset])) == 2
    assert threading.active_count() < 10


def test_an_interrupt_waits_for_no_learner():
    hangs, ended, main = threading.Event(), list[bool](), threading.main_thread().ident
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # what runs in the background ignores it
    threading.Timer(0.2, signal.pthread_kill, [main, signal.SIGINT]).start()
    try:
        with pytest.raises(KeyboardInterrupt):
            Lockstep(worlds()).run([lambda: ended.append(hangs.wait(60))] * 2)
        assert ended == []
    finally:
        hangs.set()
        signal.signal(signal.SIGINT, before)


def test_an_order_of_one_roles_agents_moves_what_others_see_of_them():
    hunter = worlds().spec.roles[0]
    swap = build_transform([Element(permutation=(1, 0))], hunter)
    assert swap.state(torch.tensor([[0.0, 3.0, 1.0]])).tolist() == [[3, 0, 1]]
    assert swap.obs(torch.tensor([[[0.0, 3.0, 1.0], [3.0, 0.0, 1.0]]])).tolist() == [[[3, 0, 1], [0, 3, 1]]]
    rows = Field("hunters", Kind.SCALAR, 2, family="hunter")
    of = {"action": Discrete(Kind.SCALAR, ((0.0,),), ("stay",)), "num_agents": 2}
    spec = spec_with_roles(
        [
            Role(name="hunter", observation=layout(Field("place", Kind.SCALAR)), **of),
            Role(name="prey", observation=layout(Field("own", Kind.SCALAR), rows), **of),
        ],
        name="rows", version=1, convention="none", horizon=1, symmetry="d4*agents",
    )  # fmt: skip
    # the state: two hunters, then of each prey its own number and the hunters
    state = torch.tensor([[1.0, 2.0, 8.0, 1.0, 2.0, 9.0, 1.0, 2.0]])
    orders = [build_transform([Element(permutation=(1, 0))], role).state(state).tolist() for role in spec.roles]
    assert orders == [[[2, 1, 8, 2, 1, 9, 2, 1]], [[1, 2, 9, 1, 2, 8, 1, 2]]]
    assert spec.roles[0].joint_fields == slice(0, 2)
    assert spec.roles[1].state.fields[2:] == joint_layout(spec.roles[1].observation, 2).fields
    assert transform_set("d4*agents", spec.roles[1]).size == 15


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"name": "prey"}, "prey, prey; give each"),
        ({"name": "a b"}, "a word of its own"),
        ({"name": "Prey"}, "Prey, prey; give each"),
        ({"action": None}, "all discrete"),
    ],
)
def test_roles_that_do_not_go_together_are_refused(change, match):
    from esp_envs import Continuous

    wrong = {"action": Continuous(layout(Field("x", Kind.SCALAR)))} if "action" in change else change
    row = layout(Field("place", Kind.SCALAR))
    first = {"name": "hunter", "num_agents": 1, "observation": row, "action": STEPS} | wrong
    with pytest.raises(UserError, match=match):
        spec_with_roles(
            [Role(**first), Role(name="prey", num_agents=1, observation=row, action=STEPS)],
            name="x", version=1, convention="", horizon=1, symmetry="c1",
        )  # fmt: skip


def test_such_a_task_keeps_every_promise():
    findings = check(Subject(lambda num_envs, seeds: worlds(num_envs, tuple(seeds))))
    assert not [finding.broken for finding in findings if finding.broken]


def test_returns_of_each_role_and_of_all():
    episodes = play(worlds(), ScriptedController(lambda env: env.random_action()))
    hunter, prey = (episodes.metrics[f"return_{name}"] for name in ("hunter", "prey"))
    assert torch.allclose(prey, -2 * hunter)
    assert torch.allclose(episodes.returns, (2 * hunter + prey) / 3, atol=1e-6)


@pytest.mark.parametrize("algorithm", ["mappo", "maddpg", "qmix"])
def test_every_algorithm_trains_both_roles_and_goes_on_bit_for_bit(algorithm):
    def trained(iterations: int, state=None):
        learner = build_learner(short(algorithm))
        if state is not None:
            learner.load_state_dict(state)
        for k in range(iterations):
            result = learner.iterate(k / 8)
        return learner, result

    whole, result = trained(4)
    assert bool(result.finite.all())
    assert {"train/hunter/return", "train/prey/return", "train/return"} <= result.metrics.keys()
    assert whole.has_learned
    half, _ = trained(2)
    saved = {name: tensor.clone() for name, tensor in half.state_dict().items()}
    assert {name.split(".")[1] for name in saved} == {"hunter", "prey"}
    again = build_learner(short(algorithm))
    again.load_state_dict(saved)
    for k in (2, 3):
        again.iterate(k / 8)
    expected = whole.state_dict()
    assert all(torch.equal(tensor, expected[name]) for name, tensor in again.state_dict().items())
    policies = list(whole.policy.children())
    assert not torch.equal(*(next(policy.parameters())[..., :1, :2].flatten()[:2] for policy in policies))


@pytest.mark.parametrize("name", ["act", "keys"])
def test_a_role_whose_name_means_something_of_a_policy_is_refused(name):
    with pytest.raises(UserError, match=f"a role cannot be named '{name}', which means something of a policy"):
        RolesPolicy(SimpleNamespace(num_agents=1, parts=()), {name: SimpleNamespace(num_seeds=1)})


def test_the_prior_acts_in_each_role():
    learner = build_learner(short(**{"prior.transforms": "flip-x*agents"}))
    sizes = {name: part.prior.transforms.size for name, part in learner.each.items()}
    assert sizes == {"hunter": 2, "prey": 1}  # a mirror, and the mirror with an exchange
    assert learner.each["hunter"].config.critic_input == "observations"
    with pytest.raises(UserError, match="no compass"):
        build_learner(short(**{"prior.compass": 1.0}))


def test_a_run_is_trained_and_evaluated_and_each_roles_policy_acts_and_is_exported(tmp_path: Path):
    begin(short(), None, tmp_path / "run").train()
    found = evaluate(open_policy(tmp_path / "run"), 6)
    assert {"return_hunter", "return_prey"} <= found.metrics.keys() & found.anchor_metrics["random"].keys()
    told = CALL.invoke(app, ["eval", str(tmp_path / "run"), "--episodes", "4", "--json", "-"])
    assert told.exit_code == 0, told.output
    prey = load_policy(tmp_path / "run", role="prey")
    assert prey.spec.num_agents == 1
    assert prey.act([[0.0, 1.0, 2.0]]).shape == (1,)
    with pytest.raises(UserError, match="has the roles hunter, prey; name one"):
        load_policy(tmp_path / "run")
    with pytest.raises(UserError, match="has the roles"):
        load_policy(tmp_path / "run", role="fox")
    out = tmp_path / "out"
    told = CALL.invoke(app, ["export", str(tmp_path / "run"), "--seed", "1", "-f", "numpy", "-o", str(out)])
    assert told.exit_code == 0, told.output
    for name, count in (("hunter", 2), ("prey", 3)):
        described = json.loads((out / name / "policy.json").read_text())
        assert len(described["action"]["options"]) == count
        assert described["task"]["name"] == name
    (out / "hunter" / "README.md").unlink()
    (out / "hunter" / "policy.json").unlink()
    (out / "hunter" / "policy.py").unlink()
    told = CALL.invoke(app, ["export", str(tmp_path / "run"), "--seed", "1", "-f", "numpy", "-o", str(out)])
    assert told.exit_code == 2, "the place of the prey is taken"
    assert not any((out / "hunter").iterdir()), "so nothing is written of the hunter either"


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_one_program_in_c_has_the_policies_of_all_roles(tmp_path: Path):
    begin(short(), None, tmp_path / "run").train()
    told = CALL.invoke(app, ["export", str(tmp_path / "run"), "--seed", "1", "-f", "c", "-o", str(tmp_path / "out")])
    assert told.exit_code == 0, told.output
    main = tmp_path / "main.c"
    main.write_text(
        '#include "out/hunter/policy.h"\n#include "out/prey/policy.h"\n#include <stdio.h>\n'
        "int main(void) { const float seen[ESP_HUNTER_OBSERVATION] = {0.0f, 3.0f, 1.0f};\n"
        'printf("%d %d", esp_hunter_act(seen), esp_prey_act(seen)); return 0; }\n'
    )
    sources = [str(tmp_path / "out" / role / "policy.c") for role in ("hunter", "prey")]
    subprocess.run(["cc", str(main), *sources, "-lm", "-o", str(tmp_path / "both")], check=True)
    said = subprocess.run([str(tmp_path / "both")], check=True, capture_output=True, text=True).stdout
    policies = [load_policy(tmp_path / "run", seed=1, role=role) for role in ("hunter", "prey")]
    assert [int(number) for number in said.split()] == [int(one.act([[0.0, 3.0, 1.0]])[0]) for one in policies]
    assert "`esp_prey_act(observation" in (tmp_path / "out" / "prey" / "README.md").read_text()


def test_what_a_command_says_of_each_role(tmp_path: Path):
    checked = CALL.invoke(app, ["check", "symmetry", TASK, "--json", str(tmp_path / "found.json")])
    assert checked.exit_code == 0, checked.output
    found = json.loads((tmp_path / "found.json").read_text())
    assert [one["holds"] for one in found.values()] == [True, True]
    report = check_symmetry(worlds_of_role(worlds, "hunter"))
    assert report.found == "flip-x*agents"
    assert {one.element for one in report.elements if one.declared} == {"flip-x", "agents-1-0"}
    assert CALL.invoke(app, ["check", "task", TASK]).exit_code == 0
    card = json.loads(CALL.invoke(app, ["tasks", TASK, "--json", "-"]).output)
    assert [row["field"] for row in card["observation"]][3:] == ["prey.place", "prey.hunters"]
    assert card["actions"][2:] == ["prey: 0 down (-1)", "prey: 1 stay (0)", "prey: 2 up (1)"]
    assert card["symmetries"] == ["flip-x", "agents"]
    refused = CALL.invoke(app, ["discover", TASK])
    assert "judges each role by itself" in refused.output


def test_a_prior_that_is_measured_weighs_each_element_by_its_worst_role():
    config = prepared(short(**{"prior.kind": "auto", "prior.transforms": "flip-x"}))
    assert config.prior.weights == {"flip-x": 1.0}
    assert bool(build_learner(config).iterate(0.0).finite.all())


def test_both_sides_of_predator_prey_see_and_get_what_each_does_alone():
    both, hunters, hunted = (make("predator-prey", 3, [5], {"control": who}) for who in ("both", "predators", "prey"))
    for env in (both, hunters, hunted):
        env.reset()
    state = both.reset().state
    seen, (_, prey) = both.set_state(state), both.spec.parts
    assert torch.equal(seen.obs[:, :, :3], hunters.set_state(state).obs)
    assert torch.equal(seen.obs[:, :, 3:, : prey[0].observation.width], hunted.set_state(state).obs)
    action = both.heuristic()
    step, chased = both.step(action), hunted.step(action[:, :, 3:])
    assert torch.equal(step.next.state, chased.next.state)
    assert torch.equal(step.reward[:, :, 3:], chased.reward)
    assert [role.name for role in both.spec.roles] == ["predators", "prey"]
    assert both.spec.roles[0].state == hunters.spec.state
    with pytest.raises(ValueError, match="with control 'both' the prey is a learner"):
        make("predator-prey", 1, [0], {"control": "both", "prey": "still"})
    config = resolve_config("predator-prey", steps=100, overrides={"task.control": "both", "mappo.num_envs": 4})
    assert bool(build_learner(config).iterate(0.0).finite.all())


@pytest.mark.parametrize("name", ["Tag", "SpeakerListener", "Adversary", "WorldComm"])
def test_tasks_of_mpe2_with_roles_keep_their_promises_and_train(name):
    pytest.importorskip("mpe2")
    task = register(f"tests.envs.mpe_roles:{name}")
    found = check(Subject(lambda num_envs, seeds: make(task, num_envs, seeds, {"horizon": 5, "workers": 0})), QUICK)
    assert not [finding.broken for finding in found if finding.broken]
    settings = {"task.horizon": 5, "task.workers": 0, "mappo.num_envs": 4, "mappo.num_steps": 5}
    config = resolve_config(task, steps=40, overrides=settings)
    assert config.prior.transforms == "d4"
    assert bool(build_learner(config).iterate(0.0).finite.all())


def test_a_symmetry_for_loops_of_others_takes_a_roles_layouts():
    role = worlds().spec.roles[0]
    symmetry = Symmetry(
        observation=role.observation, action=role.action, state=role.state, num_agents=2, group="agents"
    )
    moved = symmetry.augment(torch.tensor([[[0.0, 3, 1], [3, 0, 1]]]), torch.tensor([[0, 1]]), state=torch.eye(3)[:1])
    assert moved.action.tolist() == [[0, 1], [1, 0]]
    assert moved.state.tolist() == [[1, 0, 0], [0, 1, 0]]


def test_roles_of_names_that_say_nothing_are_listed():
    class Listed(ParallelTask):  # as users write a task
        observation = {"one": layout(Field("a", Kind.SCALAR, 3)), "other": layout(Field("b", Kind.SCALAR, 11))}
        action = {"one": WORDS, "other": MOVES}
        roles, symmetry, convention = {"one": ["speaker_0"], "other": ["listener_0"]}, "c1", "listed"
        make_one = SpeakerListener.make_one

    pytest.importorskip("mpe2")
    make_it = lambda cls: cls(cls.Settings(), 2, generators_for((0,)))  # noqa: E731
    assert [role.name for role in make_it(Listed).spec.roles] == ["one", "other"]
    Listed.roles = {}
    with pytest.raises(
        UserError, match="no agent's name begins with 'one'; the agents are speaker_0, listener_0; name"
    ):
        make_it(Listed)
    Listed.action = {"one": WORDS}
    with pytest.raises(UserError, match="is given by role, but not of 'other'; add it"):
        make_it(Listed)


@pytest.mark.parametrize("transforms", ["d4*agents", "agents", "d4,agents"])
def test_orders_of_agents_are_left_out_of_a_role_of_one_that_is_weighed(transforms, monkeypatch):
    monkeypatch.setattr(paired, "_MOST_WORLDS", paired._FEWEST_WORLDS)  # how sure the weights are is not asked
    monkeypatch.setattr(paired, "_LATER", 16)
    monkeypatch.setattr(measured, "_breaking", measured._breaking.__wrapped__)  # so that no other test gets them
    overrides = {"task.control": "both", "prior.kind": "auto", "prior.transforms": transforms, "mappo.num_envs": 4}
    config = prepared(resolve_config("predator-prey", overrides=overrides, seeds=(0,), steps=200))
    learner = build_learner(config)
    assert bool(learner.iterate(0.0).finite.all())
    names = {name: one.prior.transforms.names if one.prior.transforms else () for name, one in learner.each.items()}
    assert any("agents" in name for name in names["predators"])
    assert not any("agents" in name for name in names["prey"])


def test_a_role_of_which_nothing_can_be_tried_hides_no_verdict_of_another() -> None:
    held = esp("check", "symmetry", CREW)
    assert "agents-1-0" in held.stdout
    assert "no transform can be tried on boss" in held.stderr
    lame = esp("check", "symmetry", CREW, "--set", "task.speeds=[0.1,0.5]", "--json", "-", code=1)
    assert json.loads(lame.stdout)["car"]["report"]["elements"][0]["fields"][0]["outcome"] == "broken"
    assert "no transform can be tried on car" in refused("check", "symmetry", CREW, "--transforms", "rot90")
    pair = ["predator-prey", *(f"--set=task.{one}" for one in ("control=both", "num_predators=1"))]
    assert "'agents' moves no agent of any role" in refused("check", "symmetry", *pair, "--transforms", "agents")


def test_a_default_that_is_made_is_on_the_card() -> None:
    card = json.loads(esp("tasks", CREW, "--json", "-").stdout)
    assert card["settings"]["speeds"] == {"default": [0.1, 0.1], "description": "of the two cars"}


def test_a_role_of_one_agent_has_no_orders_and_a_sampled_group_keeps_its_weight() -> None:
    assert without_agents("rot90*agents-1-0-2, agents-1-0-2, d4*agents") == "rot90,d4"
    settings = {"task.control": "both", "mappo.num_envs": 2}
    build_learner(resolve_config("predator-prey", overrides=settings | {"prior.transforms": "rot90*agents-1-0-2"}))
    weighed = {"prior.transforms": "o2", "prior.trust": "measured", "prior.weights": {"o2": 0.5}}
    learner = build_learner(
        resolve_config("predator-prey", overrides=settings | weighed | {"task.actions": "continuous"})
    )
    assert all(one.prior.config.weights == {"o2": 0.5} for one in learner.each.values())
