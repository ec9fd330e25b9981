"""Statistics of episodes against closed forms."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from scipy.stats import binom, binomtest, multinomial, norm

from safe_envs import ConfigurationError
from safe_envs.agents.evaluation.statistics import (
    RunningMean,
    RunningSum,
    exact_interval,
    exact_upper_end,
    log_normal_interval,
    mcnemar_p,
    paired_difference_interval,
    rate_band,
    rate_interval,
    share,
    wilson_interval,
)

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
        assert (low, high) == (
            pytest.approx(center - half, abs=1e-12),
            pytest.approx(center + half, abs=1e-12),
        )
        assert 0.0 <= low <= p <= high <= 1.0
        wanted = binomtest(successes, trials).proportion_ci(confidence, method="wilson")
        assert (low, high) == (
            pytest.approx(wanted.low, rel=1e-9, abs=1e-15),
            pytest.approx(wanted.high, rel=1e-9, abs=1e-15),
        )


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
    coverage = [
        binom.pmf(successes, trials, p)[(low <= p) & (p <= high)].sum()
        for p in np.linspace(0.05, 0.95, 181)
    ]
    assert min(coverage) > 0.91
    assert np.mean(coverage) == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize("trials", [1, 2, 40, 1000, 10**6])
@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.999])
def test_rate_interval_is_exact_at_none_and_all_and_wilsons_in_between(trials, confidence):
    for successes in {0, trials}:
        exact = binomtest(successes, trials).proportion_ci(confidence, method="exact")
        low, high = rate_interval(successes, trials, confidence)
        assert (low, high) == (
            pytest.approx(exact.low, rel=1e-9),
            pytest.approx(exact.high, rel=1e-9),
        )
        assert (low, high) != wilson_interval(successes, trials, confidence)
    for successes in {1, trials // 2, trials - 1} - {0, trials}:
        assert rate_interval(successes, trials, confidence) == wilson_interval(
            successes, trials, confidence
        )


def test_all_of_a_thousand():
    # The rule of three for two sides: the rate that shows no failure in a thousand with probability
    # .025.
    assert rate_interval(1000, 1000) == (pytest.approx(0.025 ** (1 / 1000)), 1.0)
    assert rate_interval(0, 1000) == (0.0, pytest.approx(1 - 0.025 ** (1 / 1000)))


def test_rate_band_is_the_interval_of_each_count():
    counts = np.arange(21)
    low, high = rate_band(counts, 20, 0.9)
    assert list(zip(low.tolist(), high.tolist(), strict=True)) == [
        rate_interval(k, 20, 0.9) for k in range(21)
    ]


def test_rate_interval_covers_as_often_as_it_says():
    trials = 60
    successes = np.arange(trials + 1)
    low, high = rate_band(successes, trials)

    def coverage(rates):
        return np.array(
            [binom.pmf(successes, trials, p)[(low <= p) & (p <= high)].sum() for p in rates]
        )

    middle, low_rates = coverage(np.linspace(0.05, 0.95, 181)), np.linspace(1e-4, 0.05, 500)
    assert middle.min() > 0.91
    assert middle.mean() == pytest.approx(0.95, abs=0.01)
    assert coverage(1 - low_rates) == pytest.approx(coverage(low_rates), abs=1e-12)
    # Wilson's interval of a single failure is known to be short: .838 is its limit there. On the
    # average it is right.
    assert coverage(low_rates).min() > 0.838
    assert coverage(low_rates).mean() > 0.95
    # Where a failure is unlikely to be seen at all, the exact interval of none holds the rate.
    assert coverage([1 - 0.975 ** (1 / trials)])[0] >= 0.975 - 1e-12


@pytest.mark.parametrize(("trials", "error"), [(50, 0.005), (500, 0.00125)])
def test_the_upper_end_errs_as_seldom_as_it_says(trials, error):
    successes = np.arange(trials + 1)
    ends = np.array([exact_upper_end(int(s), trials, error) for s in successes])
    for unsafe in np.geomspace(1e-6, 0.5, 60):
        assert binom.pmf(successes, trials, 1 - unsafe)[ends < 1 - unsafe].sum() <= error * (
            1 + 1e-9
        )
    assert (np.diff(ends) > 0).all()


@pytest.mark.parametrize(("trials", "confidence"), [(20, 0.9), (1000, 0.999)])
def test_an_exact_interval_is_wrong_on_either_side_as_seldom_as_it_says(trials, confidence):
    counts = np.arange(trials + 1)
    low, high = np.array([exact_interval(int(s), trials, confidence) for s in counts]).T
    assert ((low <= counts / trials) & (counts / trials <= high)).all()
    for p in (*np.geomspace(1e-6, 0.5, 30), *(1.0 - np.geomspace(1e-6, 0.5, 30))):
        weights = binom.pmf(counts, trials, p)
        tail = (1.0 - confidence) / 2.0 * (1.0 + 1e-9)
        assert max(weights[high < p].sum(), weights[low > p].sum()) <= tail


@pytest.mark.parametrize(
    ("only_first", "only_second"), [(0, 1), (2, 0), (3, 3), (4, 5), (2, 162), (30, 12), (700, 800)]
)
def test_mcnemar_is_the_exact_binomial_test(only_first, only_second):
    n, fewer = only_first + only_second, min(only_first, only_second)
    tail = Fraction(sum(math.comb(n, k) for k in range(fewer + 1)), 2**n)
    p = mcnemar_p(only_first, only_second)
    assert p == mcnemar_p(only_second, only_first)
    assert p == pytest.approx(float(min(Fraction(1), 2 * tail)), rel=1e-11)
    assert p == pytest.approx(binomtest(only_first, n).pvalue, rel=1e-9)


def test_mcnemar_without_pairs_that_differ_says_nothing():
    assert mcnemar_p(0, 0) == 1.0


@pytest.mark.parametrize(
    ("table", "low", "high"),
    [
        # Altman et al., Statistics with Confidence (2000), p. 52: thallium stress test.
        ((14, 5, 0, 22), 0.011, 0.226),
        # Fagerland et al., Statistical Analysis of Contingency Tables (2017), chapter 8: airway
        # hyper-responsiveness.
        ((1, 1, 7, 12), -0.507, -0.026),
    ],
)
def test_difference_of_paired_rates_as_published(table, low, high):
    # One unit of the last digit: the sources round their intermediate results.
    assert paired_difference_interval(*table) == (
        pytest.approx(low, abs=1e-3),
        pytest.approx(high, abs=1e-3),
    )


def all_tables(n):
    return [
        (a, b, c, n - a - b - c)
        for a, b, c in itertools.product(range(n + 1), repeat=3)
        if a + b + c <= n
    ]


def test_difference_of_paired_rates_is_antisymmetric_and_holds_the_difference():
    for both, first, second, neither in all_tables(11):
        low, high = paired_difference_interval(both, first, second, neither)
        turned = (pytest.approx(-high, abs=1e-12), pytest.approx(-low, abs=1e-12))
        assert paired_difference_interval(both, second, first, neither) == turned
        # Failures in the place of successes, and the filters swapped: the difference is the same
        # one.
        assert paired_difference_interval(neither, first, second, both) == pytest.approx(
            (low, high), abs=1e-12
        )
        assert -1.0 - 1e-12 <= low <= (first - second) / 11 <= high <= 1.0 + 1e-12


def test_pairs_without_correlation_are_as_independent_rates():
    def difference_interval(s1, n1, s2, n2):
        """Newcombe (1998), Statistics in Medicine 17, 873-890, method 10."""
        (low1, high1), (low2, high2) = wilson_interval(s1, n1), wilson_interval(s2, n2)
        p1, p2 = s1 / n1, s2 / n2
        return p1 - p2 - math.hypot(p1 - low1, high2 - p2), p1 - p2 + math.hypot(
            high1 - p1, p2 - low2
        )

    # ad = bc, and a correlation so small that the correction for continuity takes it away.
    assert paired_difference_interval(40, 20, 20, 10) == pytest.approx(
        difference_interval(60, 90, 60, 90), abs=1e-15
    )
    assert paired_difference_interval(41, 20, 20, 10) == pytest.approx(
        difference_interval(61, 91, 61, 91), abs=1e-15
    )
    assert paired_difference_interval(50, 10, 10, 20)[1] < difference_interval(60, 90, 60, 90)[1]
    assert paired_difference_interval(20, 40, 10, 20) == pytest.approx(
        difference_interval(60, 90, 30, 90), abs=1e-15
    )


def test_difference_of_paired_rates_covers_as_often_as_it_says():
    n = 20
    tables = np.array(all_tables(n))
    low, high = np.array([paired_difference_interval(*map(int, t)) for t in tables]).T
    coverage = []
    for q in (
        (0.4, 0.3, 0.1, 0.2),
        (0.7, 0.1, 0.1, 0.1),
        (0.25, 0.25, 0.25, 0.25),
        (0.8, 0.15, 0.02, 0.03),
        (0.1, 0.6, 0.1, 0.2),
    ):
        true = q[1] - q[2]
        coverage.append(multinomial.pmf(tables, n, q)[(low <= true) & (true <= high)].sum())
    assert min(coverage) > 0.92
    assert np.mean(coverage) == pytest.approx(0.955, abs=0.015)


@pytest.mark.parametrize("confidence", [0.0, 1.0, -0.5, 95, math.nan, "0.9", None])
def test_confidences_out_of_range_are_named(confidence):
    with pytest.raises(
        ConfigurationError,
        match=r"confidence = .*; give a number above 0 and below 1, such as 0\.95",
    ):
        rate_interval(3, 7, confidence)


@pytest.mark.parametrize(
    "call",
    [
        lambda: wilson_interval(5, 3),
        lambda: rate_interval(-1, 3),
        lambda: rate_interval(0, 0),
        lambda: paired_difference_interval(3, -1, 2, 4),
        lambda: paired_difference_interval(0, 0, 0, 0),
    ],
)
def test_counts_that_cannot_be_are_named(call):
    with pytest.raises(ConfigurationError, match=r"successes in|counts of pairs"):
        call()


@pytest.mark.parametrize("portion", [1, 2, 7, 64, 1000, 5000])
def test_running_sum_is_the_same_for_any_portions(portion):
    values = np.random.default_rng(0).standard_normal(5000) * 10.0 ** np.random.default_rng(
        1
    ).integers(-12, 12, 5000)
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


def test_share_of_nothing_is_none():
    assert share(1.0, 4) == 0.25
    assert share(0.0, 0) is None


@pytest.mark.parametrize("estimates", [(1.0, 2.0), (3e-7, 4e-9)])
def test_the_interval_of_two_log_normal_estimates_by_hand(estimates):
    """Cox's, where all is elementary: Student's quantile with one degree of freedom is a tangent.

    log E = mu + sigma^2/2 is estimated by the mean of the logs, with the variance s^2/R, and half
    of s^2, with the variance (2 s^4/(R - 1))/4 = s^4/(2 (R - 1)).
    """
    square = math.log(estimates[1] / estimates[0]) ** 2 / 2
    half = math.tan(math.pi * (0.975 - 0.5)) * math.sqrt(square / 2 + square**2 / 2)
    mean = sum(estimates) / 2
    assert log_normal_interval(estimates) == pytest.approx(
        (mean * math.exp(-half), mean * math.exp(half)), rel=1e-12
    )


def test_a_running_mean_has_a_standard_error():
    values = np.random.default_rng(3).random(1000)
    found = [RunningMean() for _ in range(2)]
    found[0].add(values)
    for part in np.split(values, [1, 400]):
        found[1].add(part)
    assert found[0].mean == found[1].mean == pytest.approx(values.mean())
    assert found[0].error == found[1].error
    assert found[0].error == pytest.approx(values.std(ddof=1) / np.sqrt(1000))
    equal, empty = RunningMean(), RunningMean()
    equal.add(np.full(1000, 0.1))
    assert (equal.error, empty.mean, empty.error) == (0.0, None, 0.0)
