"""Beliefs in episodes: delays, losses, restarts, snapshots."""

import numpy as np
import pytest
from scipy import stats

from safe_envs.envs.sensor import Sample
from safe_envs.errors import ConfigurationError
from safe_envs.filters.estimation import BeliefTracker, ExtendedKalmanFilter, make_estimator
from safe_envs.filters.estimation.consistency import consistency_of, nees
from safe_envs.filters.estimation.estimator import packed, unpacked
from safe_envs.registry import make_problem


def tracked(delay: int = 0, num_envs: int | None = None, **options):
    problem = make_problem("Pendulum-v0", measurement=["default", f"delay={delay}"], **options)
    return BeliefTracker(make_estimator("ekf", problem), num_envs)


def samples(count: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    return [Sample(rng.normal(0.0, 0.1, 2).tolist(), [True, True]) for _ in range(count)]


def test_late_samples_are_those_of_earlier_states():
    on_time, late = tracked(), tracked(2)
    rng = np.random.default_rng(1)
    inputs, found = rng.uniform(-1, 1, (6, 1)), samples(7)
    nothing = Sample([0.0, 0.0], [False, False])
    on_time.begin(found[0])
    late.begin(nothing)
    for k in range(6):
        if k < 4:
            on_time.advance(inputs[k].tolist(), found[k + 1])
        late.advance(inputs[k].tolist(), found[k - 1] if k >= 1 else nothing)
    # What the late one believes now is what the other one believed, predicted over two periods.
    estimator = on_time.estimator
    belief = on_time.mean, on_time.covariance
    for k in (4, 5):
        belief = estimator.predict("floats", *belief, inputs[k].tolist())
    np.testing.assert_allclose(late.mean, belief[0], rtol=1e-12)
    np.testing.assert_allclose(late.covariance, belief[1], rtol=1e-12)
    assert late.lost == on_time.lost == 0


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_a_batch_is_many_trackers_whenever_their_episodes_begin(delay):
    many, ones = tracked(delay, 3), [tracked(delay) for _ in range(3)]
    rng = np.random.default_rng(2)
    first = rng.normal(0.0, 0.1, (2, 3))
    has = np.full((2, 3), delay == 0)
    many.begin(Sample(list(first), list(has)))
    for i, one in enumerate(ones):
        one.begin(Sample(first[:, i].tolist(), has[:, i].tolist()))
    age = np.zeros(3, dtype=int)
    for k in range(8):
        u, y = rng.uniform(-1, 1, (1, 3)), rng.normal(0.0, 0.1, (2, 3))
        age += 1
        arrives = np.tile(age >= delay, (2, 1)) & (rng.random((2, 3)) < 0.8)
        many.advance(list(u), Sample(list(y), list(arrives)))
        for i, one in enumerate(ones):
            one.advance(u[:, i].tolist(), Sample(y[:, i].tolist(), arrives[:, i].tolist()))
        if k in (2, 5):
            begun = np.array([k == 2, True, False])
            has = np.tile(begun, (2, 1)) & (delay == 0)
            many.begin(Sample(list(y), list(has)), begun)
            for i in np.flatnonzero(begun):
                ones[i].begin(Sample(y[:, i].tolist(), has[:, i].tolist()))
            age[begun] = 0
        for i, one in enumerate(ones):
            np.testing.assert_allclose([c[i] for c in many.mean], one.mean, atol=1e-12)
            np.testing.assert_allclose([c[i] for c in many.covariance], one.covariance, atol=1e-12)
            assert many.lost[i] == one.lost
            believed = [float(v) for v in one.believed([0.1])]
            several = [v[i] for v in many.believed([np.full(3, 0.1)])]
            np.testing.assert_allclose(several, believed, atol=1e-8)


def test_what_shrinks_of_a_belief_does_not_count():
    tracker = tracked(start="uniform")
    n, dt = tracker.estimator.n, tracker.estimator.dt
    first, *rest = samples(60)
    tracker.begin(first)
    shrinks = []
    for each in rest:
        after, _ = tracker.ahead([0.0])
        change = unpacked([(a - p) / dt for a, p in zip(after, tracker.covariance, strict=True)], n)
        upper = n * (n + 1) // 2
        growth = unpacked([float(v) for v in tracker.believed([0.0])[upper : 2 * upper]], n)
        values, vectors = np.linalg.eigh(change)
        expected = (vectors * np.maximum(values, 0.0)) @ vectors.T
        np.testing.assert_allclose(growth, expected, atol=1e-9 * abs(change).max())
        shrinks.append(values[0] < 0.0)
        tracker.advance([0.0], each)
    assert any(shrinks)


def test_values_that_are_no_numbers_are_lost():
    one, other = tracked(), tracked()
    one.begin(Sample([0.1, np.nan], [True, True]))
    other.begin(Sample([0.1, 7.0], [True, False]))
    assert one.mean == other.mean
    assert one.lost == other.lost == 1
    assert list(one.received) == [True, False]


def test_the_belief_ahead_is_that_of_the_next_sample():
    for delay in (0, 2):
        tracker = tracked(delay)
        found = samples(8)
        tracker.begin(found[0] if not delay else Sample([0.0, 0.0], [False, False]))
        for k in range(6):
            before = tracker.estimator.predict("floats", tracker.mean, tracker.covariance, [0.2])[1]
            after, gained = tracker.ahead([0.2])
            arrives = [k + 1 >= delay] * 2
            tracker.advance([0.2], Sample(found[k + 1].values, arrives))
            if k >= delay:
                # Linear in the noise, but the pendulum's slope is taken at the estimate.
                np.testing.assert_allclose(after, tracker.covariance, rtol=0.02, atol=1e-9)
            np.testing.assert_allclose(np.array(before) - after, gained, atol=1e-15)


def test_an_estimator_without_a_beginning_is_refused():
    problem = make_problem("Pendulum-v0", measurement="default")
    with pytest.raises(ConfigurationError, match="initial="):
        BeliefTracker(ExtendedKalmanFilter(problem.model, problem.measurement, problem.dt))


def test_normalized_errors_are_chi_square():
    estimator = make_estimator("ekf", make_problem("StochasticDubins-v0", measurement="default"))
    rng = np.random.default_rng(0)
    root = np.array([[0.1, 0.0, 0.0], [0.05, 0.2, 0.0], [0.01, 0.0, 0.3]])
    p = root @ root.T
    x = rng.normal(size=(20_000, 3)) @ root.T
    # A whole turn is no error.
    turned = x + 2 * np.pi * rng.integers(-1, 2, (20_000, 1)) * [0, 0, 1]
    values, freedom = nees(estimator, turned, np.zeros_like(x), np.tile(p, (20_000, 1, 1)))
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], 3 * 20_000) / 20_000
    assert low < values.mean() < high
    assert (freedom == 3).all()
    expected = np.einsum("bi,ij,bj->b", x, np.linalg.inv(p), x)
    np.testing.assert_allclose(values, expected, rtol=1e-9)


def test_directions_without_uncertainty_do_not_count():
    estimator = make_estimator("ekf", make_problem("Pendulum-v0", measurement="default"))
    p = unpacked(packed([[0.04, 0.0], [0.0, 0.0]]), 2)[None]
    values, freedom = nees(estimator, np.array([[0.2, 1.0]]), np.array([[0.0, 1.0]]), p)
    assert values.tolist() == pytest.approx([1.0])
    assert freedom.tolist() == [1]


def test_the_interval_of_a_mean_holds_it_as_often_as_it_says():
    rng = np.random.default_rng(0)
    instants, hits = np.full(200, 10.0), 0
    for _ in range(400):
        # Strongly correlated within an episode.
        sums = rng.chisquare(2, 200) * 10.0
        found = consistency_of(sums, 2.0 * instants, instants, 0.9)
        hits += found.consistent
    assert 0.85 < hits / 400 < 0.95
    assert consistency_of(np.array([1.0]), np.array([1.0]), np.array([1.0]), 0.9) is None
