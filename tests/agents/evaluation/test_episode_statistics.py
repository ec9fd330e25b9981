"""Statistics of episodes that come in batches, in memory that does not grow with their number."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest

from safe_envs.agents import make_problem
from safe_envs.agents.evaluation import episodes
from safe_envs.agents.evaluation.episodes import EpisodeStatistics, PlayedBatch, VisitedStates
from safe_envs.agents.evaluation.rows import EpisodeResults
from safe_envs.agents.evaluation.statistics import SlightViolations
from tests.agents.evaluation.made_up import made_up

PROBLEM = make_problem("Scalar-v0")
NOTHING = VisitedStates.nothing(PROBLEM)


def played(results):
    slight = SlightViolations(1, 2, 1e-12 * (1 + results.length[0]))
    return PlayedBatch(results, np.zeros((len(results.length), 1)), slight, NOTHING)


def statistics_of(results, portion):
    found = EpisodeStatistics(PROBLEM)
    for k in range(0, len(results.length), portion):
        found.add(played(results.part(slice(k, k + portion))))
    return found


@pytest.fixture
def few_quantiles(monkeypatch):
    monkeypatch.setattr(episodes, "_QUANTILES_OF", 100)


@pytest.mark.usefixtures("few_quantiles")
def test_statistics_are_those_of_the_episodes():
    results = made_up(333)
    found = statistics_of(results, 333)
    row, counted = found.summary(0.9), results.counted
    safe = results.first_violation < 0
    assert 0 < np.count_nonzero(counted == 0) < np.count_nonzero(~safe)
    assert (row.episodes, row.safe, row.violations) == (333, safe.sum(), (~safe).sum())
    assert (row.touching, row.below_rounding) == (1, 2)
    assert row.worst_below_rounding == 1e-12 * (1 + results.length[0])
    assert row.safety_rate == safe.mean() == row.curve.rate[-1]
    assert row.min_h_median == np.median(results.min_h[:100])
    assert row.min_h_p05 == np.quantile(results.min_h[:100], 0.05)
    assert row.intervention_rate == results.interventions.sum() / counted.sum()
    assert row.infeasible_rate == results.infeasible.sum() / counted.sum()
    assert row.effort_mean == pytest.approx(np.nanmean(results.effort))
    assert row.return_mean == pytest.approx(math.fsum(results.returns) / 333)
    assert found.steps == results.length.sum()
    np.testing.assert_array_equal(found.safe.array, safe)


@pytest.mark.usefixtures("few_quantiles")
@pytest.mark.parametrize("portion", [1, 64, 99, 101])
def test_statistics_are_the_same_to_the_bit_in_any_batches(portion):
    results = made_up(333)
    whole, parts = (statistics_of(results, p) for p in (333, portion))
    wanted, found = (vars(each.summary(0.95)) for each in (whole, parts))
    batches = -(-333 // portion)
    for count, name in enumerate(("touching", "below_rounding"), 1):
        assert (wanted.pop(name), found.pop(name)) == (count, batches * count)
    longest = max(results.length[::portion])
    assert found.pop("worst_below_rounding") == 1e-12 * (1 + longest)
    del wanted["worst_below_rounding"]
    assert found == wanted
    assert parts.safe.packed.tobytes() == whole.safe.packed.tobytes()
    assert parts.steps == whole.steps


def test_where_no_step_counts_there_are_no_rates():
    one = made_up(1)
    zero = np.zeros(1, dtype=np.int32)
    results = EpisodeResults(
        one.returns, one.min_h, zero, one.length, zero, zero, np.array([np.nan])
    )
    row = statistics_of(results, 1).summary(0.95)
    assert row.intervention_rate is row.infeasible_rate is row.effort_mean is None
    assert (row.safe, row.safety_rate) == (0, 0.0)


@pytest.mark.usefixtures("few_quantiles")
def test_memory_does_not_grow_with_episodes():
    size = 1000

    def peak(batches):
        tracemalloc.start()
        try:
            found = EpisodeStatistics(PROBLEM)
            for _ in range(batches):
                found.add(played(made_up(size)))
            assert found.summary(0.95).episodes == size * batches
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(1)
    few, many = peak(20), peak(200)
    # The results of an episode, of which one bit is kept, take 40 bytes.
    assert many - few < 0.5 * size * (200 - 20)
