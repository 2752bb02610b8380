"""QMIX's own arithmetic: the team's value of what was done, and double-Q targets by hand."""

import torch

from tests.algorithms.off_policy import learner


class Sum(torch.nn.Module):
    """A mixer whose arithmetic can be done in the head."""

    def forward(self, values, state):
        return values.sum(-1)


def prepared(**choice):
    trained = learner("qmix", task__num_agents=2, prior__kind="none", algo__gamma=0.5, algo__td_lambda=0.0, **choice)
    episodes, _ = trained.collector.collect()
    trained.mixer = trained.target_mixer = Sum()
    trained.reward_scale.normalise = lambda x: 5.0 * x  # undoes the division by the root of 25 steps
    return trained, episodes


def test_the_team_value_mixes_the_values_of_what_was_done():
    trained, episodes = prepared()
    utilities = torch.randn(2, 2, 26, 2, 5)
    total = trained._total(utilities, episodes, trained.critic_rows(episodes))
    assert total.shape == (2, 2, 25, 1)
    one, two = episodes.action[1, 0, 7].tolist()
    torch.testing.assert_close(total[1, 0, 7, 0], utilities[1, 0, 7, 0, one] + utilities[1, 0, 7, 1, two])


def test_double_q_targets_by_hand_on_the_last_two_transitions():
    """The online network's best next actions, valued by the target network; nothing beyond a terminal horizon."""
    trained, episodes = prepared()
    online, target = torch.zeros(2, 2, 26, 2, 5), torch.zeros(2, 2, 26, 2, 5)
    online[:, :, 24, 0, 3] = online[:, :, 24, 1, 1] = 1.0
    target[:, :, 24, 0, 3], target[:, :, 24, 1, 1] = 10.0, 20.0
    target[:, :, 24, 0, 0] = 99.0  # the target network's own favourite
    target[:, :, 25] = 7.0
    trained.target_policy.unroll = lambda obs, action, mask: target
    reward = episodes.reward.mean(-1)
    y = trained._targets(episodes, online, trained.critic_rows(episodes))[..., 0]
    torch.testing.assert_close(y[:, :, 23], reward[:, :, 23] + 0.5 * 30.0)
    torch.testing.assert_close(y[:, :, 24], reward[:, :, 24])

    single, _ = prepared(algo__double_q=False, algo__bootstrap_truncated=True)
    single.target_policy.unroll = lambda obs, action, mask: target
    y = single._targets(episodes, online, single.critic_rows(episodes))[..., 0]
    torch.testing.assert_close(y[:, :, 23], reward[:, :, 23] + 0.5 * 119.0)
    torch.testing.assert_close(y[:, :, 24], reward[:, :, 24] + 0.5 * 14.0)


def test_target_networks_are_copied_every_so_many_steps():
    trained = learner("qmix", algo__target_every=3)
    start = trained.target_policy.actor.layers[0].weight.clone()
    batch, _ = trained.collector.collect()
    trained._store(batch)
    for k in range(1, 4):
        trained.update(batch)
        trained.updates += 1
        assert torch.equal(start, trained.target_policy.actor.layers[0].weight) is (k < 3)
    assert torch.equal(trained.policy.actor.layers[0].weight, trained.target_policy.actor.layers[0].weight)
    assert torch.equal(trained.mixer.hypernetwork.layers[0].weight, trained.target_mixer.hypernetwork.layers[0].weight)
