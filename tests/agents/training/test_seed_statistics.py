"""Interquartile means and bootstrap intervals: enumerations, closed forms, how often they hold."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.stats import binom, trim_mean

from safe_envs import ConfigurationError
from safe_envs.agents.training import study
from safe_envs.agents.training.study import caution, interquartile_mean, over_seeds


@pytest.mark.parametrize("count", range(1, 15))
def test_the_interquartile_mean_is_scipys_trimmed_mean(count):
    values = np.random.default_rng(count).normal(size=(6, count))
    expected = trim_mean(values, 0.25, axis=-1)
    np.testing.assert_allclose(interquartile_mean(values), expected, rtol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6])
@pytest.mark.parametrize("confidence", [0.5, 0.9, 0.95, 0.99])
def test_one_env_is_the_enumeration_of_all_draws(count, confidence):
    values = np.random.default_rng(count).normal(size=count)
    draws = np.array(list(itertools.product(values, repeat=count)))
    means = np.sort(trim_mean(draws, 0.25, axis=-1))
    # The smallest value up to which a share of at least `tail` of the draws lies, and its mirror
    # image.
    tail = (1 - confidence) / 2
    place = next(k for k in range(len(means)) if (k + 1) / len(means) >= tail - 1e-12)
    found = over_seeds([values], confidence)
    assert found.low == pytest.approx(means[place], abs=1e-14)
    assert found.high == pytest.approx(means[::-1][place], abs=1e-14)
    assert found.value == pytest.approx(trim_mean(values, 0.25))
    assert found.seeds == count


def test_all_draws_are_counted_once():
    for count in range(1, 9):
        chosen, ways = study._multisets(count)
        assert ways.sum() == count**count
        assert len(np.unique(chosen, axis=0)) == len(chosen)


def test_two_different_values_give_the_binomial_distribution():
    # Of five draws from {0, 0, 1, 1, 1}, k are 1: the middle three have clip(k - 1, 0, 3) ones.
    shares = np.array([binom.pmf(k, 5, 0.6) for k in range(6)])
    means = np.clip(np.arange(6) - 1, 0, 3) / 3
    for confidence in (0.5, 0.8, 0.95):
        tail = (1 - confidence) / 2
        low = means[np.searchsorted(np.cumsum(shares), tail)]
        high = means[::-1][np.searchsorted(np.cumsum(shares[::-1]), tail)]
        found = over_seeds([[1, 0, 1, 0, 1]], confidence)
        assert (found.low, found.high) == (pytest.approx(low), pytest.approx(high))


def test_several_envs_are_drawn_within_each():
    # Every draw from two constant envs is the same, whatever the envs.
    found = over_seeds([[1.0] * 5, [3.0] * 5])
    assert (found.value, found.low, found.high) == (2.0, 2.0, 2.0)
    # All draws of 3 of 3 in two envs, in comparison with those that are sampled.
    values = np.array([[0.1, 0.5, 0.8], [0.3, 0.35, 0.9]])
    of_env = [list(itertools.product(row, repeat=3)) for row in values]
    draws = np.array([a + b for a, b in itertools.product(*of_env)])
    means = np.sort(trim_mean(draws, 0.25, axis=-1))
    found = over_seeds(values.tolist(), 0.9)
    for end, tail in ((found.low, 0.05), (found.high, 0.95)):
        # Within three standard deviations of the number of draws below the end.
        error = 3 * np.sqrt(0.05 * 0.95 / study._RESAMPLES)
        below, up_to = (means < end - 1e-12).mean(), (means <= end + 1e-12).mean()
        assert below - error <= tail <= up_to + error
    assert over_seeds(values.tolist(), 0.9) == found
    assert over_seeds(values.tolist(), 0.9, seed=1).value == found.value


def test_the_order_of_seeds_and_the_sign_do_not_matter():
    values = [0.2, 0.7, 0.1, 0.9, 0.4]
    found, mirrored = over_seeds([values]), over_seeds([[-v for v in values]])
    assert over_seeds([values[::-1]]) == found
    assert (mirrored.low, mirrored.high) == (-found.high, -found.low)
    assert found.low <= found.value <= found.high


def test_nothing_and_what_is_not_finite_are_errors():
    for strata in ([], [[]], [[1.0], []], [[1.0, float("nan")]], [[float("inf")]]):
        with pytest.raises(ConfigurationError, match="at least one number"):
            over_seeds(strata)
    with pytest.raises(ConfigurationError, match="confidence"):
        over_seeds([[1.0]], 1.0)


def coverage(draw, truth, count, trials, seed=0):
    """Return how often the 95 % interval of so many values holds the truth."""
    rng = np.random.default_rng(seed)
    found = [over_seeds([draw(rng, count)]) for _ in range(trials)]
    return np.mean([each.low <= truth <= each.high for each in found])


def normal(rng, count):
    return rng.normal(size=count)


def test_intervals_of_few_seeds_hold_less_often_than_they_say():
    # Of three values it is from the least to the largest, as (1/3)^3 > 2.5 %: both are on one side
    # of the median with probability 2/2^3.
    three, five = (coverage(normal, 0.0, count, 1000) for count in (3, 5))
    assert three == pytest.approx(0.75, abs=4 * np.sqrt(0.75 * 0.25 / 1000))
    assert three < five < 0.95


def test_intervals_of_few_seeds_come_with_what_they_are_worth():
    assert "no length" in caution(1)
    assert over_seeds([[0.3]]).low == over_seeds([[0.3]]).high
    assert "over 3 seeds holds the true value in 75 %" in caution(3)
    assert caution(20) == ""


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("count", "rate"), [(2, 0.5), (3, 0.75), (4, 0.877), (5, 0.906), (8, 0.935)]
)
def test_how_often_the_interval_holds(count, rate):
    # The guide names the number for five seeds, and the notes of tables those up to five.
    assert study._HOLDS.get(count, round(100 * rate)) == round(100 * rate)
    found = coverage(normal, 0.0, count, 20_000, seed=1)
    assert found == pytest.approx(rate, abs=4 * np.sqrt(rate * (1 - rate) / 20_000) + 5e-4)
