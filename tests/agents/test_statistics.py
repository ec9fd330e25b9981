"""Statistics of episodes against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import binom, norm

from agents.statistics import FirstValues, RunningSum, share, wilson_interval

KEPT = 65_536


@pytest.mark.parametrize("trials", [1, 2, 17, 1000, 10**7])
@pytest.mark.parametrize("confidence", [0.8, 0.95, 0.999])
def test_wilson_interval_is_the_closed_form(trials, confidence):
    z = norm.ppf(0.5 + confidence / 2)
    for successes in {0, 1, trials // 3, trials - 1, trials}:
        p = successes / trials
        center = (p + z**2 / (2 * trials)) / (1 + z**2 / trials)
        half = z / (1 + z**2 / trials) * math.sqrt(p * (1 - p) / trials + z**2 / (4 * trials**2))
        low, high = wilson_interval(successes, trials, confidence)
        assert (low, high) == (pytest.approx(center - half, abs=1e-12), pytest.approx(center + half, abs=1e-12))
        assert 0.0 <= low <= p <= high <= 1.0


@pytest.mark.parametrize("trials", [1, 5, 300])
def test_wilson_interval_at_its_ends(trials):
    z = norm.ppf(0.975)
    low, high = wilson_interval(0, trials)
    assert low == 0.0
    assert high == pytest.approx(z**2 / (trials + z**2))
    low, high = wilson_interval(trials, trials)
    assert high == 1.0
    assert low == pytest.approx(trials / (trials + z**2))


def test_wilson_interval_is_symmetric_and_95_percent_by_default():
    low, high = wilson_interval(7, 30)
    assert wilson_interval(23, 30) == (pytest.approx(1 - high), pytest.approx(1 - low))
    assert wilson_interval(7, 30) == wilson_interval(7, 30, 0.95)


def test_wilson_interval_covers_as_often_as_it_says():
    trials = 100
    successes = np.arange(trials + 1)
    low, high = np.array([wilson_interval(int(k), trials) for k in successes]).T
    coverage = [binom.pmf(successes, trials, p)[(low <= p) & (p <= high)].sum() for p in np.linspace(0.05, 0.95, 181)]
    assert min(coverage) > 0.91
    assert np.mean(coverage) == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize("portion", [1, 2, 7, 64, 1000, 5000])
def test_running_sum_is_the_same_for_any_portions(portion):
    values = np.random.default_rng(0).standard_normal(5000) * 10.0 ** np.random.default_rng(1).integers(-12, 12, 5000)
    one_by_one = 0.0
    for value in values.tolist():
        one_by_one += value
    total = RunningSum()
    for k in range(0, len(values), portion):
        total.add(values[k : k + portion])
        total.add(values[:0])
    assert total.total == one_by_one
    # Summation by pairs differs, so that the order did matter.
    assert total.total != values.sum()


@pytest.mark.parametrize("portion", [1000, 65_535, 65_536, 65_537, 200_000])
def test_first_values_give_the_quantiles_of_the_first_ones(portion):
    values = np.random.default_rng(2).standard_normal(200_000) + np.arange(200_000) / 50_000
    kept = FirstValues()
    for k in range(0, len(values), portion):
        kept.add(values[k : k + portion])
    levels = (0.0, 0.05, 0.5, 1.0)
    assert kept.quantiles(levels) == np.quantile(values[:KEPT], levels).tolist()
    assert sum(part.size for part in kept._parts) == KEPT


def test_first_values_keep_no_view_of_what_they_were_given():
    values = np.arange(5.0)
    kept = FirstValues()
    kept.add(values)
    values[:] = 99.0
    assert kept.quantiles((0.0, 0.5, 1.0)) == [0.0, 2.0, 4.0]


def test_share_of_nothing_is_none():
    assert share(1.0, 4) == 0.25
    assert share(0.0, 0) is None
