"""The value normaliser against numbers worked out by hand."""

import pytest
import torch

from esp_cli.algorithms.learner import below
from esp_cli.algorithms.normalisation import ValueNormaliser, with_variances


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


@pytest.mark.parametrize("deviation", [1e-3, 1.0, 1e6])
@pytest.mark.parametrize("offset", [0.0, 10.0, -1e3, 1e4, 1e6])
@pytest.mark.parametrize("decay", [0.9, 0.99999])
def test_an_offset_takes_nothing_from_the_deviation(offset, deviation, decay):
    """Offsets in deviations; at a million of them, float32 still holds numbers to a sixteenth of a deviation."""
    normaliser = ValueNormaliser(2, decay)
    targets = deviation * (offset + torch.tensor([-1.0, 1.0, 1.0, -1.0]).expand(2, -1))
    for _ in range(300):
        normaliser.update(targets)
    tolerance = {"atol": 0.07 if abs(offset) == 1e6 else 1e-2, "rtol": 0.0}
    normalised = normaliser.normalise(targets)
    torch.testing.assert_close(normalised.std(1, correction=0), torch.ones(2), **tolerance)
    torch.testing.assert_close(normalised.mean(1), torch.zeros(2), **tolerance)
    torch.testing.assert_close(normaliser.denormalise(normalised), targets)


def test_statistics_equal_those_of_decayed_sums():
    """The average weighs batch k of n by decay^(n - k), in mean and in mean square."""
    generator = torch.Generator().manual_seed(0)
    batches = [3 * k + torch.randn(2, 5, 4, generator=generator, dtype=torch.float64) for k in range(6)]
    valid = torch.rand(2, 5, 4, generator=generator) < 0.5
    for mask in (None, valid):
        normaliser, weights = ValueNormaliser(2, 0.8), torch.tensor([0.8 ** (5 - k) for k in range(6)]).double()
        for batch in batches:
            normaliser.update(batch.float(), mask)
        counted = [batch[s][mask[s]] if mask is not None else batch[s] for s in range(2) for batch in batches]
        means = torch.stack([x.float().double().mean() for x in counted]).view(2, 6)
        squares = torch.stack([x.float().double().square().mean() for x in counted]).view(2, 6)
        mean, square = (means @ weights / weights.sum(), squares @ weights / weights.sum())
        torch.testing.assert_close(normaliser.mean, mean)
        torch.testing.assert_close(normaliser.variance, square - mean.square())


def test_a_seed_in_which_nothing_counts_keeps_its_statistics():
    normaliser = ValueNormaliser(2, 0.9)
    normaliser.update(torch.tensor([[1.0, 3.0], [1.0, 3.0]]))
    normaliser.update(torch.tensor([[9.0, 9.0], [9.0, 9.0]]), torch.tensor([[False, False], [True, True]]))
    assert (normaliser.mean[0], normaliser.variance[0]) == (2.0, 1.0)
    assert normaliser.mean[1] > 5


def test_numbers_that_are_all_alike_become_zero_and_no_noise():
    normaliser = ValueNormaliser(2, 0.9)
    alike = torch.tensor([[0.0], [1e4]]).expand(2, 8)
    for _ in range(5):
        normaliser.update(alike)
    assert normaliser.normalise(alike).abs().max() < 1e-3
    rounded = torch.nextafter(alike[1:, :1], torch.tensor(torch.inf))
    assert normaliser.normalise(rounded.expand(2, 1))[1].abs() < 2, "what float32 cannot tell apart is within one unit"


def test_what_0_1_stored_means_the_same_and_goes_on_alike():
    """It stored decayed sums; of (1, 3), then (5, 9), with decay 0.5."""
    mean, square = 0.25 * 2 + 0.5 * 7, 0.25 * 5 + 0.5 * 53
    old = {"mean": torch.tensor([mean]), "square": torch.tensor([square]), "weight": torch.tensor([0.75])}
    throughout, resumed = ValueNormaliser(1, 0.5), ValueNormaliser(1, 0.5)
    for batch in ([1.0, 3.0], [5.0, 9.0]):
        throughout.update(torch.tensor([batch]))
    resumed.load_state_dict(below(with_variances({f"reward_scale.{k}": v for k, v in old.items()}), "reward_scale"))
    for now in range(2):
        for name, value in throughout.state_dict().items():
            torch.testing.assert_close(resumed.state_dict()[name], value)
        for one in (throughout, resumed):
            one.update(torch.tensor([[0.1, 0.7 + now]]))


@pytest.mark.parametrize("missing", ["mean", "weight"])
def test_a_state_of_other_parts_or_shapes_is_left_to_be_refused(missing):
    state = {f"normaliser.{name}": torch.ones(2) for name in ("mean", "square", "weight")}
    del state[f"normaliser.{missing}"]
    assert with_variances(state) == state
    state[f"normaliser.{missing}"] = torch.ones(3)
    assert with_variances(state).keys() == state.keys()
    fresh = with_variances({name: torch.zeros(2) for name in state})
    normaliser = ValueNormaliser(2, 0.5)
    normaliser.load_state_dict(below(fresh, "normaliser"))
    assert normaliser.normalise(torch.full((2, 1), 5.0)).tolist() == [[5.0], [5.0]]
