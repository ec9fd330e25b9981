"""A scalar linear Gaussian system with a sensor, against exact survival probabilities."""

import numpy as np
import pytest
from scipy import stats

from safe_envs import SafeVectorEnv
from safe_envs.agents import evaluate
from safe_envs.wrappers import SafetyFilterVectorWrapper
from tests.oracles.linear_gaussian import (
    DT,
    LIMIT,
    PUSH,
    STEPS,
    A,
    S,
    problem,
    survival,
    survival_given,
)

COUNTS = [5_000, pytest.param(100_000, marks=pytest.mark.oracle)]


def proportion(hits: int, count: int, confidence: float = 0.999) -> tuple[float, float]:
    interval = stats.binomtest(hits, count).proportion_ci(confidence)
    return interval.low, interval.high


def survived(env, inputs: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return which episodes survive given inputs, and what was measured in them, (B, K)."""
    env.reset(seed=seed)
    safe, record = np.ones(env.num_envs, dtype=bool), []
    for each in inputs:
        *_, info = env.step(np.full((env.num_envs, 1), each / PUSH))
        safe &= info["barrier"][:, 0] > 0.0
        record.append(env.measured.values[0])
    return safe, np.array(record).T


def test_quadrature_has_the_closed_form_of_one_step():
    for start in (0.0, 0.8, 0.99):
        mean = start + DT * (A * start + 1.0)
        expected = stats.norm.cdf((LIMIT - mean) / (S * np.sqrt(DT)))
        assert survival(np.ones(1), start) == pytest.approx(expected, abs=1e-12)


def test_a_sensor_that_says_nothing_leaves_the_probability_of_survival():
    inputs = np.full(STEPS, 0.3)
    records = np.random.default_rng(0).normal(size=(3, STEPS))
    found = survival_given(inputs, records, noise=1e4)
    assert found == pytest.approx(np.full(3, survival(inputs)), rel=1e-5)


@pytest.mark.parametrize("count", COUNTS)
def test_survival_under_given_inputs_is_that_of_the_grid(count):
    inputs = np.where(np.arange(STEPS) < 20, 1.5, -0.5)
    safe, record = survived(SafeVectorEnv(problem(), count), inputs)
    exact = survival(inputs)
    low, high = proportion(int(safe.sum()), count)
    assert low <= exact <= high
    # Given its measurements, an episode survives with the probability that the grid filter tells:
    # these are calibrated, and their mean is the probability of survival.
    part = 2000
    given = survival_given(inputs, record[:part])
    error = np.sqrt((given * (1.0 - given)).sum())
    assert abs(given.sum() - safe[:part].sum()) < 3.5 * error
    assert abs(given.mean() - exact) < 3.5 * given.std() / np.sqrt(part)
    assert given.std() > 0.2  # they say more than the probability alone


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("condition", ["scbf", "szcbf"])
def test_a_belief_is_between_certainty_equivalence_and_the_best(condition, count):
    given = {"filters": [condition], "estimator": "kf", "bounds": False, "engine": "numpy"}
    found = evaluate(problem(), episodes=count, **given)
    state, equivalent, belief = found.rows
    best = survival(np.full(STEPS, -PUSH))  # below a limit, the lowest input is the safest
    assert equivalent.ci_high < belief.ci_low
    assert belief.ci_low <= best
    assert state.ci_low <= best
    # Certainty equivalence loses safety, by an interval that excludes 0.
    loss = next(
        c for c in found.comparisons if {c.first, c.second} == {condition, f"{condition}@state"}
    )
    assert max(loss.ci_low, -loss.ci_high) > 0.0 or loss.ci_high < 0.0
    # The Kalman filter is honest, and its bound is proved and kept.
    estimates = belief.estimation
    assert estimates.nees.consistent or abs(estimates.nees.mean - estimates.nees.expected) < 0.02
    assert estimates.nis.consistent or abs(estimates.nis.mean - 1.0) < 0.01
    assert (estimates.bound_word, estimates.bound_note) == ("proved", None)
    assert 1.0 - belief.ci_high <= estimates.unsafe_at_most


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("delta", [0.05, 0.5])
def test_errors_exceed_the_margin_as_rarely_as_promised(count, delta):
    env = SafetyFilterVectorWrapper(
        SafeVectorEnv(problem(), count), f"szcbf:belief={delta}", estimator="kf"
    )
    observation, info = env.reset(seed=3)
    missed = np.zeros(count, dtype=bool)
    for k in range(STEPS + 1):
        inside = info["belief_barrier"][:, 0] >= 0.0
        missed |= inside & (info["barrier"][:, 0] < 0.0)
        if k < STEPS:
            # A hostile policy, which sees the measurement: up where it looks safe.
            action = np.where(observation < 0.7, 1.0, -0.2)
            observation, *_, info = env.step(action)
    assert stats.binomtest(int(missed.sum()), count, delta, "greater").pvalue > 1e-3
    assert missed.any()


@pytest.mark.parametrize("count", COUNTS)
def test_normalized_errors_of_a_kalman_filter_are_in_their_interval(count):
    env = SafetyFilterVectorWrapper(SafeVectorEnv(problem(), count), "scbf", estimator="kf")
    env.reset(seed=5)
    for k in range(STEPS - 1):
        *_, info = env.step(np.full((count, 1), 0.5))
        if k % 12 == 0:
            low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], count) / count
            assert low < info["nees"].mean() < high
            assert low < info["nis"].mean() < high


@pytest.mark.parametrize("condition", ["scbf", "szcbf:belief=0.05"])
def test_without_noise_of_the_sensor_the_filter_is_that_of_the_true_state(condition):
    exact = SafetyFilterVectorWrapper(
        SafeVectorEnv(problem().unmeasured, 50), condition.partition(":")[0]
    )
    found = []
    for noise in (1e-2, 1e-4, 1e-6):
        env = SafetyFilterVectorWrapper(
            SafeVectorEnv(problem(noise), 50), condition, estimator="kf"
        )
        env.reset(seed=0)
        exact.reset(seed=0)
        worst = 0.0
        for _ in range(STEPS - 1):
            *_, info = env.step(np.full((50, 1), 1.0))
            *_, expected = exact.step(np.full((50, 1), 1.0))
            worst = max(
                worst, float(abs(info["state"][:, 0] - (1 - expected["barrier"][:, 0])).max())
            )
        found.append(worst)
    if condition == "scbf":
        assert found[2] < 1e-4
        assert found[0] > found[1] > found[2]
    else:  # What process noise adds to the belief in a period stays.
        assert found[2] == pytest.approx(found[1], rel=0.05)
