"""The safety rate over time."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.agents.evaluation.statistics import CurveCounts, curve_instants, rate_interval


@pytest.mark.parametrize("steps", [1, 2, 199, 200, 201, 400, 401, 1000, 100_001])
def test_instants_of_a_curve_are_even_and_have_both_ends(steps):
    instants = curve_instants(steps)
    assert (instants[0], instants[-1]) == (0, steps)
    assert min(steps + 1, 101) <= len(instants) <= 201
    gaps = np.diff(instants)
    assert len(set(gaps[:-1].tolist())) <= 1
    assert 0 < gaps[-1] <= gaps[0]


def test_curve_counts_the_episodes_that_are_safe_so_far():
    steps, dt = 730, 0.02
    first = np.random.default_rng(3).integers(0, 1000, 300)
    first[:3] = (0, steps, steps + 1)
    counts = CurveCounts(steps)
    for part in np.split(np.where(first > steps, -1, first), [1, 1, 200]):
        counts.add(part)
    row = counts.curve(dt, 0.9)
    instants = curve_instants(steps).tolist()
    assert row.time == [k * dt for k in instants]
    assert row.safe == [sum(f > k for f in first.tolist()) for k in instants]
    assert row.safe[0] == 300 - (first == 0).sum() < 300
    assert row.rate == [safe / 300 for safe in row.safe]
    assert list(zip(row.ci_low, row.ci_high, strict=True)) == [
        rate_interval(safe, 300, 0.9) for safe in row.safe
    ]
