"""Statistics over seeds against numbers worked out by hand."""

import math

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from esp_cli.policies.statistics import (
    MOST_RESAMPLED,
    EpisodeSpread,
    Estimate,
    Passing,
    area_under_curve,
    bootstrap_interval,
    curve_band,
    difference,
    holm,
    interquartile_mean,
    mean_and_sem,
    median_steps,
    normalised,
    probability_of_improvement,
    rank_sum_p,
    spread_over_episodes,
    steps_to_threshold,
)

TEN = [-125.0, -121.0, -123.0, -119.0, -130.0, -122.0, -124.0, -118.0, -126.0, -120.0]


def test_mean_and_standard_error_by_hand():
    # deviations -2 0 2: variance 8 / 2 = 4, s.e.m. 2 / sqrt(3)
    assert mean_and_sem([1.0, 3.0, 5.0]) == (3.0, pytest.approx(2 / math.sqrt(3)))
    assert mean_and_sem([4.0]) == (4.0, None)
    assert mean_and_sem([2.0, 2.0]) == (2.0, 0.0)


def test_interval_of_two_seeds_is_the_seeds():
    # a quarter of the resamples are both low, a quarter both high: more than 2.5 % at either end
    assert bootstrap_interval([1.0, 3.0]) == (1.0, 3.0)


@pytest.mark.parametrize("values", [[3.0], [3.0, 3.0, 3.0], [0.1] * 10])
def test_where_the_bootstrap_cannot_tell_there_is_no_interval(values, recwarn):
    assert bootstrap_interval(values) is None
    assert interquartile_mean(values) == Estimate(pytest.approx(values[0]), None)
    assert not recwarn.list


@pytest.mark.parametrize("values", [[], [[1.0]], 3.0])
def test_values_are_one_per_seed(values):
    with pytest.raises(ValueError, match="one number per seed"):
        mean_and_sem(values)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_stopped_seed_is_never_dropped_in_silence(bad):
    for function in (mean_and_sem, bootstrap_interval, interquartile_mean):
        with pytest.raises(ValueError, match=r"not finite at index \[1\]; leave those seeds out and say so"):
            function([1.0, bad, 2.0])


def test_interquartile_mean_by_hand():
    # of eight, two go at either end: (3 + 4 + 5 + 6) / 4
    assert interquartile_mean([1, 2, 3, 4, 5, 6, 7, 1000]).value == 4.5
    # of ten, 2.5 rounded down
    assert interquartile_mean(range(10)).value == 4.5
    # of three, none
    assert interquartile_mean([0, 0, 3]).value == 1.0


def test_difference_by_hand():
    estimate = difference([3.0, 5.0], [1.0, 2.0])
    assert estimate.value == 2.5
    # each mean is low, middle or high with 1/4, 1/2, 1/4: the extremes have 1/16 each
    assert estimate.ci95 == (1.0, 4.0)
    assert difference([3.0], [1.0, 2.0]) == Estimate(1.5, None)
    assert difference([3.0, 3.0], [1.0, 1.0]) == Estimate(2.0, None)


def test_pairing_removes_what_the_seeds_share():
    shared = np.array([0.0, 10.0, 20.0, 30.0, 40.0])
    x, y = shared + np.array([1.0, 2.0, 1.0, 2.0, 1.0]), shared
    paired, unpaired = difference(x, y, paired=True), difference(x, y)
    assert paired.value == pytest.approx(1.4)
    assert unpaired.value == pytest.approx(1.4)
    assert 1.0 <= paired.ci95[0] < paired.ci95[1] <= 2.0
    assert unpaired.ci95[0] < -10


def test_probability_of_improvement_by_hand():
    # pairs (1,0) (1,2) (3,0) (3,2): three wins of four
    assert probability_of_improvement([1.0, 3.0], [0.0, 2.0]).value == 0.75
    # a tie counts half: (1,1) (1,2) (2,1) (2,2) gives 1/2 + 0 + 1 + 1/2
    assert probability_of_improvement([1.0, 2.0], [1.0, 2.0]).value == 0.5
    # seed by seed: a win, a tie, a loss, a win
    paired = probability_of_improvement([2.0, 1.0, 0.0, 5.0], [1.0, 1.0, 1.0, 1.0], paired=True)
    assert paired.value == 2.5 / 4
    # sums of four draws from 1, 1/2, 0, 1: at most 1/2 with 5/256 = 2.0 %, at most 1 with 19/256; four with 16/256
    assert paired.ci95 == (0.25, 1.0)


def test_probability_of_improvement_of_parted_groups_is_one_without_an_interval():
    assert probability_of_improvement([5.0, 6.0, 7.0], [1.0, 2.0]) == Estimate(1.0, None)
    assert probability_of_improvement([1.0, 2.0], [5.0, 6.0, 7.0]) == Estimate(0.0, None)


def test_holms_correction_by_hand():
    # ascending 0.005 * 4, 0.01 * 3, 0.03 * 2, 0.04 * 1, and none below the one before it
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.7, 0.6]) == [1.0, 1.0]
    assert holm([0.2]) == [0.2]
    assert holm([]) == []


def test_the_rank_sum_test_by_hand():
    # of the 20 ways to choose three ranks of six, one has all the highest and one all the lowest
    assert rank_sum_p([4.0, 5.0, 6.0], [1.0, 2.0, 3.0]) == pytest.approx(2 / 20)
    assert rank_sum_p([1.0, 4.0], [2.0, 3.0]) == pytest.approx(1.0)
    # ties, as of successes of 0 or 1: still 2 of 20; of 70, the three ways below and their mirrors are as far apart
    assert rank_sum_p([1.0] * 3, [0.0] * 3) == pytest.approx(2 / 20)
    assert rank_sum_p([1.0, 1.0, 2.0, 2.0], [2.0, 3.0, 3.0, 3.0]) == pytest.approx(6 / 70)
    # ten seeds a side, all apart; with the two in the middle tied as well
    apart = [*range(10)], [*range(10, 20)]
    assert rank_sum_p(*apart) == pytest.approx(2 / math.comb(20, 10))
    assert rank_sum_p(apart[0], [9, *apart[1][1:]]) == pytest.approx(2 * 2 / math.comb(20, 10))


@given(st.lists(st.integers(-99, 99), min_size=2, max_size=24, unique=True), st.data())
def test_without_ties_the_rank_sum_test_is_that_of_scipy(values, data):
    count = data.draw(st.integers(1, len(values) - 1))
    x, y = values[:count], values[count:]
    exact = scipy.stats.mannwhitneyu(x, y, method="exact").pvalue
    assert rank_sum_p(x, y) == pytest.approx(exact) == rank_sum_p(y, x)
    large = np.arange(60.0), np.arange(60.0) + 20.5
    assert rank_sum_p(*large) == scipy.stats.mannwhitneyu(*large).pvalue


def test_steps_to_threshold_by_hand():
    steps = [0, 100, 200, 300]
    values = np.array([[-200.0, -200.0], [-110.0, -160.0], [-120.0, -130.0], [-110.0, -118.0]])
    # means -200 -135 -125 -114
    assert steps_to_threshold(steps, values, -125) == Passing(-125, 200, (100, 300))
    assert steps_to_threshold(steps, values, -115) == Passing(-115, 300, (100, None))
    assert steps_to_threshold(steps, values, -100) == Passing(-100, None, (None, None))


def test_median_steps_by_hand():
    ten = [300, 100, 200, 200, 250, 150, 350, 400, 500, 450]
    # in order 100 150 200 200 250 300 350 400 450 500; P(B <= 1) = 11 / 1024 of ten fair coins, P(B <= 2) = 56 / 1024
    assert median_steps(ten) == (275, (150, 450))
    assert median_steps([1, 2, 3, 4, 5, 6]) == (3.5, (1, 6))  # P(B <= 0) = 1 / 64 < 0.025
    assert median_steps([1, 2, 3, 4, 5]) == (3, None)  # 1 / 32 > 0.025
    assert median_steps([None, *ten[1:-1], None]) == (300, (150, math.inf))
    assert median_steps([None, None, 7]) == (math.inf, None)


def test_the_interval_of_the_median_holds_it_as_often_as_it_says():
    rng = np.random.default_rng(0)
    drawn = rng.exponential(1000.0, (2000, 10))  # of median 1000 log 2
    held = [low <= 1000 * math.log(2) <= high for _, (low, high) in map(median_steps, drawn.tolist())]
    assert np.mean(held) == pytest.approx(0.979, abs=0.01)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_reaches_nothing(bad):
    values = np.array([[0.0, 0.0], [2.0, bad], [2.0, bad]])
    assert steps_to_threshold([1, 2, 3], values, 1.0) == Passing(1.0, None, (2, None))


def test_area_under_curve_by_hand():
    # trapezoids 100 * 1 + 300 * 2 over 400; a constant has its height
    values = np.array([[0.0, 7.0], [2.0, 7.0], [2.0, 7.0]])
    assert area_under_curve([0, 100, 400], values).tolist() == [1.75, 7.0]


@pytest.mark.parametrize("steps", [[2, 1], [1, 1]])
def test_steps_that_do_not_ascend_are_one_sentence(steps):
    with pytest.raises(ValueError, match="ascend"):
        steps_to_threshold(steps, [[1.0], [2.0]], 0.0)


def test_normalised_sets_random_to_zero_and_the_best_heuristic_to_one():
    anchors = {"random": -220.0, "heuristic": -110.0, "cover": -150.0}
    assert normalised([-220.0, -110.0, -165.0, -55.0], anchors).tolist() == [0.0, 1.0, 0.5, 1.5]
    for scaleless in (
        {"random": -220.0},
        {"random": -220.0, "heuristic": -220.0},
        {"random": 0.0, "heuristic": math.nan},
    ):
        assert normalised([1.0], scaleless) is None


def test_curve_band_is_the_interval_at_each_step():
    values = np.array([TEN, [2 * value for value in TEN]])
    mean, low, high = curve_band(values)
    assert mean.tolist() == [pytest.approx(-122.8), pytest.approx(-245.6)]
    # the same seeds are drawn at every step
    assert low[1] == pytest.approx(2 * low[0])
    assert high[1] == pytest.approx(2 * high[0])
    assert (low[0], high[0]) == pytest.approx(bootstrap_interval(TEN), abs=0.2)


def test_a_stopped_seed_leaves_a_gap_and_one_seed_is_the_curve(recwarn):
    for edge in curve_band([[1.0, 2.0], [math.nan, 2.0], [-math.inf, math.inf]]):
        assert np.isfinite(edge).tolist() == [True, False, False]
    for edge in curve_band([[1.0], [2.0]]):
        assert edge.tolist() == [1.0, 2.0]
    assert not recwarn.list


def test_the_spread_over_episodes_is_that_of_their_mean() -> None:
    spread = spread_over_episodes([1.0, 3.0, 5.0, 7.0])
    assert spread.sem == pytest.approx(math.sqrt(20 / 3) / 2)
    assert spread.ci95 is not None
    assert spread.ci95[0] < 4 < spread.ci95[1]
    assert spread_over_episodes([2.0]) == EpisodeSpread(None, None)
    assert spread_over_episodes([2.0, 2.0]) == EpisodeSpread(0.0, None)
    assert spread_over_episodes([2.0] * (MOST_RESAMPLED + 1)) == EpisodeSpread(0.0, None)


def test_many_episodes_have_the_normal_interval_and_it_is_near_the_bootstraps() -> None:
    returns = np.random.default_rng(0).normal(-100, 10, MOST_RESAMPLED + 1)
    many, fewer = spread_over_episodes(returns), spread_over_episodes(returns[:-1])
    assert many.sem is not None
    assert many.ci95 == pytest.approx((returns.mean() - 1.959964 * many.sem, returns.mean() + 1.959964 * many.sem))
    assert fewer.ci95 == pytest.approx(many.ci95, abs=0.1)
