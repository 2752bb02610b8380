"""The learners' equations against numbers worked out by hand."""

import pytest
import torch

from esp_cli.algorithms.objectives import explained_variance, gae, normalise_per_seed, td_targets
from esp_cli.prior import mean_per_seed


def row(*numbers):
    """One seed, one world, T steps, one value: [1, 1, T, 1]."""
    return torch.tensor(numbers, dtype=torch.float64).view(1, 1, -1, 1)


def flags(*values):
    return torch.tensor(values).view(1, 1, -1, 1)


def test_gae_by_hand():
    # gamma = lambda = 1/2: deltas 1 + 3 / 2 - 2 = 0.5, 2 + 4 / 2 - 3 = 1, 3 + 5 / 2 - 4 = 1.5
    # A_2 = 1.5, A_1 = 1 + 0.25 * 1.5 = 1.375, A_0 = 0.5 + 0.25 * 1.375 = 0.84375
    no = flags(False, False, False)
    advantage = gae(row(1, 2, 3), row(2, 3, 4), row(3, 4, 5), no, no, 0.5, 0.5)
    assert advantage.flatten().tolist() == [0.84375, 1.375, 1.5]


def test_gae_stops_at_a_terminal_state_and_uses_no_value_beyond_it():
    # step 1 terminates: delta_1 = 2 - 3 = -1 and nothing flows back from step 2
    ends = flags(False, True, False)
    advantage = gae(row(1, 2, 3), row(2, 3, 4), row(3, 100, 5), ends, ends, 0.5, 0.5)
    assert advantage.flatten().tolist() == [0.5 + 0.25 * -1, -1.0, 1.5]


def test_gae_bootstraps_a_truncated_episode_from_its_final_state():
    # step 1 is cut by the horizon: delta_1 = 2 + 0.5 * 100 - 3 = 49, and nothing flows back from step 2
    no, cut = flags(False, False, False), flags(False, True, False)
    advantage = gae(row(1, 2, 3), row(2, 3, 4), row(3, 100, 5), no, cut, 0.5, 0.5)
    assert advantage.flatten().tolist() == [0.5 + 0.25 * 49, 49.0, 1.5]


def test_gae_with_lambda_one_is_the_discounted_return_minus_the_value():
    torch.manual_seed(0)
    reward, value = torch.randn(2, 3, 6, 1).double(), torch.randn(2, 3, 7, 1).double()
    no = torch.zeros(2, 3, 6, 1, dtype=torch.bool)
    advantage = gae(reward, value[:, :, :-1], value[:, :, 1:], no, no, 0.9, 1.0)
    discounts = 0.9 ** torch.arange(6, dtype=torch.float64)
    expected = (reward[:, :, :, 0] * discounts).sum(-1) + 0.9**6 * value[:, :, 6, 0] - value[:, :, 0, 0]
    torch.testing.assert_close(advantage[:, :, 0, 0], expected)


def test_explained_variance_of_perfect_constant_and_opposite_predictions():
    target = torch.tensor([[1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [1.0, 2.0, 3.0]])
    value = torch.tensor([[1.0, 2.0, 3.0], [2.0, 2.0, 2.0], [3.0, 2.0, 1.0]])
    # residuals of the last: -2, 0, 2 with variance 8/3 against 2/3
    torch.testing.assert_close(explained_variance(value, target), torch.tensor([1.0, 0.0, -3.0]))
    tiny = explained_variance(1e-6 * value, 1e-6 * target)
    torch.testing.assert_close(tiny, torch.tensor([1.0, 0.0, -3.0]))


def test_one_step_targets_by_hand_on_two_transitions():
    """y = r + gamma Q(s'), and r alone where the episode ends."""
    reward, following = row(1.0, 2.0), row(10.0, 20.0)
    assert td_targets(reward, following, flags(False, True), 0.9, 0.0).flatten().tolist() == pytest.approx([10.0, 2.0])
    assert td_targets(reward, following, flags(True, False), 0.9, 0.0).flatten().tolist() == pytest.approx([1.0, 20.0])


def test_lambda_targets_by_hand_on_two_transitions():
    """y_1 = 2 + 0.9 x 20 = 20; y_0 = 1 + 0.9 (0.5 x 10 + 0.5 x 20) = 14.5; nothing flows back over an end."""
    reward, following = row(1.0, 2.0), row(10.0, 20.0)
    never, first = flags(False, False), flags(True, False)
    assert td_targets(reward, following, never, 0.9, 0.5).flatten().tolist() == pytest.approx([14.5, 20.0])
    assert td_targets(reward, following, first, 0.9, 0.5).flatten().tolist() == pytest.approx([1.0, 20.0])
    cut = td_targets(reward, following, never, 0.9, 0.5, cut=first)
    assert cut.flatten().tolist() == pytest.approx([10.0, 20.0]), "after a cut the value counts, and no later step"


def test_a_masked_mean_counts_what_is_valid_alone():
    x = torch.tensor([[[1.0, 2.0], [3.0, torch.nan]], [[5.0, 5.0], [7.0, 7.0]]])
    valid = torch.tensor([[[True, True], [True, False]], [[False, False], [False, False]]])
    assert mean_per_seed(x, valid).tolist() == [2.0, 0.0]
    assert mean_per_seed(torch.stack([x, x + 2], -1), valid).tolist() == [3.0, 0.0]


def test_normalisation_is_per_seed():
    x = torch.tensor([[1.0, 3.0], [10.0, 30.0]])
    torch.testing.assert_close(normalise_per_seed(x, 0.0), torch.tensor([[-1.0, 1.0], [-1.0, 1.0]]))
