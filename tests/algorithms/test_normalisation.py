"""The value normaliser against numbers worked out by hand."""

import torch

from esp_cli.algorithms.normalisation import ValueNormaliser


def test_first_update_gives_the_batch_statistics_of_each_seed():
    normaliser = ValueNormaliser(2, decay=0.9)
    normaliser.update(torch.tensor([[1.0, 3.0], [10.0, 50.0]]))  # means 2 and 30, deviations 1 and 20
    x = torch.tensor([[3.0], [50.0]])
    torch.testing.assert_close(normaliser.normalise(x), torch.tensor([[1.0], [1.0]]))
    torch.testing.assert_close(normaliser.denormalise(torch.tensor([[1.0], [1.0]])), x)


def test_second_update_weighs_by_the_decay_with_bias_correction():
    normaliser = ValueNormaliser(1, decay=0.5)
    normaliser.update(torch.tensor([[0.0, 0.0]]))
    normaliser.update(torch.tensor([[3.0, 3.0]]))
    # weights 0.25 and 0.5, sum 0.75: mean (0.5 * 3) / 0.75 = 2, square (0.5 * 9) / 0.75 = 6, variance 6 - 4 = 2
    torch.testing.assert_close(normaliser.normalise(torch.tensor([[2.0 + 2.0**0.5]])), torch.tensor([[1.0]]))


def test_it_leaves_numbers_alone_before_the_first_update():
    normaliser = ValueNormaliser(1, decay=0.9)
    assert normaliser.normalise(torch.tensor([[5.0]])).item() == 5.0
    assert normaliser.denormalise(torch.tensor([[5.0]])).item() == 5.0


def test_scaling_takes_no_mean_off():
    """Of (1, 7) the mean square is 25, of a constant 3 it is 9."""
    normaliser = ValueNormaliser(2, decay=0.9)
    normaliser.update(torch.tensor([[1.0, 7.0], [3.0, 3.0]]))
    torch.testing.assert_close(normaliser.scaled(torch.tensor([[10.0], [3.0]])), torch.tensor([[2.0], [1.0]]))
    assert ValueNormaliser(1, decay=0.9).scaled(torch.tensor([[5.0]])).item() == 5.0
