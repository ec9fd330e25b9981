"""Conditions at an estimate: belief barriers, bounded errors, and loops with measurements only."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp
from scipy import stats

from safe_envs import ControlAffineSDE, SafeEnv, SafeVectorEnv
from safe_envs.errors import ConfigurationError, InvalidInputError, SystemDefinitionError
from safe_envs.filters.conditions.estimates import (
    EstimateSettings,
    belief_barrier,
    belief_symbols,
    belief_system,
    constraint_at_estimate,
    largest_slope,
    standard_deviations,
)
from safe_envs.filters.estimation import ExtendedKalmanFilter, InitialBelief
from safe_envs.problem.measurement import Channel, Measurement
from safe_envs.problem.problem import Barrier
from safe_envs.problem.signals import TIME
from safe_envs.registry import make_problem
from safe_envs.wrappers import (
    CBF,
    SCBF,
    SafetyFilter,
    SafetyFilterVectorWrapper,
    parse_condition,
    spec_of,
)

x, y, u = sp.symbols("x y u", real=True)
LINE = ControlAffineSDE.from_rate((x,), (u,), [0.5 * x + u], diffusion=[0.3])
PLANE = ControlAffineSDE.from_rate((x, y), (u,), [y, -x + u], diffusion=[[0.1], [0.2]])


def test_the_constraint_of_a_half_space_is_the_one_by_hand():
    # h_B = 1 - x^ - z sqrt(P + dt/4 sigma^2), and A h_B = -(x^/2 + u) - z P'/(2 sqrt(..)).
    settings = EstimateSettings(dt=0.1, instants=11)
    found = constraint_at_estimate(SCBF(belief=0.05), LINE, Barrier(1 - x), settings, 1)
    (p,), (rate,), _ = belief_symbols(1)
    z = stats.norm.isf(0.05 / 11)
    values = {x: 0.3, p: 0.04, rate: 0.2}
    root = np.sqrt(0.04 + 0.1 / 4 * 0.3**2)
    assert float(found.coefficient[0].subs(values)) == pytest.approx(-1.0)
    assert float(found.offset.subs(values)) == pytest.approx(-0.15 - z * 0.2 / (2 * root), rel=1e-9)
    assert float(found.chain[0].subs(values)) == pytest.approx(0.7 - z * root, rel=1e-9)


def test_a_quadratic_has_the_variance_of_a_gaussian_state():
    h = 1 - x**2 - 2 * y**2 + x * y
    found = belief_barrier(PLANE, Barrier(h), 1.0, 0.0).expression
    cov = np.array([[0.3, 0.1], [0.1, 0.2]])
    mean = np.array([0.4, -0.7])
    symbols = belief_symbols(2)[0]
    values = dict(zip((x, y, *symbols), (*mean, 0.3, 0.1, 0.2), strict=True))
    samples = np.random.default_rng(0).multivariate_normal(mean, cov, 400_000)
    drawn = sp.lambdify((x, y), h)(*samples.T)
    deviation = float((h - found).subs(values))
    assert deviation == pytest.approx(drawn.std(), rel=0.01)


def test_the_chain_is_along_the_dynamics_of_the_estimate():
    model, (spread, rates, jump) = belief_system(PLANE), belief_symbols(2)
    barrier = belief_barrier(PLANE, Barrier(1 - x**2 - y**2), 2.0, 0.05)
    found = SCBF().constraint(model, barrier)
    symbols = (x, y, *spread, *rates, *jump)
    values = np.array([0.3, -0.2, 0.05, 0.01, 0.04, 0.02, -0.01, 0.03, 0.1, 0.02, 0.2])
    h = sp.lambdify(symbols, barrier.expression)
    action = 0.7
    # E h_B after a short step, by Gauss-Hermite quadrature over the jumps of the estimate.
    step, (nodes, weights) = 1e-4, np.polynomial.hermite_e.hermegauss(9)
    gain = np.array([[values[8], 0.0], [values[9], values[10]]])
    expected = 0.0
    for (a, wa), (b, wb) in itertools.product(zip(nodes, weights, strict=True), repeat=2):
        moved = values.copy()
        drift = np.array([values[1], -values[0] + action])
        moved[:2] += step * drift + np.sqrt(step) * gain @ [a, b]
        moved[2:5] += step * values[5:8]
        expected += wa * wb / weights.sum() ** 2 * h(*moved)
    rate = (expected - h(*values)) / step
    at = dict(zip(symbols, values, strict=True))
    constraint = float((found.coefficient[0] * action + found.offset).subs(at))
    assert constraint == pytest.approx(rate, rel=1e-3)


@pytest.mark.parametrize(
    ("env", "condition"),
    [
        ("Pendulum-v0", "scbf"),
        ("ACCGap-v0", "szcbf"),
        *[
            pytest.param(f"{env}-v0", condition, marks=pytest.mark.oracle)
            for env in ("StochasticDubins", "ACC")
            for condition in ("scbf", "szcbf")
        ],
    ],
)
def test_a_belief_without_uncertainty_is_the_true_state(env, condition):
    problem = make_problem(env, noise=0.0)
    plain = SafetyFilter.for_problem(problem, condition)
    known = SafetyFilter.for_problem(problem, f"{condition}:belief=0.1")
    assert known.pairs[0][1].belief == 0.1
    nothing = dict.fromkeys([s.name for s in known.qp.runtime], 0.0)
    for state in problem.starts[problem.start].proposals(5):
        proposed = np.array([0.9 * high for _, high in problem.input_bounds])
        one, two = plain.filter(state, proposed), known.filter(state, proposed, parameters=nothing)
        scale = max(high - low for low, high in problem.input_bounds)
        np.testing.assert_allclose(two.action, one.action, atol=1e-5 * scale)
        np.testing.assert_allclose(two.barrier, one.barrier, rtol=1e-5, atol=1e-6)


def test_more_uncertainty_is_more_caution():
    problem = make_problem("Scalar-v0")
    found = SafetyFilter.for_problem(problem, "szcbf:belief=0.1")
    beliefs = [{"belief_P_1_1": p, "belief_P_rate_1_1": 0.0} for p in (0.0, 0.001, 0.01, 0.02)]
    actions = [found.filter([0.2], [5.0], parameters=belief).action[0] for belief in beliefs]
    assert actions == sorted(actions, reverse=True)
    assert len(set(actions)) == 4


def test_the_margin_shares_its_probability():
    assert standard_deviations(0.05, 10) == pytest.approx(stats.norm.isf(0.005))
    for delta, instants in ((0.6, 1), (0.999, 1)):
        with pytest.raises(ConfigurationError, match="probability"):
            standard_deviations(delta, instants)


def test_bounded_errors_are_met_at_every_state_within_them():
    rng = np.random.default_rng(0)
    system = ControlAffineSDE.from_rate(
        (x, y), (u,), [y - x**3, -x * y + (1 + x**2) * u], diffusion=[[0.1], [0.2]]
    )
    eps, region = (0.05, 0.03), [(-1.5, 1.5), (-1.5, 1.5)]
    for h in (1 - x**2 - y**2, 1 - y - x * y / 2):
        plain = SafetyFilter(system, h, CBF(2.0), input_bounds=(-50, 50))
        known = SafetyFilter(
            system, h, CBF(2.0, measurement_error=eps), input_bounds=(-50, 50), region=region
        )
        met = 0
        for _ in range(60):
            seen, proposed = rng.uniform(-1, 1, 2), rng.uniform(-30, 30, 1)
            decision = known.filter(seen, proposed)
            if not decision.feasible:
                continue
            met += 1
            corners = [seen + np.multiply(eps, c) for c in itertools.product((-1, 1), repeat=2)]
            inside = [seen + np.multiply(eps, rng.uniform(-1, 1, 2)) for _ in range(20)]
            for state in (*corners, *inside):
                assert plain.filter(state, decision.action).margin[0] >= -1e-9
        assert met > 20


def test_one_input_loses_nothing_where_the_constraint_is_affine():
    # a u + b with b = -2 x and a = -1: the worst x is at a corner.
    system = ControlAffineSDE.from_rate((x,), (u,), [x + u])
    known = SafetyFilter(
        system, 1 - x, CBF(1.0, measurement_error=0.1), input_bounds=(-9, 9), region=[(-2, 2)]
    )
    decision = known.filter(np.array([0.5]), np.array([5.0]))
    # -(x + u) + (1 - x) >= 0 at x = .6
    assert decision.action[0] == pytest.approx(1 - 2 * 0.6, abs=1e-9)


def test_the_errors_of_all_states_add_up():
    # -2 u + x - 3 y + 1 >= 0, at the worst corner x = .1, y = .3.
    known = SafetyFilter(
        PLANE,
        1 - x - 2 * y,
        CBF(1.0, measurement_error=(0.1, 0.2)),
        input_bounds=(-9, 9),
        region=[(-1, 1), (-1, 1)],
    )
    decision = known.filter(np.array([0.2, 0.1]), np.array([5.0]))
    assert decision.action[0] == pytest.approx((0.1 - 3 * 0.3 + 1) / 2, abs=1e-9)


def test_slopes_are_bounded_from_above_and_closely():
    rng = np.random.default_rng(0)
    for expression in (sp.sin(3 * x) * y, x**3 - x * y**2, sp.exp(-x) * sp.cos(y), sp.Float(2.5)):
        bound = largest_slope(expression, (x, y), [(-1.0, 1.0), (-2.0, 1.0)])
        values = sp.lambdify((x, y), expression)(
            rng.uniform(-1, 1, 100_000), rng.uniform(-2, 1, 100_000)
        )
        largest = float(np.max(abs(np.asarray(values))))
        assert largest <= bound <= 1.05 * largest + 1e-12


def test_a_bounded_error_keeps_a_vehicle_that_certainty_equivalence_loses():
    problem = make_problem("DubinsDisk-v0", model={"v": 0.8}, dt=0.005, horizon=6.0, start="valid")
    eps = 0.03
    lowest = []
    for text in ("hocbf:alpha=2,4", f"hocbf:alpha=2,4:measurement_error={eps},{eps},0"):
        safety_filter, env = SafetyFilter.for_problem(problem, text), SafeEnv(problem)
        env.reset(seed=0)
        h = []
        for _ in range(problem.steps):
            # An adversary shows the vehicle nearer to the centre than it is.
            position = env.state[:2]
            away = position / max(np.linalg.norm(position), 1e-9)
            seen = env.state - np.append(eps * away / np.sqrt(2), 0.0)
            decision = safety_filter.filter(seen, np.array([0.0]))
            *_, info = env.step_physical(decision.action.tolist())
            h.append(info["barrier"][0])
        lowest.append(min(h))
    assert lowest[0] < 0.0 < lowest[1] + 1e-3


@pytest.mark.parametrize(
    "text",
    [
        "scbf:belief=0.05",
        "hocbf:alpha=2.0,8.0:belief=0.1",
        "cbf:alpha=1.0:measurement_error=0.1,0.2",
    ],
)
def test_texts_come_back(text):
    condition = parse_condition(text, (1.0, 1.0))
    assert parse_condition(spec_of(condition), (1.0, 1.0)) == condition
    assert spec_of(condition) == text


def with_errors(h, system=LINE, error=0.1, **more):
    return SafetyFilter(system, h, CBF(1.0, measurement_error=error), (-1, 1), **more)


def of_scalar(text):
    return SafetyFilter.for_problem(make_problem("Scalar-v0"), text)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: SCBF(belief=1.5), "probability above 0 and below 1"),
        (lambda: SCBF(belief="much"), "probability"),
        (lambda: SCBF(measurement_error=-1.0), "number >= 0"),
        (lambda: SCBF(belief=0.1, measurement_error=0.1), "give one"),
        (lambda: SafetyFilter(LINE, 1 - x, SCBF(belief=0.1), input_bounds=(-1, 1)), "instants="),
        (lambda: with_errors(1 - x**2), "region="),
        (lambda: with_errors(1 - x, error=(0.1, 0.2)), "one for each of the 1 states"),
        (lambda: SCBF(belief=0.1).constraint(LINE, Barrier(1 - x)), "of true states"),
        (
            lambda: with_errors(1 - (x - y) ** 2, replace(LINE, signals={y: 0}), region=[(-1, 1)]),
            "changes with x depends on y, whose values come in at each call",
        ),
        (lambda: of_scalar("srcbf:measurement_error=.1"), "not for srcbf"),
        (lambda: of_scalar("scbf:belief=2"), "probability above 0"),
    ],
)
def test_what_cannot_be_is_refused(make, words):
    with pytest.raises(ConfigurationError, match=words):
        make()


def test_several_barriers_share_the_probability():
    one, three = (
        SafetyFilter(LINE, [1 - x] * count, SCBF(belief=delta), (-9, 9), dt=0.1, instants=11)
        for count, delta in ((1, 0.1), (3, 0.3))
    )
    uncertain = {"belief_P_1_1": 0.01, "belief_P_rate_1_1": 0.02}
    proposal = {"x": [0.2], "u_nominal": [5.0], "parameters": uncertain}
    expected, found = (each.filter(**proposal) for each in (one, three))
    assert found.action == pytest.approx(expected.action, rel=1e-9)
    assert found.action < 5.0
    assert found.barrier == pytest.approx(expected.barrier.repeat(3), rel=1e-12)


# A safety filter in a control loop that has measurements only.


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


def without_beginning(problem):
    return ExtendedKalmanFilter(problem.model, problem.measurement, problem.dt)


def of_other_states(_):
    other = make_problem("Scalar-v0", measurement="default")
    initial = InitialBelief.of([0.0], [1.0])
    return ExtendedKalmanFilter(other.model, other.measurement, other.dt, initial=initial)


@pytest.mark.parametrize(
    ("call", "fragment"),
    [
        (lambda: pendulum(lambda _: None).filter_measurement([0.0] * 2, [0.0]), "has no estimator"),
        (lambda: pendulum(of_other_states), "other states"),
        (lambda: pendulum(without_beginning), "initial="),
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
