"""Masked actions: probability 0, gradient 0, never in a maximum, and moved by a transform with the actions."""

import math

import numpy as np
import pytest
import torch

from esp_cli import load_policy, train
from esp_cli.checking import check_symmetry
from esp_cli.networks.exploration import EpsilonGreedy, ExploringCategorical
from esp_cli.networks.heads import Categorical, masked
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.symmetry import transform_set
from esp_envs import Discrete, Kind, make, register
from esp_envs.base import random_choice
from esp_envs.conformance import Subject, check
from esp_envs.registry import TASKS
from tests.algorithms.off_policy import small_learner
from tests.cli.running import esp
from tests.fenced import Fenced, Gated, Nothing, OneSided

TASK = "tests.fenced:Fenced"
THREE = Discrete(Kind.SCALAR, ((0.0,), (1.0,), (2.0,)), ("a", "b", "c"))
LOGITS = torch.tensor([0.0, math.log(3.0), 5.0]).view(1, 1, 1, 3)
ALLOWED = torch.tensor([True, True, False]).view(1, 1, 1, 3)
ALL = torch.ones_like(ALLOWED)


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setattr(TASKS, "_registered", {})
    assert register(Fenced) == TASK


def head_of(cls):
    head = cls(THREE, 1)
    head.masks = True
    return head


def learner(algorithm, task=TASK, **overrides):
    return small_learner(task, algorithm, **overrides)


def test_probabilities_entropy_and_gradient_of_a_masked_choice_by_hand():
    """Logits (0, log 3, 5) with the last masked: probabilities 1/4, 3/4, 0."""
    logits, head = LOGITS.clone().requires_grad_(), head_of(Categorical)
    log_probs = head.normalise(masked(logits, ALLOWED))
    torch.testing.assert_close(log_probs.exp().flatten(), torch.tensor([0.25, 0.75, 0.0]))
    entropy = head.entropy(log_probs)
    torch.testing.assert_close(entropy.item(), 0.25 * math.log(4) + 0.75 * math.log(4 / 3))
    (head.log_prob(log_probs, torch.tensor([[[1]]])) + entropy).sum().backward()
    assert logits.grad[..., 2].item() == 0
    assert logits.grad[..., :2].abs().min() > 0
    assert head.normalise(masked(LOGITS, ALL)).exp()[..., 2].item() > 0.9, "the control: without a mask it is likely"


def test_a_row_that_allows_nothing_stays_as_it_is():
    assert torch.equal(masked(LOGITS, torch.zeros_like(ALLOWED)), LOGITS)


@pytest.mark.parametrize("cls", [Categorical, ExploringCategorical, EpsilonGreedy])
def test_a_masked_action_is_never_drawn(cls):
    """Also at the ends of the noise, where rounding could choose it; every allowed one is drawn."""
    head = head_of(cls)
    noise = torch.linspace(0, 1 - 2**-24, 1000).view(1, 1000, 1)
    if cls is EpsilonGreedy:
        noise = torch.stack([torch.zeros_like(noise), noise], -1)  # the first number says: explore
    for first, middle, last in ((False, True, True), (True, False, True), (True, True, False)):
        mask = torch.tensor([first, middle, last]).expand(1, 1000, 1, 3)
        outputs = head.normalise(masked(torch.zeros(1, 1000, 1, 3), mask))
        drawn = set(head.sample(outputs, noise).flatten().tolist())
        assert drawn == {k for k, allowed in enumerate((first, middle, last)) if allowed}
        assert bool(mask.gather(-1, head.mode(outputs).unsqueeze(-1)).all())


@pytest.mark.parametrize("algorithm", ["mappo", "maddpg", "qmix"])
def test_a_seed_that_is_lost_to_nan_does_what_is_allowed_until_it_is_stopped(algorithm):
    policy = learner(algorithm).policy
    with torch.no_grad():
        for parameter in policy.actor.parameters():
            parameter.fill_(math.nan)
    obs = torch.zeros(policy.num_seeds, 1000, policy.num_agents, next(policy.actor.parameters()).shape[1])
    mask = torch.zeros(*obs.shape[:-1], policy.head.num_outputs, dtype=torch.bool)
    mask[..., 1:] = True
    noise = policy.noise(1000, policy.num_agents, [torch.Generator() for _ in range(policy.num_seeds)])
    for chosen in (None, noise):
        action, _ = policy.act(obs, policy.initial_memory(1000, obs), chosen, mask)
        assert bool(action.gt(0).all())


def test_epsilon_is_shared_among_the_allowed_actions():
    """At epsilon 1 the two allowed ones have 1/2 each, whatever the actor says."""
    head = head_of(ExploringCategorical)
    outputs = head.normalise(masked(LOGITS, ALLOWED)).expand(1, 1000, 1, 3)
    drawn = head.sample(outputs, torch.linspace(0.0005, 0.9995, 1000).view(1, 1000, 1))
    assert drawn.flatten().bincount(minlength=3).tolist() == [500, 500, 0]


def test_the_straight_through_choice_and_its_penalty_leave_a_masked_action_out():
    """The centred log-probabilities of the two allowed ones are +- log(3) / 2."""
    logits, head = LOGITS.clone().requires_grad_(), head_of(ExploringCategorical)
    outputs = head.normalise(masked(logits, ALLOWED))
    torch.testing.assert_close(head.penalty(outputs).item(), (math.log(3) / 2) ** 2)
    chosen = head.relaxed(outputs, torch.full((1, 1, 1, 3), 0.5))
    torch.testing.assert_close(chosen.flatten(), torch.tensor([0.0, 1.0, 0.0]))
    ((chosen * torch.tensor([1.0, 2.0, 9.0])).sum() + head.penalty(outputs).sum()).backward()
    assert logits.grad[..., 2].item() == 0
    assert logits.grad[..., :2].abs().min() > 0


def test_a_random_choice_is_uniform_among_what_is_allowed():
    number = torch.linspace(0, 1 - 2**-24, 600)
    allowed = torch.tensor([True, False, True, True]).expand(600, 4)
    assert random_choice(allowed, number).bincount(minlength=4).tolist() == [200, 0, 200, 200]
    assert random_choice(torch.zeros(600, 4, dtype=torch.bool), number).bincount().tolist() == [150] * 4


@pytest.mark.parametrize("algorithm", ["maddpg", "qmix"])
def test_a_masked_action_never_enters_a_targets_maximum(algorithm):
    """The best next action, worth 5, is masked; the second, worth 3, takes its place."""
    trained = learner(algorithm, prior__kind="none")
    batch, _ = trained.collector.collect()
    batch.action_mask = torch.zeros_like(batch.action_mask)
    batch.action_mask[..., :3] = True
    values = torch.tensor([1.0, 2.0, 3.0, 5.0, 4.0])

    def constant(rows, *rest):
        return values.expand(*rows.shape[:-1], 5)

    trained.policy.actor.unroll_agents = trained.target_policy.actor.unroll_agents = constant
    if algorithm == "qmix":
        seen = []
        trained.target_mixer.forward = lambda chosen, state: seen.append(chosen) or chosen.sum(-1)
        trained._targets(batch, trained._utilities(batch), trained.critic_rows(batch))
        assert set(seen[0].flatten().tolist()) == {3.0}
        batch.action_mask = torch.ones_like(batch.action_mask)
        trained._targets(batch, trained._utilities(batch), trained.critic_rows(batch))
        assert set(seen[1].flatten().tolist()) == {5.0}, "the control: with all actions allowed"
        return
    trained.joint.value = lambda critic, seen, action: action[..., 0, :] @ values.unsqueeze(1)
    trained.reward_scale.normalise = torch.zeros_like
    trained.config = trained.config.model_copy(update={"td_lambda": 0.0, "gamma": 1.0})
    targets = trained._targets(batch, trained.critic_rows(batch))
    assert set(targets[:, :, :-1].flatten().tolist()) == {3.0}
    batch.action_mask = torch.ones_like(batch.action_mask)
    targets = trained._targets(batch, trained.critic_rows(batch))
    assert set(targets[:, :, :-1].flatten().tolist()) == {5.0}, "the control: with all actions allowed"


@pytest.mark.parametrize(
    ("algorithm", "choice"),
    [
        ("mappo", {}),
        ("mappo", {"network.name": "gru", "prior.old_log_prob": "recompute", "mappo.num_minibatches": 1}),
        ("mappo", {"network.name": "equivariant", "network.group": "d4"}),
        ("maddpg", {}),
        ("maddpg", {"maddpg.actor_gradient": "expected", "prior.replay": "stored", "prior.copies": "draw"}),
        ("qmix", {}),
        ("qmix", {"network.name": "gru"}),
    ],
)
def test_every_learner_trains_without_taking_a_forbidden_action(algorithm, choice):
    """The task raises at a forbidden action; the state of a learner goes through a checkpoint bit for bit."""
    trained = learner(algorithm, **choice)
    for _ in range(3):
        iteration = trained.iterate(0.0)
        assert bool(iteration.finite.all())
    other = learner(algorithm, **choice)
    other.load_state_dict({name: tensor.clone() for name, tensor in trained.state_dict().items()})
    one, two = trained.iterate(0.5), other.iterate(0.5)
    assert all(torch.equal(value, two.metrics[name]) for name, value in one.metrics.items())


def test_a_learner_that_ignores_masks_is_found():
    """Negative control of the test above."""
    trained = learner("mappo")
    trained.policy._normalised = lambda outputs, mask: trained.policy.head.normalise(outputs)
    with pytest.raises(RuntimeError, match="forbidden"):
        trained.iterate(0.0)


def test_copies_carry_their_masks_and_the_consistency_of_an_equivariant_network_is_exact():
    trained = learner("mappo", network__name="equivariant", network__group="d4", prior__transforms="rot90,flip-x")
    errors = trained.iterate(0.0).metrics["train/policy_symmetry_error"]
    assert float(errors.abs().max()) < 1e-6
    rollout = trained.collector.collect(6)
    batch, _ = trained.prepare(rollout)
    (turn,) = transform_set("rot90", trained.spec).each()
    moved = batch.transformed(turn)
    assert bool(moved.action_mask.gather(-1, moved.action.unsqueeze(-1)).all())
    right, up = (batch.action_mask[..., k] for k in (1, 3))
    assert torch.equal(moved.action_mask[..., 3], right), "what was right is up"
    assert not torch.equal(right, up)


def test_the_conformance_battery_asks_for_masks():
    findings = list(check(Subject(lambda count, seeds: make(TASK, count, seeds))))
    assert [f.broken for f in findings if f.broken] == []
    name = register(Nothing)
    findings = list(check(Subject(lambda count, seeds: make(name, count, seeds))))
    assert any("allows an agent nothing" in (f.broken or "") for f in findings)


@pytest.mark.parametrize("states", [True, False])
def test_the_symmetry_check_covers_masks(states, monkeypatch):
    """A mask that forbids one side only is found from paired states; from transitions it might be the policy's."""
    if not states:
        for cls in (Fenced, OneSided):
            monkeypatch.setattr(cls, "has", classmethod(lambda cls, method: False))
    name = register(OneSided)
    good = check_symmetry(lambda count, seeds: make(TASK, count, seeds), "rot90,flip-x")
    bad = check_symmetry(lambda count, seeds: make(name, count, seeds), "rot90,flip-x")
    assert good.holds
    (turn,) = (element for element in bad.elements if element.element == "rot90")
    if states:
        assert "action mask" in {f.field for f in turn.fields if f.outcome == "broken"}
    else:
        assert turn.outcome == "not covered"
        assert "the first actions differ from their image" in turn.reason


def test_a_masked_policy_is_evaluated_and_loaded(tmp_path):
    run = tmp_path / "run"
    esp("train", "--task", TASK, "--steps", 500, "--set", "mappo.num_envs=8", "--set", "evaluation.episodes=4",
        "--set", "mappo.num_minibatches=1", "--out", run)  # fmt: skip
    assert "after" in esp("eval", run, "--episodes", 4).stdout
    policy = load_policy(run)
    obs = np.zeros((7, 4), np.float32)
    mask = np.zeros((7, 5), bool)
    mask[:, 2] = True
    assert policy.act(obs, action_mask=mask).tolist() == [2] * 7
    with pytest.raises(ValueError, match=r"give action_mask of shape \(7, 5\)"):
        policy.act(obs)
    with pytest.raises(ValueError, match=r"has shape \(5,\), expected \(7, 5\)"):
        policy.act(obs, action_mask=mask[0])
    assert policy.act(obs, action_mask=mask.astype(float)).tolist() == [2] * 7
    for wrong in (np.where(mask, 0.0, -np.inf), mask * np.nan, mask.astype(str), [[True], [True, False]]):
        with pytest.raises(ValueError, match="the action mask is not an array of booleans"):
            policy.act(obs, action_mask=wrong)
    with pytest.raises(ValueError, match="allows an agent nothing"):
        policy.act(obs, action_mask=mask & (np.arange(7) < 6)[:, None])


def test_masks_need_discrete_actions():
    spec = make("navigation", 1, [0], {"actions": "continuous"}).spec
    fields = {name: getattr(spec, name) for name in spec.__dataclass_fields__}
    with pytest.raises(ValueError, match="masks are for discrete actions"):
        type(spec)(**fields | {"masks": True})


@pytest.mark.parametrize("fenced", [True, False])
def test_a_policy_is_not_evaluated_where_other_masks_bind_it(tmp_path, fenced):
    settings = {"task.fenced": fenced, "qmix.num_envs": 4, "network.hidden": [8], "evaluation.episodes": 2}
    train(Gated, "qmix", steps=48, settings=settings, out=tmp_path / "run")
    trained = TrainedPolicy.read(tmp_path / "run")
    with pytest.raises(ValueError, match="masks") as caught:
        trained.transfer({"fenced": not fenced})
    assert str(caught.value) == (
        f"{tmp_path / 'run'} was trained with other masks than the task has with task.fenced changed; change only what "
        "a policy neither sees nor does"
    )
    assert trained.transfer({"horizon": 3}).spec.masks == fenced, "the control"
