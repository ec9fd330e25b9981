"""Kalman filters against dense matrices, finite differences and simulated paths."""

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE
from safe_envs.dynamics.integrators import Integrator
from safe_envs.errors import ConfigurationError, SystemDefinitionError
from safe_envs.filters.estimation import (
    ExtendedKalmanFilter,
    InitialBelief,
    KalmanFilter,
    UnscentedKalmanFilter,
    make_estimator,
)
from safe_envs.filters.estimation.consistency import nees
from safe_envs.filters.estimation.estimator import cholesky, packed, positive_part, unpacked
from safe_envs.problem.measurement import Channel, Measurement
from safe_envs.registry import make_problem


def linear(seed: int, n: int = 3, k: int = 2, noise: float = 0.4, substeps: int = 2):
    """Return a random linear estimator with its dense matrices."""
    rng = np.random.default_rng(seed)
    states, inputs = sp.symbols(f"x:{n}", real=True), sp.symbols("u:1", real=True)
    a, b = rng.normal(size=(n, n)) * (rng.random((n, n)) < 0.7), rng.normal(size=(n, 1))
    sigma, c = noise * rng.normal(size=(n, 2)), rng.normal(size=(k, n))
    system = ControlAffineSDE(
        states, inputs, sp.Matrix(a) * sp.Matrix(states), sp.Matrix(b), sp.Matrix(sigma)
    )
    r = rng.uniform(0.1, 1.0, k)
    channels = tuple(
        Channel(f"y{i}", (sp.Matrix(c[i : i + 1]) * sp.Matrix(states))[0, 0], float(r[i]))
        for i in range(k)
    )
    estimator = KalmanFilter(system, Measurement(channels), 0.05, substeps)
    return estimator, a, b, sigma, c, r, rng


def dense_step(estimator, a, b, sigma, m, p, u):
    """Return the moments after a control period of the simulator."""
    h = estimator.dt / estimator.substeps
    f = np.eye(len(m)) + h * a
    for _ in range(estimator.substeps):
        m, p = f @ m + h * (b @ u), f @ p @ f.T + h * sigma @ sigma.T
    return m, p


def dense_update(c, r, m, p, y, has):
    """Return the batch update with the channels that were received."""
    c, r, y = c[has], r[has], y[has]
    s = c @ p @ c.T + np.diag(r**2)
    gain = p @ c.T @ np.linalg.inv(s)
    nu = y - c @ m
    return m + gain @ nu, (np.eye(len(m)) - gain @ c) @ p, nu @ np.linalg.solve(s, nu)


@pytest.mark.parametrize("seed", range(5))
def test_kalman_filter_is_the_dense_one(seed):
    estimator, a, b, sigma, c, r, rng = linear(seed)
    m, p = rng.normal(size=3), np.diag(rng.uniform(0.1, 1.0, 3))
    mean, covariance = m.tolist(), packed(p)
    for k in range(20):
        u, y = rng.normal(size=1), rng.normal(size=2)
        has = np.array([True, k % 3 > 0])
        m, p = dense_step(estimator, a, b, sigma, m, p, u)
        mean, covariance = estimator.predict("floats", mean, covariance, u.tolist())
        np.testing.assert_allclose(mean, m, rtol=1e-10)
        np.testing.assert_allclose(unpacked(covariance, 3), p, rtol=1e-9, atol=1e-12)
        found = estimator.update("floats", mean, covariance, y.tolist(), has.tolist())
        m, p, nis = dense_update(c, r, m, p, y, has)
        mean, covariance = found.mean, found.covariance
        np.testing.assert_allclose(mean, m, rtol=1e-9)
        np.testing.assert_allclose(unpacked(covariance, 3), p, rtol=1e-8, atol=1e-12)
        assert found.nis == pytest.approx(nis, rel=1e-9)
        assert found.innovation[1] == 0.0 or has[1]


@pytest.mark.parametrize("seed", range(3))
def test_without_noise_the_covariance_takes_the_derivative_of_runge_kutta(seed):
    estimator, a, _b, _, _, _, rng = linear(seed, noise=0.0)
    h = estimator.dt / estimator.substeps
    powers = [np.linalg.matrix_power(h * a, j) for j in range(5)]
    f = sum(p / f for p, f in zip(powers, (1, 1, 2, 6, 24), strict=True))
    f = np.linalg.matrix_power(f, estimator.substeps)
    p, m, u = np.diag(rng.uniform(0.1, 1.0, 3)), rng.normal(size=3), [0.7]
    mean, covariance = estimator.predict("floats", m.tolist(), packed(p), u)
    moved = Integrator(estimator.model, estimator.dt, estimator.substeps, "floats").step(m, u, [])
    np.testing.assert_allclose(mean, moved, rtol=1e-12)
    np.testing.assert_allclose(unpacked(covariance, 3), f @ p @ f.T, rtol=1e-10)


@pytest.mark.parametrize(
    "env", ["StochasticDubins-v0", "DubinsDisk-v0", "Pendulum-v0", "Quadrotor-v0"]
)
def test_covariances_take_the_derivative_of_the_simulated_step(env):
    problem = make_problem(env, measurement="default")
    estimator = make_estimator("ekf", problem)
    n, model = estimator.n, estimator.model
    x = problem.starts[problem.start].proposals(3)[-1]
    u = [0.3 * low + 0.7 * high for low, high in problem.input_bounds]
    step = Integrator(model, problem.dt, problem.substeps, "floats")
    nothing = [0.0] * step.channels
    size = 1e-6
    slopes = np.array(
        [
            (np.array(step.step(x + size * e, u, nothing)) - step.step(x - size * e, u, nothing))
            / (2 * size)
            for e in np.eye(n)
        ]
    ).T
    # From a covariance without process noise: what is added to it is the same for both.
    start, more = np.zeros((n, n)), np.diag(np.linspace(0.5, 1.5, n))
    found = [
        unpacked(estimator.predict("floats", x.tolist(), packed(p), u)[1], n) for p in (start, more)
    ]
    np.testing.assert_allclose(found[1] - found[0], slopes @ more @ slopes.T, atol=1e-7)


@pytest.mark.parametrize("kind", ["ekf", "ukf"])
@pytest.mark.parametrize("env", ["ACC-v0", "StochasticDubins-v0", "DubinsReach-v0", "Scalar-v0"])
def test_a_batch_is_many_single_states(env, kind):
    problem = make_problem(env, measurement="default")
    estimator = make_estimator(kind, problem)
    rng = np.random.default_rng(0)
    x = problem.starts[problem.start].proposals(6)
    n, k, m = estimator.n, len(estimator.measurement.channels), estimator.model.m
    p = packed(0.01 * np.eye(n) + 0.001)
    inputs = rng.uniform(-0.5, 0.5, (m, 6))
    many = estimator.predict("arrays", list(x.T), [np.full(6, c) for c in p], list(inputs))
    y = np.array(estimator.expected("arrays", many[0])) + rng.normal(size=(k, 6))
    has = rng.random((k, 6)) < 0.7
    found = estimator.update("arrays", *many, list(y), list(has))
    for i in range(6):
        one = estimator.predict("floats", x[i].tolist(), p, inputs[:, i].tolist())
        each = estimator.update("floats", *one, y[:, i].tolist(), has[:, i].tolist())
        for part, others in ((each.mean, found.mean), (each.covariance, found.covariance)):
            np.testing.assert_allclose(
                part, [np.ravel(c)[i % np.size(c)] for c in others], atol=1e-9
            )
        assert each.nis == pytest.approx(found.nis[i], rel=1e-6, abs=1e-9)


def test_unscented_filter_is_the_kalman_filter_of_a_linear_system():
    estimator, *_, rng = linear(7)
    other = UnscentedKalmanFilter(
        estimator.model, estimator.measurement, estimator.dt, estimator.substeps, alpha=0.7, beta=2
    )
    mean, covariance = rng.normal(size=3).tolist(), packed(np.diag([0.5, 1.0, 2.0]))
    one, two = (
        e.update("floats", *e.predict("floats", mean, covariance, [0.4]), [0.3, -0.2], [True, True])
        for e in (estimator, other)
    )
    np.testing.assert_allclose(one.mean, two.mean, rtol=1e-9)
    np.testing.assert_allclose(one.covariance, two.covariance, rtol=1e-8)
    assert one.nis == pytest.approx(two.nis, rel=1e-9)


def test_unscented_mean_of_a_square_is_exact():
    x, u = sp.symbols("x u", real=True)
    system = ControlAffineSDE.from_rate((x,), (u,), [x**2 + u], diffusion=[0.1])
    found = UnscentedKalmanFilter(system, Measurement((Channel("y", x, 1.0),)), 0.1)
    mean, _ = found.predict("floats", [0.5], [0.2], [0.0])
    assert mean[0] == pytest.approx(0.5 + 0.1 * (0.5**2 + 0.2), rel=1e-12)


def test_moments_are_those_of_simulated_paths():
    problem = make_problem("ACCGap-v0", measurement="default")
    estimator = make_estimator("ekf", problem)
    count, rng = 100_000, np.random.default_rng(1)
    step = Integrator(problem.plant, problem.dt, problem.substeps, "arrays")
    x = tuple(np.full(count, c) for c in (10.0, 15.0))
    mean, covariance = [10.0, 15.0], [0.0, 0.0, 0.0]
    for _ in range(10):
        x = step.step(x, (np.float64(500.0),), list(rng.normal(size=(step.channels, count))))
        mean, covariance = estimator.predict("floats", mean, covariance, [500.0])
    table = np.cov(np.stack(x))
    p = unpacked(covariance, 2)
    np.testing.assert_allclose(np.mean(x, axis=1), mean, atol=5 * np.sqrt(np.diag(p) / count).max())
    error = np.sqrt((np.outer(np.diag(p), np.diag(p)) + p**2) / count)
    assert (abs(table - p) < 5 * error).all()


def test_covariances_stay_positive_over_many_steps():
    problem = make_problem("DubinsDisk-v0", measurement=["default:noise=1e-7"])
    estimator = make_estimator("ekf:process_noise=1e-8", problem)
    mean, covariance = [0.1, 0.0, 0.2], packed(np.diag([1.0, 1.0, 1.0]))
    for _ in range(4_000):
        mean, covariance = estimator.predict("floats", mean, covariance, [0.3])
        y = estimator.expected("floats", mean)
        _, covariance, *_ = estimator.update("floats", mean, covariance, y, [True] * 3)
    scale = np.sqrt(np.diag(unpacked(covariance, 3)))
    assert np.linalg.eigvalsh(unpacked(covariance, 3) / np.outer(scale, scale))[0] > 0.0


def test_periodic_innovations_are_short():
    problem = make_problem("StochasticDubins-v0", measurement="default")
    estimator = make_estimator("ekf", problem)
    mean, covariance = [0.0, 0.0, 6.2], packed(0.01 * np.eye(3))
    found = estimator.update("floats", mean, covariance, [0.0, 0.0, -0.05], [True] * 3)
    assert found.innovation[2] == pytest.approx(2 * np.pi - 0.05 - 6.2)
    assert 6.2 < found.mean[2] < 6.3


def car(*sensors: Channel, k: float = 57.3):
    """Return a car that stands left of the origin, and its position with other channels."""
    x, y, heading, u, scale = sp.symbols("x y theta u k", real=True)
    rate = [sp.cos(heading), sp.sin(heading), u]
    system = ControlAffineSDE.from_rate((x, y, heading), (u,), rate, parameters={scale: k})
    return system, Measurement((Channel("x", x, 0.1), Channel("y", y, 0.1), *sensors))


X, Y, THETA, K = sp.symbols("x y theta k", real=True)
BEARING = sp.atan2(Y, X)


@pytest.mark.parametrize("kind", [ExtendedKalmanFilter, UnscentedKalmanFilter])
@pytest.mark.parametrize(
    ("channel", "size"),
    [
        (Channel("b", BEARING, 0.01), 1.0),
        (Channel("b", 180 / sp.pi * BEARING, 0.01 * 180 / np.pi), 180 / np.pi),
        (Channel("b", sp.Mod(BEARING, 2 * sp.pi), 0.01), 1.0),
        (Channel("b", K * BEARING, 0.573, period=2 * np.pi * 57.3), 57.3),
    ],
)
def test_bearings_jump_in_no_unit(kind, channel, size):
    # Measured just below the cut, expected just above: .06 rad apart. The answer is that of the
    # same scene with x and the bearing mirrored, where there is no cut.
    (left, mirrored), p = ([-5.0, 0.1, 0.0], [5.0, 0.1, 0.0]), packed(np.diag([0.04, 0.04, 0.01]))
    system, sensor = car(channel)
    y = [-5.0, 0.1, size * (-np.pi + 0.04)]
    found = kind(system, sensor, 0.1).update("floats", left, p, y, [True] * 3)
    assert found.innovation[2] == pytest.approx(size * (0.04 + np.arctan2(0.1, 5.0)), rel=1e-2)
    plain = kind(*car(Channel("b", BEARING, 0.01)), 0.1)
    right = plain.update("floats", mirrored, p, [5.0, 0.1, -0.04], [True] * 3)
    np.testing.assert_allclose(np.array(found.mean) * [-1, 1, 1], right.mean, atol=1e-9)
    assert found.nis == pytest.approx(right.nis, rel=1e-9)


@pytest.mark.parametrize(
    ("channel", "words"),
    [
        (Channel("b", BEARING, 0.01, period=0), "6.28319"),
        (Channel("b", X * BEARING, 0.01, period=6.0), "no one number"),
        (Channel("b", K * BEARING, 0.01, period=100.0), "360.027"),
    ],
)
def test_jumps_that_no_period_takes_away_are_refused(channel, words):
    with pytest.raises(ConfigurationError, match=words):
        UnscentedKalmanFilter(*car(channel), 0.1)


@pytest.mark.parametrize(
    ("channels", "turn"),
    [
        ([Channel("t", THETA, 0.1, period=6.0)], 6.0),
        ([Channel("t", 180 / sp.pi * THETA, 1.0, period=360)], 2 * np.pi),
        ([Channel("t", sp.atan2(sp.sin(2 * THETA), sp.cos(2 * THETA)), 1.0)], np.pi),
        ([Channel("b", 180 / sp.pi * (sp.atan2(2 - Y, X) - THETA), 1.0)], 2 * np.pi),
        ([Channel("t", THETA, 0.1, period=6.0), Channel("h", THETA / 2, 0.1, period=6.0)], 12.0),
        ([Channel("t", THETA, 0.1, period=6.0), Channel("full", THETA, 0.1)], 0.0),
    ],
)
def test_errors_of_a_state_count_modulo_what_is_measured_of_it(channels, turn):
    estimator = ExtendedKalmanFilter(*car(*channels), 0.1)
    assert estimator.periods == pytest.approx((0.0, 0.0, turn))
    mean, covariance = np.array([[0.1, 0.2, 0.3]]), np.eye(3)[None]
    error = np.array([[0.0, 0.0, 0.01 + turn]])
    assert nees(estimator, mean + error, mean, covariance)[0][0] == pytest.approx(1e-4)


def test_gained_is_what_a_sample_takes_away():
    estimator, *_, rng = linear(5)
    mean, covariance = rng.normal(size=3).tolist(), packed(np.diag([0.5, 1.0, 2.0]))
    after, gained = estimator.gained("floats", mean, covariance, [0.2])
    m, p = estimator.predict("floats", mean, covariance, [0.2])
    found = estimator.update("floats", m, p, [5.0, -3.0], [True, True]).covariance
    np.testing.assert_allclose(after, found, rtol=1e-12)
    np.testing.assert_allclose(np.array(p) - after, gained, rtol=1e-12)


@pytest.mark.parametrize(
    ("env", "measurement", "text", "words"),
    [
        ("StochasticDubins-v0", "default", "kf", "theta"),
        ("Pendulum-v0", "default", "ekff", "did you mean 'ekf'"),
        ("Pendulum-v0", "default", "ekf:alpha=1", "setting 'alpha'"),
        ("Pendulum-v0", "default", "ekf:process_noise=-1", "process_noise"),
        ("Pendulum-v0", "default", "ekf:process_noise=1,2,3", "2 states"),
        ("Pendulum-v0", "default", "ukf:alpha=0", "alpha"),
        ("Pendulum-v0", "default", "ukf:alpha=1,2", "alpha"),
        ("Pendulum-v0", "default", 3, "ekf or ukf"),
        ("Pendulum-v0", ["default:noise=0"], "ekf", "without noise"),
        ("Pendulum-v0", None, "ekf", "nothing to estimate"),
    ],
)
def test_what_cannot_be_is_refused(env, measurement, text, words):
    problem = make_problem(env, measurement=measurement)
    with pytest.raises(ConfigurationError, match=words):
        make_estimator(text, problem)


@pytest.mark.parametrize(
    ("env", "measurement", "names"),
    [
        ("StochasticDubins-v0", ["theta"], "x, y"),
        ("ACC-v0", ["own_speed"], "x_3"),
        ("Quadrotor-v0", ["z", "phi", "theta", "psi"], "x"),
    ],
)
def test_what_is_not_observable_is_named(env, measurement, names):
    problem = make_problem(env, measurement=measurement, noise=0.1)
    with pytest.raises(SystemDefinitionError, match=names):
        make_estimator("ekf", problem)


def test_exactly_known_states_need_no_sensor():
    # The lead of ACC has a constant speed, which the start tells.
    problem = make_problem("ACC-v0", measurement=["own_speed", "gap"])
    assert make_estimator("ekf", problem).certain == (1,)
    assert make_estimator("ekf:process_noise=0.1", problem).certain == ()


def test_initial_beliefs():
    for covariance, fragment in (([[1.0]], "fit"), ([[1.0, 2.0], [2.0, 1.0]], "semidefinite")):
        with pytest.raises(ConfigurationError, match=fragment):
            InitialBelief.of([0.0, 1.0], covariance)
    found = InitialBelief.of([0.0, 1.0], [0.5, 0.25])
    np.testing.assert_array_equal(unpacked(found.covariance, 2), np.diag([0.5, 0.25]))


def test_factors_of_packed_matrices():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(4, 3))
    p = root @ root.T  # singular
    rows = cholesky(packed(p), 4)
    lower = np.array([[float(e) for e in row] for row in rows])
    np.testing.assert_allclose(lower @ lower.T, p, atol=1e-7)
    q = packed(p - 0.5 * np.eye(4))
    values, vectors = np.linalg.eigh(p - 0.5 * np.eye(4))
    expected = vectors @ np.diag(np.maximum(values, 0.0)) @ vectors.T
    np.testing.assert_allclose(unpacked(positive_part(q, 4), 4), expected, atol=1e-12)
