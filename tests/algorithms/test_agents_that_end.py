"""Agents that end one by one: no loss, no value and no statistics behind an agent's own end."""

import copy
from dataclasses import replace

import pytest
import torch

from esp_cli.algorithms.objectives import explained_variance, gae, normalise_per_seed, td_targets
from esp_cli.checking import check_symmetry
from esp_cli.prior import mean_per_seed
from esp_cli.symmetry import transform_set
from esp_envs import make, register
from esp_envs.conformance import Subject, check
from esp_envs.registry import TASKS
from tests.algorithms.off_policy import small_learner
from tests.cli.running import esp
from tests.leaving import Brief, Leaving, Returning

TASK = "tests.leaving:Leaving"


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setattr(TASKS, "_registered", {})
    assert register(Leaving) == TASK


def learner(algorithm, **overrides):
    return small_learner(TASK, algorithm, **{"prior__transforms": "flip-x"} | overrides)


def test_the_mean_over_the_living_by_hand():
    """Of (1, 2 | 3, 40) with the last agent ended, (1 + 2 + 3) / 3; a number per world counts while anybody lives."""
    x = torch.tensor([[[[1.0, 2.0], [3.0, 40.0]]]])
    alive = torch.tensor([[[[True, True], [True, False]]]])
    assert mean_per_seed(x, alive).tolist() == [2.0]
    assert mean_per_seed(x).tolist() == [11.5], "the control"
    assert mean_per_seed(x[..., :1], alive).tolist() == [2.0]
    nobody = torch.tensor([[[[True, True], [False, False]]]])
    assert mean_per_seed(x[..., :1], nobody).tolist() == [1.0]


def test_standardised_advantages_of_the_living_by_hand():
    """Of (1, 3, 50) with the last ended: mean 2, deviation 1."""
    x, alive = torch.tensor([[1.0, 3.0, 50.0]]), torch.tensor([[True, True, False]])
    torch.testing.assert_close(normalise_per_seed(x, 0.0, alive), torch.tensor([[-1.0, 1.0, 0.0]]))
    both = torch.ones_like(alive)
    torch.testing.assert_close(normalise_per_seed(x, 1e-5, both), normalise_per_seed(x))


def test_the_explained_variance_of_the_living_by_hand():
    """A constant explains nothing of the living's targets (4, 6), and half an offset 1 - (1/4) / 1 = 3/4 of (5, 6).

    With the ended agent as a zero of both, the constant 5 would seem to explain 1 - (2/3) / (56/9) = 25/28.
    """
    target = torch.tensor([[4.0, 6.0, 90.0], [4.0, 6.0, 90.0]])
    value = torch.tensor([[5.0, 5.0, -7.0], [4.5, 5.5, -7.0]])
    alive = torch.tensor([[True, True, False]]).expand(2, 3)
    assert explained_variance(value, target, alive).tolist() == [0.0, 0.75]
    zeros = explained_variance(torch.where(alive, value, 0.0), torch.where(alive, target, 0.0))
    assert zeros[0].item() == pytest.approx(25 / 28), "the control"
    torch.testing.assert_close(explained_variance(value, target, alive | True), explained_variance(value, target))


def test_mappo_logs_the_explained_variance_of_the_living():
    trained, rollout = collected()
    before = copy.deepcopy(trained.normaliser)
    batch, metrics = trained.prepare(rollout)
    value, target = before.denormalise(batch.value), trained.normaliser.denormalise(batch.target)
    alive = rollout.alive.flatten(1, 2).unsqueeze(2)
    living = [explained_variance(v[m][None], t[m][None]) for v, t, m in zip(value, target, alive, strict=True)]
    torch.testing.assert_close(metrics["train/explained_variance"], torch.cat(living))
    assert not torch.allclose(metrics["train/explained_variance"], explained_variance(value, target)), "the control"


def test_advantages_end_with_the_agent_by_hand():
    """Agent 1 ends with the first step, agent 2 goes on; gamma = lambda = 1/2, all values 4.

    A_2 = 1 + 2 - 4 = -1 at the last step, -1 + (1 + 2 - 4) / 4 = -1.25 before; agent 1 has 1 - 4 = -3, nothing beyond.
    """
    reward, value = torch.ones(1, 1, 2, 2), torch.full((1, 1, 2, 2), 4.0)
    gone = torch.tensor([[[[True, False], [True, False]]]])
    advantage = gae(reward, value, value, gone, gone, 0.5, 0.5)
    assert advantage[0, 0].tolist() == [[-3.0, -1.25], [-3.0, -1.0]]


def test_targets_end_with_the_agent_by_hand():
    """Agent 1 ends with the first step: its target is its reward, 1; agent 2's has gamma times 4 added."""
    over = torch.tensor([[[[True, False]]]])
    target = td_targets(torch.ones(1, 1, 1, 2), torch.full((1, 1, 1, 2), 4.0), over, 0.5, 0.0)
    assert target.flatten().tolist() == [1.0, 3.0]


def collected(**overrides):
    trained = learner("mappo", **overrides)
    rollout = trained.collector.collect(6)
    assert bool(rollout.alive.any())
    assert not bool(rollout.alive.all())
    return trained, rollout


def test_a_value_of_the_world_counts_behind_the_end_of_its_agents_and_a_value_per_agent_does_not():
    _, rollout = collected(task__shared=True)
    batch = learner("mappo", task__shared=True).prepare(rollout)[0]
    assert batch.valued(1) is None
    assert batch.valued(3) is batch.alive
    episodes, _ = learner("qmix", task__shared=True).collector.collect()
    assert episodes.valued(1) is episodes.valid
    assert torch.equal(episodes.valued(3), episodes.alive[:, :, :-1])


def test_advantages_of_the_living_are_standardised_where_the_reward_is_shared_too():
    trained, rollout = collected(task__shared=True)
    batch, _ = trained.prepare(rollout)
    for advantage, alive in zip(batch.advantage, batch.alive, strict=True):
        assert float(advantage[alive].mean()) == pytest.approx(0, abs=1e-5)
        assert float(advantage[alive].std(correction=0)) == pytest.approx(1, abs=1e-3)
        assert not advantage[~alive].any()


def test_mappo_learns_that_a_state_in_which_nobody_lives_any_more_is_worth_nothing():
    """The first step costs 1 and nothing is paid behind it. Where the end is not learned, V = -1 + V / 2 is -2."""
    slow = {"prior.kind": "none", "mappo.num_envs": 16, "mappo.gamma": 0.5}
    trained = small_learner(register(Brief), "mappo", hidden=(32, 32), **slow)
    for _ in range(80):
        trained.iterate(0.0)
    rollout = trained.collector.collect(6)
    value = trained.normaliser.denormalise(trained.critic.unroll(rollout.obs, rollout.state)).detach()
    assert float(value[:, :, 0].mean()) == pytest.approx(-1, abs=0.1)
    assert float(value[:, :, 1:].mean()) == pytest.approx(0, abs=0.1)


def test_a_rollout_says_who_has_ended():
    _, rollout = collected()
    arrived = rollout.reward > 0.5
    assert torch.equal(rollout.gone & rollout.alive, arrived), "an agent goes in the step in which it arrives"
    assert not bool(rollout.reward[~rollout.alive].any())


def test_a_critic_of_each_agents_own_observation_is_refused_where_a_reward_is_shared_beyond_its_end():
    with pytest.raises(ValueError, match="critic_input=own") as caught:
        learner("mappo", task__shared=True, mappo__critic_input="own")
    assert str(caught.value) == (
        "mappo.critic_input=own values each agent up to its own end, but agents of leaving share a reward that goes on "
        "behind it; set mappo.critic_input to observations or state"
    )
    assert learner("mappo", task__shared=True).num_values == 1, "the control: one value for all"
    assert learner("mappo", mappo__critic_input="own").num_values == 3, "the control: rewards of their own"


def test_what_an_ended_agent_did_and_was_worth_moves_no_weight():
    """Other actions and log-probabilities of ended agents give the same update bit for bit; of living ones not."""
    results = {}
    for who in ("nobody", "ended", "living"):
        trained, rollout = collected(prior__kind="none", mappo__num_minibatches=1, mappo__critic_input="own")
        mask = {"nobody": torch.zeros_like(rollout.alive), "ended": ~rollout.alive, "living": rollout.alive}[who]
        rollout = replace(
            rollout,
            action=torch.where(mask, 1 - rollout.action, rollout.action),
            log_prob=torch.where(mask, rollout.log_prob - 0.3, rollout.log_prob),
            reward=torch.where(mask, 7.0, rollout.reward) if who != "ended" else rollout.reward,
        )
        trained.update(rollout, 0.0)
        results[who] = torch.cat([p.flatten() for p in [*trained.policy.parameters(), *trained.critic.parameters()]])
    assert torch.equal(results["nobody"], results["ended"])
    assert not torch.equal(results["nobody"], results["living"]), "the control"


@pytest.mark.parametrize("algorithm", ["maddpg", "qmix"])
def test_what_an_ended_agent_did_moves_no_weight_of_an_off_policy_learner(algorithm):
    results = {}
    for who in ("nobody", "ended", "living"):
        trained = learner(algorithm, prior__kind="none")
        batch, _ = trained.collector.collect()
        trained._store(batch)
        alive = batch.alive[:, :, :-1]
        assert bool(alive.any())
        assert not bool(alive.all())
        mask = {"nobody": torch.zeros_like(alive), "ended": ~alive, "living": alive}[who]
        trained.update(replace(batch, action=torch.where(mask, 1 - batch.action, batch.action)))
        results[who] = torch.cat([p.flatten() for module in trained.modules.values() for p in module.parameters()])
    assert torch.equal(results["nobody"], results["ended"])
    assert not torch.equal(results["nobody"], results["living"]), "the control"


def test_an_ended_agents_value_enters_qmixs_mixer_as_0():
    trained = learner("qmix", prior__kind="none")
    batch, _ = trained.collector.collect()
    seen = []
    trained.mixer.forward = lambda chosen, state: seen.append(chosen) or chosen.sum(-1)
    trained.target_mixer.forward = trained.mixer.forward
    utilities, rows = torch.full((2, 2, 7, 3, 2), 5.0), trained.critic_rows(batch)
    trained._total(utilities, batch, rows)
    assert torch.equal(seen[0] == 0, ~batch.alive[:, :, :-1])
    trained.target_policy.unroll = lambda *rows: utilities
    trained._targets(batch, utilities, rows)
    assert torch.equal(seen[1] == 0, ~batch.alive[:, :, 1:])


def test_statistics_of_rewards_leave_ended_agents_out():
    """Of the agents with rewards of their own: -0.1 for each step and 1 for arriving, over living agents alone."""
    trained = learner("maddpg", prior__kind="none")
    batch, _ = trained.collector.collect()
    trained._store(batch)
    alive = batch.alive[:, :, :-1]
    expected = torch.where(alive, batch.reward, 0.0).flatten(1).sum(1) / alive.flatten(1).sum(1)
    torch.testing.assert_close(trained.reward_scale.mean.float(), expected)


@pytest.mark.parametrize(
    ("algorithm", "choice"),
    [
        ("mappo", {}),
        ("mappo", {"task.shared": True, "mappo.chunk_steps": 1}),
        ("mappo", {"network.name": "gru", "mappo.num_minibatches": 1, "mappo.critic_input": "own"}),
        ("maddpg", {"prior.replay": "stored"}),
        ("maddpg", {"task.shared": True, "maddpg.actor_actions": "own"}),
        ("maddpg", {"maddpg.actor_gradient": "expected"}),
        ("qmix", {}),
        ("qmix", {"network.name": "gru", "task.shared": True}),
    ],
)
def test_every_learner_trains_with_the_prior_and_goes_on_bit_for_bit(algorithm, choice):
    trained, other = learner(algorithm, **choice), learner(algorithm, **choice)
    for _ in range(3):
        assert bool(trained.iterate(0.0).finite.all())
    other.load_state_dict({name: tensor.clone() for name, tensor in trained.state_dict().items()})
    one, two = trained.iterate(0.5), other.iterate(0.5)
    assert all(torch.equal(value, two.metrics[name]) for name, value in one.metrics.items())


def test_chunks_of_a_minibatch_change_nothing():
    """A mean over the living is one of the whole minibatch, however it is computed."""
    weights = []
    for size in (1, 10_000):
        trained, rollout = collected(prior__kind="none", mappo__chunk_steps=size)
        trained.update(rollout, 0.0)
        weights.append(torch.cat([p.flatten() for p in trained.policy.parameters()]))
    assert torch.equal(*weights)


def test_who_has_ended_moves_with_the_agents():
    trained, rollout = collected()
    batch, _ = trained.prepare(rollout)
    (swap,) = transform_set("agents-1-0-2", trained.spec).each()
    moved = batch.transformed(swap)
    assert torch.equal(moved.alive, batch.alive[..., [1, 0, 2]])
    assert not torch.equal(moved.alive, batch.alive), "the control"


def test_the_conformance_battery_asks_for_ends():
    findings = list(check(Subject(lambda count, seeds: make(TASK, count, seeds))))
    assert [f.broken for f in findings if f.broken] == []
    name = register(Returning)
    findings = list(check(Subject(lambda count, seeds: make(name, count, seeds))))
    assert any("acts again" in (f.broken or "") for f in findings)


def test_the_task_is_checked_evaluated_and_its_return_is_the_agents_own(tmp_path):
    report = check_symmetry(lambda count, seeds: make(TASK, count, seeds), "flip-x")
    assert report.holds
    assert "alive" in {field.field for element in report.elements for field in element.fields}
    run = tmp_path / "run"
    esp("train", "--task", TASK, "--steps", 500, "--set", "mappo.num_envs=8", "--set", "evaluation.episodes=4",
        "--set", "prior.transforms=flip-x", "--set", "mappo.num_minibatches=1", "--out", run)  # fmt: skip
    assert "arrived" in esp("eval", run, "--episodes", 4).stdout


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("algorithm", ["maddpg", "qmix"])
def test_what_is_paid_behind_the_end_of_a_lone_agent_counts_where_the_reward_is_no_agents_own(algorithm, shared):
    trained = learner(algorithm, task__num_agents=1, task__shared=shared)
    episodes, _ = trained.collector.collect()
    alive = episodes.alive[:, :, :-1]
    trained._store(replace(episodes, reward=torch.where(alive, 0.0, 1.0)))
    batch = trained.replay.select(torch.arange(2).expand(2, 2))
    assert torch.equal(trained.reward_scale.mean > 0, torch.tensor([shared, shared]))
    target = trained.td_targets(batch, torch.zeros_like(batch.reward), torch.ones_like(batch.reward))
    last = alive & ~episodes.alive[:, :, 1:]
    assert bool((target[last] > 0).any()) is shared, "what is bootstrapped behind the end"
    assert torch.equal(batch.valued(1), batch.valid if shared else alive)


@pytest.mark.parametrize("shared", [False, True])
def test_mappo_values_a_lone_agent_up_to_its_end_where_the_reward_is_its_own(shared):
    trained, rollout = collected(task__num_agents=1, task__shared=shared)
    batch, _ = trained.prepare(replace(rollout, reward=torch.where(rollout.alive, 0.0, 1000.0)))
    target = trained.normaliser.denormalise(batch.target).view(rollout.alive.shape)
    assert bool((target[rollout.alive] > 10).any()) is shared, "what is paid behind the end"
    assert (batch.valued(1) is None) is shared
    assert shared or batch.valued(1) is batch.alive
