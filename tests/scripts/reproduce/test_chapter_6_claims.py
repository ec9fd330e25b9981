"""Claims of chapter 6 on made-up data: each holds for some, and not for others."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm, t

from safe_envs.agents.evaluation.statistics import rate_interval
from safe_envs.scripts.reproduce.chapter_6 import (
    car_drift,
    car_rates,
    cubic_drift,
    cubic_rates,
    identifications,
    learned_controllers,
    learning_times,
    noise_posterior,
    worst_case,
)
from safe_envs.scripts.reproduce.chapter_6.learned_controllers import LearnedController
from safe_envs.scripts.reproduce.framework.artefact import Number
from safe_envs.scripts.reproduce.framework.paired import MeasuredFilter

DRAWS = norm.ppf((np.arange(10_000) + 0.5) / 10_000)
"""Of a standard normal posterior."""


def learned(*difference, rates=(0.8, 0.9)):
    return LearnedController(rates, 1000, Number("", *difference))


def test_one_more_of_many_is_in_its_interval_with_95_percent():
    values = np.random.default_rng(0).standard_normal((4000, 5))
    new = np.random.default_rng(1).standard_normal(4000)
    inside = [
        low <= one <= high
        for one, (low, high) in zip(new, map(identifications.one_more, values), strict=True)
    ]
    assert np.mean(inside) == pytest.approx(0.95, abs=0.012)


def test_a_positive_quantity_is_predicted_by_its_logarithm():
    found = identifications.predicted("a", np.exp([1.0, 2.0, 3.0]), 7.0, "s")
    half = t.ppf(0.975, 2) * math.sqrt(4 / 3)
    assert (found.ours, found.printed, found.unit) == (pytest.approx(math.exp(2.0)), 7.0, "s")
    assert (found.low, found.high) == (
        pytest.approx(math.exp(2.0 - half)),
        pytest.approx(math.exp(2.0 + half)),
    )


def test_an_interval_of_draws_holds_95_percent_of_them():
    found = noise_posterior.credible("sigma", DRAWS, "")
    assert (found.low, found.high) == (
        pytest.approx(-1.96, abs=1e-3),
        pytest.approx(1.96, abs=1e-3),
    )


@pytest.mark.parametrize(
    ("true", "holds"),
    [((0.0, 2.2), True), ((2.2, -2.2), True), ((0.0, 2.3), False), ((-2.3, 0.0), False)],
)
def test_posteriors_are_around_the_truth_together_in_95_percent(true, holds):
    # Each of the two with 97.5 %, that is 2.24 standard deviations.
    claim = noise_posterior.gathered([DRAWS, DRAWS], true)
    assert claim.holds is holds
    assert "97.5 %" in claim.evidence


def squares(*levels, spread=0.05):
    """Errors of five identifications around a level for each K, independent of each other."""
    noise = np.random.default_rng(3).standard_normal((len(levels), 5))
    return {
        k: level * np.exp(spread * each)
        for k, level, each in zip((10, 30, 100), levels, noise, strict=True)
    }


def test_an_error_falls_if_it_surely_does():
    assert cubic_drift.falls("f", squares(1.0, 0.3, 0.1)).holds
    assert not cubic_drift.falls("f", squares(1.0, 0.3, 0.3)).holds
    assert not cubic_drift.falls("f", squares(0.3, 1.0, 0.1)).holds
    assert not cubic_drift.falls("f", squares(1.0, 0.9, 0.8, spread=2.0)).holds


def test_a_printed_fall_is_possible_or_not():
    found = squares(1.0, 0.3, 0.1)
    assert cubic_drift.falls_as_printed("f", found, (2.0, 0.6, 0.2)).holds
    assert not cubic_drift.falls_as_printed("f", found, (1.0, 0.3, 0.05)).holds
    assert not cubic_drift.falls_as_printed("f", found, (1.0, 0.1, 0.1)).holds
    claim = cubic_drift.falls_as_printed("f_2", squares(5e-2, 8e-3, 6e-4), (5e-2, 8e-3, 6e-4))
    assert claim.holds
    assert "83-fold" in claim.sentence
    assert "from K = 30 to 100 13.3-fold in the thesis" in claim.evidence


@pytest.mark.parametrize(
    ("differences", "holds"),
    [
        ([(-4.9, -54.0, 44.0)], False),
        ([(-4.9, -11.0, 2.0)], True),
        ([(-4.9, -12.5, 2.0)], False),
        ([(9.0, 6.0, 12.5)], False),
        ([(0.0, -1.0, 1.0), (-20.0, -21.0, -19.0)], False),
        ([(-1.0, -1.0, -1.0), (-12.0, -12.0, -12.0), (-5.0, -5.0, -5.0)], True),
    ],
    ids=["wide", "near", "low", "high", "one is far", "print"],
)
def test_similar_is_decided_by_the_interval_in_printed_points(differences, holds):
    claim = learned_controllers.similar(
        {str(i): learned(*each) for i, each in enumerate(differences)}
    )
    assert claim.holds is holds
    assert claim.printed


def test_the_interval_of_a_rate_is_that_with_one_more_identification():
    low, high = rate_interval(700, 1000)
    same = learned(0.0, 0.0, 0.0, rates=(0.7, 0.7)).number("a", 65)
    assert (same.low, same.high, same.printed_trials) == (
        pytest.approx(100 * low),
        pytest.approx(100 * high),
        1000,
    )
    found = learned(0.0, 0.0, 0.0, rates=(0.69, 0.7, 0.71)).number("a")
    half = t.ppf(0.975, 2) * 0.01 * math.sqrt(4 / 3)
    assert found.low == pytest.approx(70 - 100 * math.hypot(0.7 - low, half))
    assert found.high == pytest.approx(70 + 100 * math.hypot(high - 0.7, half))
    assert learned(0.0, 0.0, 0.0, rates=(0.1, 1.0)).number("a").high == 100.0


def test_measured_rates_are_above_the_worst_case_or_not():
    def claim(*rates):
        each = [Number.rate(str(i), rate, 1000) for i, rate in enumerate(rates)]
        return worst_case.above_worst(
            1.0, {"here": (each, 35.0), "there": ([Number.rate("x", 910, 1000)], 50.0)}
        )

    assert claim(550, 450, 430).holds
    assert not claim(550, 450, 340).holds
    # 36 % are not surely more than 35 %.
    assert not claim(360).holds
    assert claim(550).printed


def test_the_worst_case_is_for_ever_or_not():
    def claim(safe):
        return worst_case.worst_for_ever(
            400.0,
            {
                "here": (Number.rate("a", safe, 250), 50.0),
                "there": (Number.rate("b", 200, 250), 35.0),
            },
        )

    assert claim(120).holds
    assert not claim(105).holds
    assert claim(105).printed
    assert "42.0 %" in claim(105).evidence


@pytest.mark.parametrize(
    ("second", "said"),
    [
        ((1000, 560, 300), "first at T = 0.50 s"),
        ((1000, 750, 700), "At none of 3 instants up to T = 1 s"),
    ],
)
def test_both_printed_rates_are_looked_for_at_one_horizon(second, said):
    def row(safe):
        curve = SimpleNamespace(time=[0.0, 0.5, 1.0], safe=list(safe))
        found: Any = SimpleNamespace(episodes=1000, curve=curve)
        return MeasuredFilter(found, [], [], 1000)

    text = worst_case.at_one_horizon(row((1000, 905, 850)), row(second), (91, 55))
    assert said in text
    assert ("75.0 % from the second one" in text) == said.startswith("At none")


def test_an_estimate_is_validated_by_what_its_posterior_leaves_open():
    assert car_drift.validated(Number("a", 0.9, 0.8, 1.1)).holds
    assert not car_drift.validated(Number("a", 1.2, 1.05, 1.35)).holds


def test_near_is_a_check_of_ours():
    assert car_drift.near("f", np.array([0.01, 0.011, 0.012])).holds
    far = car_drift.near("f", np.array([0.05, 0.08, 0.1]))
    assert not far.holds
    assert not far.printed


@pytest.mark.parametrize(
    ("ratio", "holds"), [(0.5, [False, False]), (5.0, [True, False]), (12.0, [True, True])]
)
def test_identifying_is_sooner_or_not_and_ten_times_is_ours(ratio, holds):
    claims = learning_times.sooner(ratio)
    assert [claim.holds for claim in claims] == holds
    assert [claim.printed for claim in claims] == [True, False]
    assert "1200 times in the thesis" in claims[0].evidence


def test_the_limit_of_similar_is_the_largest_printed_difference():
    pairs = [*zip(cubic_rates.PRINTED["SCBF"], cubic_rates.PRINTED["Bayesian SCBF"], strict=True)]
    pairs.append((car_rates.PRINTED["SCBF"], car_rates.PRINTED["Bayesian SCBF"]))
    assert max(abs(a - b) for a, b in pairs) == learned_controllers.SIMILAR
