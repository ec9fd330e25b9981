"""Intervals of sums of rates, with weights, of the same trials."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.agents.evaluation.statistics import (
    SafeFlags,
    combined_rates,
    pair_counts,
    paired_difference_interval,
    rate_interval,
)

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
def test_a_difference_has_newcombes_interval(rates):
    first, second = nested(np.random.default_rng(0), 300, *rates)
    value, low, high = combined_rates([first, second], (1.0, -1.0), 0.9)
    wanted = paired_difference_interval(*pair_counts(first, second), 0.9)
    assert (low, high) == pytest.approx(wanted, abs=1e-12)
    assert low <= value <= high


def test_a_single_rate_has_its_own_interval():
    (flags,) = nested(np.random.default_rng(0), 50, 0.8)
    safe = int(flags.array.sum())
    assert combined_rates([flags], (1.0,), 0.95)[1:] == pytest.approx(rate_interval(safe, 50))


@pytest.mark.parametrize("trials", [200, 2000])
@pytest.mark.parametrize("rates", [(0.45, 0.95, 0.965), (0.98, 0.995, 0.997)])
def test_extrapolated_rates_are_covered(trials, rates):
    rng, true = np.random.default_rng(1), float(np.cumprod(rates) @ LIMIT)
    ends = [combined_rates(nested(rng, trials, *rates), LIMIT, 0.95)[1:] for _ in range(200)]
    # 180 of 200 or less has a probability of .003 if 95 % are held.
    assert sum(low <= true <= high for low, high in ends) > 180
