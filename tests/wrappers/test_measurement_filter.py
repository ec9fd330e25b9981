"""A safety filter in a control loop that has measurements only."""

import numpy as np
import pytest

from safe_envs import SafeVectorEnv
from safe_envs.errors import ConfigurationError, InvalidInputError
from safe_envs.registry import make_problem
from safe_envs.wrappers import SafetyFilter, SafetyFilterVectorWrapper
from safe_envs.wrappers.estimation import ExtendedKalmanFilter, InitialBelief


def measured(env="StochasticDubins-v0", text="scbf", **options):
    problem = make_problem(env, measurement=["default:dropout=0.2"], **options)
    return problem, SafetyFilter.for_problem(problem, text, estimator="ekf")


@pytest.mark.parametrize("text", ["scbf", "scbf:belief=0.05"])
@pytest.mark.parametrize("batch", [False, True])
def test_a_loop_decides_as_the_wrapper_of_an_env_does(text, batch):
    problem, safety_filter = measured(text=text)
    env = SafetyFilterVectorWrapper(SafeVectorEnv(problem, 4), text, estimator="ekf")
    env.reset(seed=1)
    inner, rows = env.unwrapped, slice(None) if batch else 0
    proposed = np.full((4, 1), 2.0)
    for _ in range(25):
        y = np.where(
            np.stack(inner.measured.received, -1), np.stack(inner.measured.values, -1), np.nan
        )
        decision = safety_filter.filter_measurement(y[rows], proposed[rows])
        *_, info = env.step(proposed / problem.box[0][1])
        np.testing.assert_allclose(decision.action, info["safe_action"][rows], atol=1e-6)
        assert np.all(decision.feasible == info["feasible"][rows])
    session = safety_filter.measured
    assert session.mean.shape == ((4, 3) if batch else (3,))
    assert session.covariance.shape == ((4, 3, 3) if batch else (3, 3))
    assert np.sum(session.lost) > 0


def test_what_was_sent_in_place_of_a_decision():
    _, one = measured()
    _, other = measured()
    y, u = np.array([1.0, 0.2, 0.3]), np.array([1.0])
    for each in (one, other):
        each.filter_measurement(y, u)
    one.measured.override([-3.0])
    one.filter_measurement(y, u)
    other.filter_measurement(y, u)
    assert not np.allclose(one.measured.mean, other.measured.mean)
    one.measured.reset()
    other.measured.reset()
    for each in (one, other):
        each.filter_measurement(y, u)
    np.testing.assert_array_equal(one.measured.mean, other.measured.mean)


def test_after_an_error_it_has_to_be_said_what_was_sent():
    _, safety_filter = measured()
    y, u = np.array([1.0, 0.2, 0.3]), np.array([1.0])
    safety_filter.filter_measurement(y, u)
    with pytest.raises(InvalidInputError):
        safety_filter.filter_measurement(y, np.array([np.nan]))
    with pytest.raises(ConfigurationError, match="override"):
        safety_filter.filter_measurement(y, u)
    safety_filter.measured.override([0.0])
    assert safety_filter.filter_measurement(y, u).feasible in (True, False)


def test_lost_values_are_predicted_over():
    _, safety_filter = measured()
    u, nothing = np.array([1.0]), np.full(3, np.nan)
    safety_filter.filter_measurement(np.array([1.0, 0.2, 0.3]), u)
    before = np.trace(safety_filter.measured.covariance)
    for _ in range(5):
        safety_filter.filter_measurement(nothing, u)
    assert np.trace(safety_filter.measured.covariance) > before
    assert safety_filter.measured.lost == 15


@pytest.mark.parametrize(
    ("y", "u", "words"),
    [
        ([1.0, 2.0], [0.0], "shape"),
        ([1.0, np.inf, 0.0], [0.0], "NaN"),
        ([1.0, 2.0, 3.0], [0.0, 1.0], "leading axes"),
        ("far", [0.0], "measurement"),
    ],
)
def test_what_does_not_fit_is_refused(y, u, words):
    _, safety_filter = measured()
    with pytest.raises(InvalidInputError, match=words):
        safety_filter.filter_measurement(y, np.array(u))


def test_errors_of_making_one():
    problem = make_problem("Pendulum-v0", measurement="default")
    other = make_problem("Scalar-v0", measurement="default")
    plain = SafetyFilter.for_problem(problem, "scbf")
    with pytest.raises(ConfigurationError, match="has no estimator"):
        plain.filter_measurement([0.0, 0.0], [0.0])
    given = {"initial": InitialBelief.of([0.0], [1.0])}
    wrong = ExtendedKalmanFilter(other.model, other.measurement, other.dt, **given)
    with pytest.raises(ConfigurationError, match="other states"):
        SafetyFilter(problem.model, problem.barriers, "scbf", bounds=(-5, 5), estimator=wrong)
    without = ExtendedKalmanFilter(problem.model, problem.measurement, problem.dt)
    with pytest.raises(ConfigurationError, match="initial="):
        SafetyFilter(problem.model, problem.barriers, "scbf", bounds=(-5, 5), estimator=without)
    with pytest.raises(ConfigurationError, match="give an Estimator"):
        SafetyFilter(problem.model, problem.barriers, "scbf", bounds=(-5, 5), estimator="ekf")
    ready = SafetyFilter.for_problem(problem, "scbf", estimator="ekf")
    with pytest.raises(ConfigurationError, match="nothing was measured"):
        _ = ready.measured.mean
