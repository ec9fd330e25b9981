"""Intervals over identifications and episodes at once."""

from __future__ import annotations

import math

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents.evaluation.identification import interval_over, pooled
from safe_envs.agents.evaluation.rows import EpisodeSummary
from safe_envs.agents.evaluation.statistics import Curve, rate_interval, repeated_interval


def row(safe, episodes, **changes):
    rates = [1.0, safe / episodes]
    row = {
        "episodes": episodes,
        "safe": safe,
        "violations": episodes - safe,
        "touching": 1,
        "safety_rate": safe / episodes,
        "ci_low": 0.0,
        "ci_high": 1.0,
        "curve": Curve([0.0, 1.0], [episodes, safe], rates, rates, rates),
    }
    means = (
        "min_h_median",
        "min_h_p05",
        "intervention_rate",
        "infeasible_rate",
        "effort_mean",
        "return_mean",
    )
    return EpisodeSummary(**{**row, **dict.fromkeys(means, safe / episodes), **changes})


def test_one_identification_is_left_as_it_is():
    single = row(3, 10)
    assert pooled([single], 0.95) == single


def test_several_are_summed_and_averaged():
    one = row(3, 10, effort_mean=None, below_rounding=2, worst_below_rounding=1e-12)
    found = pooled([one, row(5, 10, effort_mean=2.0)], 0.95)
    assert (found.below_rounding, found.worst_below_rounding) == (2, 1e-12)
    assert (found.episodes, found.safe, found.violations, found.touching) == (20, 8, 12, 2)
    assert found.safety_rate == found.return_mean == pytest.approx(0.4)
    assert found.effort_mean == 2.0
    assert found.curve.safe == [20, 8]
    assert found.curve.rate == [1.0, pytest.approx(0.4)]
    assert (found.ci_low, found.ci_high) == (found.curve.ci_low[1], found.curve.ci_high[1])
    assert pooled([row(3, 10, effort_mean=None)] * 2, 0.95).effort_mean is None


def test_equal_identifications_have_the_interval_of_their_episodes():
    for safe in (0, 7, 10):
        assert interval_over([safe / 10] * 5, 10, 0.9) == pytest.approx(
            rate_interval(safe, 10, 0.9)
        )
    # 0.29 * 100 is a little less than 29 in floating point, which must not make it 28.
    assert interval_over([0.29] * 2, 100, 0.9) == pytest.approx(rate_interval(29, 100, 0.9))


def test_two_differing_ones_say_little():
    # Student's quantile with one degree of freedom is 12.7.
    low, high = interval_over([0.5, 0.6], 10**6, 0.95)
    assert (low, high) == (0.0, 1.0)
    low, high = repeated_interval([0.5, 0.6], (0.55, 0.55), 0.95, (-9.0, 9.0))
    assert (low, high) == (
        pytest.approx(0.55 - 12.7062 * 0.05, abs=1e-4),
        pytest.approx(0.55 + 12.7062 * 0.05, abs=1e-4),
    )


def test_errors():
    with pytest.raises(ConfigurationError, match="at least 2"):
        repeated_interval([0.5], (0.4, 0.6), 0.95, (0.0, 1.0))
    with pytest.raises(ConfigurationError, match="confidence"):
        repeated_interval([0.5, 0.6], (0.4, 0.6), 1.0, (0.0, 1.0))


@pytest.mark.parametrize(
    ("repeats", "between", "episodes"),
    [(2, 0.05, 200), (5, 0.0, 200), (5, 0.05, 100), (20, 0.1, 400), (20, 0.02, 1000)],
)
def test_intervals_cover_the_mean_over_identifications(repeats, between, episodes):
    """Episode i is safe with identification r where its own noise allows: all identifications see
    the same episodes."""
    rng = np.random.default_rng(0)
    trials, hits = 600, 0
    for _ in range(trials):
        rates = np.clip(0.8 + between * rng.standard_normal(repeats), 0.0, 1.0)
        luck = rng.random(episodes)
        found = [(luck < rate).mean() for rate in rates]
        low, high = interval_over(found, episodes, 0.9)
        hits += low <= 0.8 <= high
    # Three standard deviations below the confidence, of which the interval is on the wide side.
    assert hits / trials >= 0.9 - 3 * math.sqrt(0.09 / trials)
