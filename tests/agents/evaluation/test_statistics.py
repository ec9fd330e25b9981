"""Intervals and tests of rates against closed forms, exact binomial tails and published numbers."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom, multinomial, norm
from scipy.stats import t as student

from safe_envs import ConfigurationError
from safe_envs.agents.evaluation.identification import interval_over
from safe_envs.agents.evaluation.statistics import (
    SafeFlags,
    combined_rates,
    compare_all,
    exact_interval,
    exact_upper_end,
    log_normal_interval,
    mcnemar_p,
    pair_counts,
    paired_difference_interval,
    percent,
    percent_in,
    points_in,
    rate_band,
    rate_interval,
    repeated_interval,
    wilson_interval,
)


def near(*ends, rel=1e-9):
    return pytest.approx(ends, rel=rel, abs=1e-12)


@settings(max_examples=50)
@given(st.integers(1, 10**7), st.floats(0.0, 1.0), st.sampled_from([0.8, 0.95, 0.999]))
def test_wilsons_interval_is_the_closed_form_and_the_exact_one_is_taken_at_its_ends(
    trials, share, confidence
):
    successes = round(share * trials)
    z, p = norm.ppf(0.5 + confidence / 2), successes / trials
    center = (p + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * math.sqrt(p * (1 - p) / trials + z**2 / (4 * trials**2))
    low, high = wilson_interval(successes, trials, confidence)
    assert (low, high) == near(max(center - half, 0.0), min(center + half, 1.0))
    assert 0.0 <= low <= p <= high <= 1.0
    assert wilson_interval(trials - successes, trials, confidence) == near(1 - high, 1 - low)
    # By definition: what is as extreme has the probability of a tail at either end.
    exact = exact_interval(successes, trials, confidence)
    tail = pytest.approx((1 - confidence) / 2)
    assert exact[0] == 0.0 if successes == 0 else binom.sf(successes - 1, trials, exact[0]) == tail
    assert (
        exact[1] == 1.0 if successes == trials else binom.cdf(successes, trials, exact[1]) == tail
    )
    wanted = exact if successes in (0, trials) else (low, high)
    assert rate_interval(successes, trials, confidence) == near(*wanted)


def test_intervals_are_of_95_percent_by_default_and_those_of_counts_one_by_one():
    assert rate_interval(7, 30) == rate_interval(7, 30, 0.95)
    assert wilson_interval(0, 5)[0] == 0.0
    assert wilson_interval(5, 5)[1] == 1.0
    # The rule of three for two sides: the rate that shows no failure in a thousand with probability
    # .025.
    assert rate_interval(1000, 1000) == (pytest.approx(0.025 ** (1 / 1000)), 1.0)
    counts = np.arange(21)
    band = np.array(rate_band(counts, 20, 0.9)).T
    assert list(map(tuple, band)) == [rate_interval(k, 20, 0.9) for k in range(21)]


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
def test_exact_ends_err_on_either_side_as_seldom_as_they_say(trials, error):
    counts = np.arange(trials + 1)
    low, high = np.array([exact_interval(int(s), trials, 1 - 2 * error) for s in counts]).T
    ends = np.array([exact_upper_end(int(s), trials, error) for s in counts])
    assert ((low <= counts / trials) & (counts / trials <= high)).all()
    assert (np.diff(ends) > 0).all()
    for p in (*np.geomspace(1e-6, 0.5, 30), *(1.0 - np.geomspace(1e-6, 0.5, 30))):
        weights = binom.pmf(counts, trials, p)
        for wrong in (high < p, low > p, ends < p):
            assert weights[wrong].sum() <= error * (1 + 1e-9)


@pytest.mark.parametrize(
    ("only_first", "only_second"), [(0, 1), (3, 3), (4, 5), (2, 162), (700, 800)]
)
def test_mcnemar_is_the_exact_binomial_test(only_first, only_second):
    n, fewer = only_first + only_second, min(only_first, only_second)
    tail = Fraction(sum(math.comb(n, k) for k in range(fewer + 1)), 2**n)
    p = mcnemar_p(only_first, only_second)
    assert p == mcnemar_p(only_second, only_first)
    assert p == pytest.approx(float(min(Fraction(1), 2 * tail)), rel=1e-11)
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
    assert paired_difference_interval(*table) == pytest.approx((low, high), abs=1e-3)


def all_tables(n):
    triples = itertools.product(range(n + 1), repeat=3)
    return [(*t, n - sum(t)) for t in triples if sum(t) <= n]


def test_difference_of_paired_rates_is_antisymmetric_and_holds_the_difference():
    for both, first, second, neither in all_tables(11):
        low, high = paired_difference_interval(both, first, second, neither)
        assert paired_difference_interval(both, second, first, neither) == near(-high, -low)
        # Failures in the place of successes, and the filters swapped.
        assert paired_difference_interval(neither, first, second, both) == near(low, high)
        assert -1.0 - 1e-12 <= low <= (first - second) / 11 <= high <= 1.0 + 1e-12


def test_difference_of_paired_rates_covers_as_often_as_it_says():
    tables = np.array(all_tables(20))
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
        coverage.append(multinomial.pmf(tables, 20, q)[(low <= true) & (true <= high)].sum())
    assert min(coverage) > 0.92
    assert np.mean(coverage) == pytest.approx(0.955, abs=0.015)


def test_pairs_are_counted_and_each_filter_is_compared_with_those_before_it():
    rng = np.random.default_rng(0)
    a, b = rng.random(2003) < 0.7, rng.random(2003) < 0.3
    table = pair_counts(SafeFlags.of(a), SafeFlags.of(b))
    assert table == ((a & b).sum(), (a & ~b).sum(), (~a & b).sum(), (~a & ~b).sum())
    with pytest.raises(ValueError, match="2003 and 2002"):
        pair_counts(SafeFlags.of(a), SafeFlags.of(b[1:]))
    values = {"a": [1, 1, 0, 0, 1], "b": [1, 0, 0, 1, 1], "c": [1, 1, 1, 1, 1]}
    flags = {name: [SafeFlags.of(np.array(v, dtype=bool))] for name, v in values.items()}
    found = [
        (c.first, c.second, c.only_first, c.only_second, c.difference)
        for c in compare_all(flags, 0.95)
    ]
    assert found == [("b", "a", 1, 1, 0.0), ("c", "a", 2, 0, 0.4), ("c", "b", 2, 0, 0.4)]
    assert compare_all({"a": flags["a"]}, 0.95) == []


RATIO = 2**-0.5
LIMIT = (0.0, -RATIO / (1 - RATIO), 1 / (1 - RATIO))


def nested(rng, trials, *rates):
    """Return flags of which each has a part of those before."""
    kept, found = np.ones(trials, dtype=bool), []
    for rate in rates:
        kept = kept & (rng.random(trials) < rate)
        found.append(SafeFlags.of(kept))
    return found


@pytest.mark.parametrize("rates", [(0.7, 0.95), (0.5, 0.5), (0.99, 0.98)])
def test_sums_of_rates_have_the_intervals_of_a_rate_and_of_a_difference(rates):
    first, second = nested(np.random.default_rng(0), 300, *rates)
    value, low, high = combined_rates([first, second], (1.0, -1.0), 0.9)
    wanted = paired_difference_interval(*pair_counts(first, second), 0.9)
    assert (low, high) == near(*wanted)
    assert low <= value <= high
    safe = int(first.array.sum())
    assert combined_rates([first], (1.0,), 0.95) == near(safe / 300, *rate_interval(safe, 300))


@pytest.mark.parametrize("trials", [200, 2000])
@pytest.mark.parametrize("rates", [(0.45, 0.95, 0.965), (0.98, 0.995, 0.997)])
def test_extrapolated_rates_are_covered(trials, rates):
    rng, true = np.random.default_rng(1), float(np.cumprod(rates) @ LIMIT)
    ends = [combined_rates(nested(rng, trials, *rates), LIMIT, 0.95)[1:] for _ in range(200)]
    # 180 of 200 or less has a probability of .003 if 95 % are held.
    assert sum(low <= true <= high for low, high in ends) > 180


def test_intervals_over_identifications():
    for safe in (0, 7, 10):
        assert interval_over([safe / 10] * 5, 10, 0.9) == near(*rate_interval(safe, 10, 0.9))
    # 0.29 * 100 is a little less than 29 in floating point, which must not make it 28.
    assert interval_over([0.29] * 2, 100, 0.9) == near(*rate_interval(29, 100, 0.9))
    # Two say little: Student's quantile with one degree of freedom is 12.7.
    assert interval_over([0.5, 0.6], 10**6, 0.95) == (0.0, 1.0)
    half = student.ppf(0.975, 1) * 0.05
    assert repeated_interval([0.5, 0.6], (0.55, 0.55), 0.95, (-9.0, 9.0)) == near(
        0.55 - half, 0.55 + half
    )


@pytest.mark.parametrize(
    ("repeats", "between", "episodes"), [(2, 0.05, 200), (5, 0.0, 200), (20, 0.1, 400)]
)
def test_intervals_cover_the_mean_over_identifications(repeats, between, episodes):
    """Episode i is safe with identification r where its own noise allows: all identifications see
    the same episodes."""
    rng = np.random.default_rng(0)
    trials, hits = 400, 0
    for _ in range(trials):
        rates = np.clip(0.8 + between * rng.standard_normal(repeats), 0.0, 1.0)
        luck = rng.random(episodes)
        low, high = interval_over([(luck < rate).mean() for rate in rates], episodes, 0.9)
        hits += low <= 0.8 <= high
    # Three standard deviations below the confidence, of which the interval is on the wide side.
    assert hits / trials >= 0.9 - 3 * math.sqrt(0.09 / trials)


@pytest.mark.parametrize("estimates", [(1.0, 2.0), (3e-7, 4e-9), (1e-8, 2e-8, 4e-8)])
def test_log_normal_interval_is_coxs(estimates):
    # log E = mu + sigma^2/2 is estimated by the mean of the logs, with the variance s^2/R, and half
    # of s^2, with the variance (2 s^4/(R - 1))/4 = s^4/(2 (R - 1)).
    n, square = len(estimates), np.log(estimates).var(ddof=1)
    half = student.ppf(0.975, n - 1) * math.sqrt(square / n + square**2 / (2 * (n - 1)))
    mean = sum(estimates) / n
    assert log_normal_interval(estimates) == pytest.approx(
        (mean * math.exp(-half), mean * math.exp(half)), rel=1e-12
    )
    assert log_normal_interval([3.0, 3.0]) == (3.0, 3.0)


@pytest.mark.parametrize(
    ("call", "fragment"),
    [
        *((lambda c=c: rate_interval(3, 7, c), "confidence") for c in (0.0, 1.0, 95, math.nan)),
        *((lambda c=c: rate_interval(3, 7, c), "confidence") for c in (-0.5, "0.9", None)),
        (lambda: wilson_interval(5, 3), "successes"),
        (lambda: rate_interval(-1, 3), "successes"),
        (lambda: rate_interval(0, 0), "successes"),
        (lambda: paired_difference_interval(3, -1, 2, 4), "pairs"),
        (lambda: paired_difference_interval(0, 0, 0, 0), "0 trials"),
        (lambda: repeated_interval([0.5], (0.4, 0.6), 0.95, (0.0, 1.0)), "2"),
        (lambda: repeated_interval([0.5, 0.6], (0.4, 0.6), 1.0, (0.0, 1.0)), "confidence"),
        (lambda: log_normal_interval([1.0]), "two"),
        (lambda: log_normal_interval([1.0, 0.0]), "above 0"),
    ],
)
def test_what_has_no_interval_is_refused(call, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        call()


@pytest.mark.parametrize(
    ("safe", "episodes", "text"),
    [
        (1000, 1000, "100.0 % [99.6, 100.0]"),
        (0, 1000, "0.0 % [0.0, 0.4]"),
        (988, 1000, "98.8 % [97.9, 99.3]"),
        # By Wilson's formula 99.44 and 99.982.
        (999, 1000, "99.90 % [99.44, 99.98]"),
        (9, 100_000, "0.009 % [0.005, 0.017]"),
        (99_991, 100_000, "99.991 % [99.983, 99.995]"),
    ],
)
def test_what_is_not_certain_does_not_read_so(safe, episodes, text):
    assert percent_in(safe / episodes, *rate_interval(safe, episodes)) == text
    assert percent_in(1.0, 1.0 - 1e-16, 1.0) == "100.0 % [100.0, 100.0]"
    shares = {None: "-", 0.0: "0.0 %", 0.00004: "0.004 %", 0.99996: "99.996 %", 1.0: "100.0 %"}
    assert {share: percent(share) for share in shares} == shares


@pytest.mark.parametrize(
    ("difference", "text"),
    [
        ((0.158, 0.136, 0.182), "+15.8 points [13.6, 18.2]"),
        ((0.004, -0.001, 0.011), "+0.4 points [-0.1, 1.1]"),
        # What is significant is not shown as 0, and neither is the end of its interval.
        ((0.0002, 0.0001, 0.0003), "+0.02 points [0.01, 0.03]"),
        ((-0.0002, -0.0004, -0.000004), "-0.0200 points [-0.0400, -0.0004]"),
        # What is not may be, but its interval has an end.
        ((0.00001, -0.0001, 0.01), "+0.0 points [0.0, 1.0]"),
        ((0.0, -0.0002, 0.0002), "+0.00 points [-0.02, 0.02]"),
        ((1e-17, -1e-17, 1e-17), "+0.0 points [0.0, 0.0]"),
    ],
)
def test_a_difference_is_told_from_0_where_its_interval_is(difference, text):
    assert points_in(*difference) == text
    assert points_in(*difference, unit="") == text.replace(" points", "")
