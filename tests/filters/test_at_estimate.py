"""Conditions at an estimate: belief barriers and bounded errors."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp
from scipy import stats

from safe_envs import ControlAffineSDE, SafeEnv
from safe_envs.errors import ConfigurationError
from safe_envs.filters.conditions.estimates import (
    EstimateSettings,
    belief_barrier,
    belief_symbols,
    belief_system,
    constraint_at_estimate,
    largest_slope,
    standard_deviations,
)
from safe_envs.problem.problem import Barrier
from safe_envs.registry import make_problem
from safe_envs.wrappers import CBF, SCBF, SafetyFilter, parse_condition, spec_of

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
            for env, condition in (
                ("StochasticDubins", "scbf"),
                ("StochasticDubins", "szcbf"),
                ("ACC", "scbf"),
                ("ACC", "szcbf"),
            )
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
    actions = [
        found.filter(
            np.array([0.2]),
            np.array([5.0]),
            parameters={"belief_P_1_1": p, "belief_P_rate_1_1": 0.0},
        ).action[0]
        for p in (0.0, 0.001, 0.01, 0.02)
    ]
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


def test_no_error_is_the_plain_constraint():
    found = SafetyFilter(
        LINE, 1 - x, SCBF(measurement_error=0.0), input_bounds=(-9, 9), region=[(-2, 2)]
    )
    plain = SafetyFilter(LINE, 1 - x, SCBF(), input_bounds=(-9, 9))
    state, proposed = np.array([0.4]), np.array([3.0])
    assert found.filter(state, proposed).action == pytest.approx(
        plain.filter(state, proposed).action
    )


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


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: SCBF(belief=1.5), "probability above 0 and below 1"),
        (lambda: SCBF(belief="much"), "probability"),
        (lambda: SCBF(measurement_error=-1.0), "number >= 0"),
        (lambda: SCBF(belief=0.1, measurement_error=0.1), "give one"),
        (lambda: SafetyFilter(LINE, 1 - x, SCBF(belief=0.1), input_bounds=(-1, 1)), "instants="),
        (
            lambda: SafetyFilter(
                LINE, 1 - x**2, CBF(1.0, measurement_error=0.1), input_bounds=(-1, 1)
            ),
            "region=",
        ),
        (
            lambda: SafetyFilter(
                LINE, 1 - x, CBF(1.0, measurement_error=(0.1, 0.2)), input_bounds=(-1, 1)
            ),
            "one for each of the 1 states",
        ),
        (lambda: SCBF(belief=0.1).constraint(LINE, Barrier(1 - x)), "of true states"),
        (
            lambda: SafetyFilter(
                replace(LINE, signals={y: 0}),
                1 - (x - y) ** 2,
                CBF(1.0, measurement_error=0.1),
                input_bounds=(-1, 1),
                region=[(-1, 1)],
            ),
            "changes with x depends on y, whose values come in at each call",
        ),
        (
            lambda: SafetyFilter.for_problem(
                make_problem("Scalar-v0"), "srcbf:measurement_error=.1"
            ),
            "not for srcbf",
        ),
        (
            lambda: SafetyFilter.for_problem(make_problem("Scalar-v0"), "scbf:belief=2"),
            "probability above 0",
        ),
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
