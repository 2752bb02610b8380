"""MADDPG's own arithmetic: targets, the actor's gradient, target networks, and the policy's consistency."""

import math
from dataclasses import replace

import pytest
import torch

from esp_cli.networks.layers import SeedMLP
from esp_cli.networks.plain import MLP
from tests.algorithms.off_policy import after, equal, learner


def prepared(**choice):
    trained = learner("maddpg", algo__gamma=0.5, **choice)
    episodes, _ = trained.collector.collect()
    trained._store(episodes)
    return trained, episodes


class LinearCritic(MLP):
    """Q = weights . (joint action), blind to the rest, for two seeds."""

    def __init__(self, inputs, weights):
        SeedMLP.__init__(self, [torch.Generator(), torch.Generator()], (inputs, 1), "relu", 1.0)
        self.layers[0].weight.data.zero_()[:, -weights.numel() :] = weights.unsqueeze(1)
        self.layers[0].bias.data.zero_()


def linear_critic(trained, weights):
    inputs = trained.critic.layers[0].weight.shape[1]
    trained.critic, trained.target_critic = (LinearCritic(inputs, weights) for _ in range(2))


def test_targets_by_hand_on_the_last_two_transitions():
    """The target policy's greedy actions, valued by the target critic; nothing beyond a terminal horizon."""
    trained, episodes = prepared(task__num_agents=2, prior__kind="none", algo__td_lambda=0.0)
    trained.reward_scale.normalise = lambda x: 5.0 * x  # undoes the division by the root of 25 steps
    linear_critic(trained, torch.arange(10.0))
    outputs = torch.zeros(2, 2, 26, 2, 5)
    outputs[:, :, 24, 0, 3] = outputs[:, :, 24, 1, 1] = 1.0  # encoded at 3 and 5 + 1
    trained.target_policy.unroll = lambda obs, action, mask: outputs
    y = trained._targets(episodes, trained.critic_rows(episodes))
    torch.testing.assert_close(y[:, :, 23], episodes.reward[:, :, 23] + 0.5 * 9.0)
    torch.testing.assert_close(y[:, :, 24], episodes.reward[:, :, 24])


@pytest.mark.parametrize(
    ("rule", "expected"), [("own", [3 * 0.25 - 7 * 0.25, 7 * 0.25 - 3 * 0.25]), ("all", [10 * 0.25])]
)
def test_whose_actions_are_the_policys(rule, expected):
    """With Q = (1, 2, 3, 4) . (joint action), own and all see different partners."""
    trained, episodes = prepared(task__num_agents=2, task__actions="continuous", algo__actor_actions=rule)
    linear_critic(trained, torch.arange(1.0, 5.0))
    diagonal = math.atanh(0.25 * 2**0.5) / 2**0.5  # squashed along its length to (0.25, 0.25)
    own = torch.full((2, 2, 25, 2, 2), diagonal)
    stored = torch.full((2, 2, 25, 2, 2), -0.25)
    value = trained._value_of_policy(
        trained.critic_rows(episodes)[:, :, :-1], own, own, replace(episodes, action=stored)
    )
    torch.testing.assert_close(value, torch.tensor(expected).expand(2, 2, 25, -1))


def own_rewards(**choice):
    """Three agents with rewards of their own, and Q_i = 10 a_{i+1} + 100 a_{i+2} + a_i; they did 1, 2, 3."""
    trained, episodes = prepared(task__convention="pettingzoo", prior__kind="none", **choice)
    linear_critic(trained, torch.cat([10 * torch.arange(5.0), 100 * torch.arange(5.0), torch.arange(5.0)]))
    return trained, episodes, torch.tensor([1, 2, 3]).expand(2, 2, 25, 3)


def test_agents_with_rewards_of_their_own_share_a_critic_that_sees_them_last():
    trained, episodes, done = own_rewards()
    seen = trained.critic_rows(episodes)[:, :, :-1]
    value = trained.joint.value(trained.critic, seen, trained.head.encode(done))
    torch.testing.assert_close(value, torch.tensor([321.0, 132.0, 213.0]).expand(2, 2, 25, 3))


@pytest.mark.parametrize("gradient", ["expected", "sampled"])
@pytest.mark.parametrize(("rule", "expected"), [("own", [324.0, 134.0, 214.0]), ("all", [444.0] * 3)])
def test_each_agent_is_told_its_own_value_of_what_its_policy_does(gradient, rule, expected):
    """Where the policy always does 4."""
    trained, episodes, done = own_rewards(algo__actor_gradient=gradient, algo__actor_actions=rule)
    outputs = torch.full((2, 2, 25, 3, 5), -70.0)
    outputs[..., 4] = 0.0
    seen, noise = trained.critic_rows(episodes)[:, :, :-1], torch.full(outputs.shape, 0.5)
    value = trained._value_of_policy(seen, outputs, noise, replace(episodes, action=done))
    torch.testing.assert_close(value, torch.tensor(expected).expand(2, 2, 25, 3))


def test_what_the_shared_critic_sees_of_a_state():
    """Observations in a circle that ends with one's own, then the time; beside a state one's own observation alone."""
    trained, episodes, _ = own_rewards()
    seen, first = trained.critic_rows(episodes), episodes.obs
    assert seen.shape[-1] == trained.critic_width
    torch.testing.assert_close(seen[..., 1, :-1], first[..., [2, 0, 1], :].flatten(-2))
    torch.testing.assert_close(seen[0, 0, :, 0, -1], torch.arange(26.0) / 25)
    trained, episodes = prepared(task__convention="pettingzoo", algo__critic_input="state")
    seen = trained.critic_rows(episodes)
    assert seen.shape[-1] == trained.critic_width
    torch.testing.assert_close(seen[..., 2, :-1], torch.cat([episodes.state, episodes.obs[..., 2, :]], -1))


def test_the_expected_value_by_hand():
    """Q = k for agent 1's action k, 10 k for agent 2's; agent 1 is half 2, half 4, agent 2 always 1; both did 3."""
    trained, episodes = prepared(
        task__num_agents=2, prior__kind="none", algo__actor_gradient="expected", algo__actor_actions="own"
    )
    linear_critic(trained, torch.cat([torch.arange(5.0), 10 * torch.arange(5.0)]))
    probabilities = torch.tensor([[0.0, 0.0, 0.5, 0.0, 0.5], [0.0, 1.0, 0.0, 0.0, 0.0]])
    outputs = probabilities.clamp_min(1e-30).log().expand(2, 2, 25, 2, 5).clone().requires_grad_()
    seen, noise = trained.critic_rows(episodes)[:, :, :-1], torch.full((2, 2, 25, 2, 5), 0.5)
    value = trained._value_of_policy(seen, outputs, noise, replace(episodes, action=torch.full((2, 2, 25, 2), 3)))
    torch.testing.assert_close(value, torch.tensor([30.0 + 3.0, 3.0 + 10.0]).expand(2, 2, 25, 2))
    (gradient,) = torch.autograd.grad(value.sum(), outputs)  # of exp(log p) Q: p Q
    torch.testing.assert_close(gradient[0, 0, 0, 0], torch.tensor([0.0, 0.0, 0.5 * 32.0, 0.0, 0.5 * 34.0]))


def test_with_all_actions_the_policys_the_partners_are_drawn_from_it():
    trained, episodes = prepared(
        task__num_agents=2, prior__kind="none", algo__actor_gradient="expected", algo__actor_actions="all"
    )
    linear_critic(trained, torch.cat([torch.zeros(5), torch.arange(5.0)]))  # Q is agent 2's action
    outputs = torch.full((2, 2, 25, 2, 5), 1e-30)
    outputs[..., 1] = 1.0  # both always choose 1
    seen, noise = trained.critic_rows(episodes)[:, :, :-1], torch.full((2, 2, 25, 2, 5), 0.5)
    value = trained._value_of_policy(seen, outputs.log(), noise, replace(episodes, action=torch.full((2, 2, 25, 2), 3)))
    torch.testing.assert_close(value, torch.ones(2, 2, 25, 2))


@pytest.mark.parametrize("rule", ["expected", "sampled"])
def test_the_actor_climbs_the_critic_and_leaves_it_alone(rule):
    trained, episodes = prepared(prior__kind="none", algo__output_penalty=0.0, algo__actor_gradient=rule)
    linear_critic(trained, torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0] * 3))  # every agent should move right
    before = [p.clone() for p in trained.critic.parameters()]
    seen = trained.critic_rows(episodes)[:, :, :-1]
    for _ in range(150):
        trained._learn_actor(trained.prior.copies(episodes, []), seen)
    probability = trained.policy.unroll(episodes.obs[:, :, :-1], episodes.action).exp()[..., 2]
    assert probability.mean() > 0.8
    assert all(torch.equal(p, q) for p, q in zip(before, trained.critic.parameters(), strict=True))
    assert all(p.requires_grad and p.grad is None for p in trained.critic.parameters())


def test_target_networks_go_a_small_part_of_the_way():
    trained, episodes = prepared(algo__tau=0.25)
    pairs = (
        (trained.policy.actor.layers[0].weight, trained.target_policy.actor.layers[0].weight),
        (trained.critic.layers[0].weight, trained.target_critic.layers[0].weight),
    )
    starts = [target.clone() for _, target in pairs]
    trained.update(episodes)
    for (online, target), start in zip(pairs, starts, strict=True):
        torch.testing.assert_close(target, 0.75 * start + 0.25 * online.detach(), rtol=0, atol=1e-7)
        assert (target - start).abs().max() > 1e-4, "the control"


def test_actor_and_critic_have_rates_of_their_own():
    """Adam's first step moves no weight further than its rate, and one with a large gradient nearly that far."""
    trained, episodes = prepared(algo__actor_learning_rate=1e-4, algo__learning_rate=4e-3)
    buffers = [optimiser.parameters.buffer for optimiser in (trained.actor_optimiser, trained.critic_optimiser)]
    before = [buffer.clone() for buffer in buffers]
    trained.update(episodes)
    moved = [float((now - then).abs().max()) for now, then in zip(buffers, before, strict=True)]
    assert moved == [pytest.approx(1e-4, rel=0.05), pytest.approx(4e-3, rel=0.05)]


def test_the_actors_loss_is_in_units_of_one_steps_reward():
    """A critic that says 2 of everything: values are over the root of 25 steps, so the loss is -5 x 2."""
    trained, episodes = prepared(prior__kind="none")
    linear_critic(trained, torch.zeros(5))
    trained.critic.layers[0].bias.data.fill_(2.0)
    metrics = trained._learn_actor(trained.prior.copies(episodes, []), trained.critic_rows(episodes)[:, :, :-1])
    torch.testing.assert_close(metrics["policy_loss"].detach(), torch.full((2,), -10.0))


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_the_policy_consistency_vanishes_for_a_policy_that_turns_with_the_world_alone(actions):
    trained, episodes = prepared(task__actions=actions, prior__transforms="rot90")
    copies = trained.prior.copies(episodes, trained.generators["prior"])
    velocity = copies.rows.obs[:, :, :-1, :, :2]
    if actions == "discrete":
        follow = torch.log_softmax(velocity @ torch.tensor(trained.spec.action.points).T, -1)
        stubborn = torch.log_softmax(torch.arange(5.0), 0).expand(follow.shape)
    else:
        follow = velocity
        stubborn = torch.tensor([math.atanh(0.5), 0.0]).expand(follow.shape)
    assert copies.gaps(policy=(trained.head, follow))["policy"].max() < 1e-6
    gap = copies.gaps(policy=(trained.head, stubborn))["policy"]
    assert gap.min() > 0.1
    if actions == "continuous":  # (1/2, 0) pulled back is (0, -1/2): |(1/2, 1/2)|^2 / 2
        torch.testing.assert_close(gap, torch.full((2,), 0.25))


@pytest.mark.parametrize(("actions", "same"), [("continuous", True), ("discrete", False)])
def test_the_expected_gradient_is_the_sampled_one_where_actions_are_continuous(actions, same):
    sampled, expected = (
        after("maddpg", task__actions=actions, algo__actor_gradient=kind)[0] for kind in ("sampled", "expected")
    )
    assert equal(sampled, expected) is same
