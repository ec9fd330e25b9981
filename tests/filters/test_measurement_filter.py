"""A safety filter in a control loop that has measurements only."""

from dataclasses import replace

import numpy as np
import pytest
import sympy as sp
from scipy import stats

from safe_envs import ControlAffineSDE, SafeVectorEnv
from safe_envs.errors import ConfigurationError, InvalidInputError, SystemDefinitionError
from safe_envs.filters.estimation import ExtendedKalmanFilter, InitialBelief
from safe_envs.problem.measurement import Channel, Measurement
from safe_envs.problem.signals import TIME
from safe_envs.registry import make_problem
from safe_envs.wrappers import SafetyFilter, SafetyFilterVectorWrapper


def measured(env="StochasticDubins-v0", text="scbf", **options):
    problem = make_problem(env, measurement=["default:dropout=0.2"], **options)
    return problem, SafetyFilter.for_problem(problem, text, estimator="ekf")


@pytest.mark.parametrize("text", ["scbf", "scbf:belief=0.05"])
@pytest.mark.parametrize("batch", [False, True])
def test_a_loop_decides_as_the_wrapper_of_an_env_does(text, batch):
    problem, safety_filter = measured("Pendulum-v0", text)
    env = SafetyFilterVectorWrapper(SafeVectorEnv(problem, 4), text, estimator="ekf")
    env.reset(seed=1)
    inner, rows = env.unwrapped, slice(None) if batch else 0
    proposed = np.full((4, 1), 2.0)
    for _ in range(25):
        y = np.where(
            np.stack(inner.measured.received, -1), np.stack(inner.measured.values, -1), np.nan
        )
        decision = safety_filter.filter_measurement(y[rows], proposed[rows])
        *_, info = env.step(proposed / problem.input_bounds[0][1])
        np.testing.assert_allclose(decision.action, info["safe_action"][rows], atol=1e-6)
        assert np.all(decision.feasible == info["feasible"][rows])
    session = safety_filter.measured
    assert session.mean.shape == ((4, 2) if batch else (2,))
    assert session.covariance.shape == ((4, 2, 2) if batch else (2, 2))
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


def pendulum(estimator):
    problem = make_problem("Pendulum-v0", measurement="default")
    if not isinstance(estimator, str):
        estimator = estimator(problem)
    return SafetyFilter(problem.model, problem.barriers, "scbf", (-5, 5), estimator=estimator)


def of_other_states(_):
    other = make_problem("Scalar-v0", measurement="default")
    initial = InitialBelief.of([0.0], [1.0])
    return ExtendedKalmanFilter(other.model, other.measurement, other.dt, initial=initial)


@pytest.mark.parametrize(
    ("call", "fragment"),
    [
        (
            lambda: pendulum(lambda _: None).filter_measurement([0.0, 0.0], [0.0]),
            "has no estimator",
        ),
        (lambda: pendulum(of_other_states), "other states"),
        (
            lambda: pendulum(lambda p: ExtendedKalmanFilter(p.model, p.measurement, p.dt)),
            "initial=",
        ),
        (lambda: pendulum("ekf"), "Estimator"),
        (lambda: measured()[1].measured.mean, "nothing was measured"),
    ],
)
def test_what_cannot_be_made_or_asked_is_refused(call, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        call()


X, V, U, LEAD, LEAD_SPEED, GUST = sp.symbols("x v u lead lead_speed belief_gust", real=True)
MASS = sp.Symbol("mass", positive=True)


def follower(**changed):
    """Return a car of known mass behind a lead that is measured at run time, and its estimator."""
    given = {
        "rate": [V, U / MASS],
        "diffusion": [0, 0.1],
        "signals": {LEAD: LEAD_SPEED, LEAD_SPEED: GUST, GUST: 0},
        "seen": X,
        **changed,
    }
    seen = Measurement((Channel("seen", given.pop("seen"), 0.05),))
    car = ControlAffineSDE.from_rate((X, V), (U,), parameters={MASS: 2.0}, **given)
    initial = InitialBelief.of([0.1, 0.4], [0.02, 0.03])
    return car, ExtendedKalmanFilter(car, seen, 0.05, initial=initial)


@pytest.mark.parametrize("batch", [False, True])
@pytest.mark.parametrize("condition", ["hocbf:alpha=1,2", "szcbf:alpha=2,2"])
def test_what_moves_is_part_of_barriers_at_an_estimate(condition, batch):
    car, estimator = follower()
    h = (LEAD - X) ** 2 - 1 - TIME / 10
    measured, exact = (
        SafetyFilter(car, h, condition, input_bounds=(-90, 90), estimator=e)
        for e in (estimator, None)
    )
    for k in range(4):
        given = {"parameters": {"lead": 2.0 + k, "lead_speed": -1.0, "belief_gust": 0.3}, "t": k}
        y, u = ([[0.1 * k]] * 2, [[60.0]] * 2) if batch else ([0.1 * k], [60.0])
        found = measured.filter_measurement(y, u, **given)
        right = exact.filter(measured.measured.mean, u, **given)
        assert np.all(found.cause == 0)
        for name in ("action", "barrier", "feasible"):
            np.testing.assert_array_equal(getattr(found, name), getattr(right, name))


def test_the_belief_of_a_moving_barrier_is_the_one_by_hand():
    # h_B = lead - x^ - z sqrt(P_11 + ..), whose rate is that of the lead, x^ and the root.
    car, estimator = follower(rate=[U, -V], diffusion=[0.2, 0])
    given = {"input_bounds": (-90, 90), "dt": 0.05, "instants": 100, "estimator": estimator}
    measured = SafetyFilter(car, LEAD - X, "cbf:alpha=3:belief=0.1", **given)
    runtime = {"lead": 2.0, "lead_speed": -1.0, "belief_gust": 5.0}
    found = measured.filter_measurement([0.2], [60.0], parameters=runtime)
    session, z = measured.measured, stats.norm.isf(0.1 / 100)
    q = session.covariance[0, 0] + 0.05 / 4 * 0.2**2
    growth = session.tracker.believed([60.0])[3]
    h = 2.0 - session.mean[0] - z * np.sqrt(q)
    assert found.barrier[0] == pytest.approx(h, rel=1e-9)
    assert found.action[0] == pytest.approx(-1.0 - z * growth / (2 * np.sqrt(q)) + 3 * h, rel=1e-9)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"rate": [V, U + LEAD]}, "the drift depends on the signal lead"),
        ({"rate": [V, U + TIME]}, "the drift depends on the time"),
        ({"rate": [V, U * (2 + sp.sin(LEAD))]}, "the input matrix depends on the signal lead"),
        ({"diffusion": [0, LEAD]}, "the diffusion depends on the signal lead"),
        ({"seen": LEAD - X}, "the measurement seen depends on the signal lead"),
        ({"seen": TIME + X}, "the measurement seen depends on the time"),
    ],
)
def test_no_estimator_predicts_what_it_is_not_given(changed, words):
    with pytest.raises(SystemDefinitionError, match=words):
        follower(**changed)


def test_parameters_of_the_prediction_are_not_adjustable():
    car, estimator = follower()
    given = {"input_bounds": (-9, 9), "estimator": estimator, "adjustable": ("mass",)}
    with pytest.raises(ConfigurationError, match="mass"):
        SafetyFilter(car, LEAD - X, "hocbf:alpha=1,2", **given)
    weighed = replace(car, parameters={}, signals={**car.signals, MASS: 0})
    with pytest.raises(ConfigurationError, match="mass"):
        SafetyFilter(
            weighed, LEAD - X, "hocbf:alpha=1,2", input_bounds=(-9, 9), estimator=estimator
        )
    car, estimator = follower(rate=[V, U])
    found = SafetyFilter(
        car, LEAD - X - MASS, "hocbf:alpha=1,2", **{**given, "estimator": estimator}
    )
    runtime = {"lead": 2.0, "lead_speed": -1.0, "belief_gust": 0.0, "mass": 0.5}
    decision = found.filter_measurement([0.2], [0.0], parameters=runtime)
    assert decision.barrier[0] == pytest.approx(2.0 - 0.5 - found.measured.mean[0])
