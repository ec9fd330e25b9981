"""Conditions: what they derive, what they refuse, and how they are written as text."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

from safe_envs import (
    Barrier,
    ConfigurationError,
    ControlAffineSDE,
    RelativeDegreeError,
    SystemDefinitionError,
)
from safe_envs.wrappers import (
    CBF,
    ECBF,
    HOCBF,
    RCBF,
    SCBF,
    SRCBF,
    SZCBF,
    SafetyFilter,
    parse_condition,
    spec_of,
)
from tests.conftest import problem_of

X = sp.Symbol("x", real=True)


def constraint(condition, env_id, **arguments):
    problem = problem_of(env_id, **arguments)
    return problem, condition.constraint(problem.model, problem.barriers[0])


def test_scbf_of_the_noisy_disk_is_eq_4_25():
    problem, found = constraint(SCBF(), "safe_envs/StochasticDubins-v0")
    x, y, theta = problem.model.states
    a = problem.model.exact(found.coefficient[0] - 4 * (x * sp.sin(theta) - y * sp.cos(theta)))
    assert sp.simplify(a) == 0
    assert sp.simplify(problem.model.exact(found.offset) + 8) == 0
    a_h = problem.model.exact(found.chain[1])
    assert sp.simplify(a_h + 4 * (x * sp.cos(theta) + y * sp.sin(theta)) + sp.Rational(8, 100)) == 0


@pytest.mark.parametrize(
    "env_id",
    ["safe_envs/DubinsObstacle-v0", "safe_envs/ACC-v0"],
)
def test_hocbf_equals_the_ecbf_with_the_gains_of_its_polynomial(env_id):
    gains = problem_of(env_id).gains
    problem, hocbf = constraint(HOCBF.for_gains(gains), env_id)
    _, ecbf = constraint(ECBF.for_gains(gains), env_id)
    assert hocbf.coefficient == ecbf.coefficient
    rng = np.random.default_rng(0)
    for _ in range(5):
        values = dict(
            zip(problem.model.states, rng.uniform(0.1, 1.0, problem.model.n), strict=True)
        )
        first, second = (float(problem.model.numeric(c.offset).subs(values)) for c in (hocbf, ecbf))
        assert first == pytest.approx(second, rel=1e-10)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_ecbf_takes_multiple_poles_and_its_text_is_read_as_the_same(count):
    ecbf = ECBF(poles=(-1 / 3,) * count)
    assert ecbf.chain_rates(count) == (1 / 3,) * count
    assert parse_condition(spec_of(ecbf), ()) == ecbf


def test_single_numbers_do_for_one_rate():
    assert HOCBF(2.0) == HOCBF((2.0,))
    assert SZCBF(2.0) == SZCBF((2.0,))
    assert ECBF(poles=-2.0) == ECBF((2.0,))


def test_a_minimum_has_a_constraint_for_each_piece():
    x, u, y = sp.symbols("x u y", real=True)
    noisy = ControlAffineSDE((x,), (u,), [0], [1], [1])
    chain = ControlAffineSDE((x, y), (u,), [y, 0], [0, 1])
    early = CBF(1.0, sampling_margin="first-order")
    for h in (1 - sp.Abs(x), sp.Min(1 - x, 1 + x), sp.Piecewise((1 - x, x > 0), (1 + x, True))):
        for condition in (CBF(1.0), RCBF(), SCBF(), SRCBF(), early, HOCBF((1.0, 1.0))):
            system = chain if isinstance(condition, HOCBF) else noisy
            with pytest.raises(SystemDefinitionError, match="one barrier for each of its pieces"):
                condition.constraint(system, Barrier(h))
            parts = condition.parts(Barrier(h))
            assert {part.expression for part in parts} == {1 - x, 1 + x}
            for part in parts:
                condition.constraint(system, part)


STEP, V = sp.Heaviside(X - 0.9) / 2, sp.Symbol("v", real=True)


@pytest.mark.parametrize(
    ("rate", "condition", "message"),
    [
        (V + STEP, HOCBF((2.0, 2.0)), r"drift of x .* 10\*x - 9"),
        (V + STEP, ECBF(poles=(-1.0, -2.0)), "drift of x .* jump"),
        (V + STEP, SZCBF((1.0, 1.0)), "drift of x .* jump"),
        (V + STEP, SCBF(), "drift of x .* jump"),
        (V + sp.Piecewise((0, X < 0.9), (0.5, True)), HOCBF((2.0, 2.0)), "drift of x .* jump"),
        (V + sp.floor(X), HOCBF((2.0, 2.0)), r"drift of x .* floor\(x\)"),
        (V + 2 * sp.Abs(V), HOCBF((2.0, 2.0)), r"drift of x .* kink .* v"),
        # States only pass these.
        (V + sp.Abs(X - 0.9), HOCBF((2.0, 2.0)), None),
        (V + sp.tanh(200 * (X - 0.9)), HOCBF((2.0, 2.0)), None),
    ],
)
def test_a_drift_that_the_chain_differentiates_does_not_jump(rate, condition, message):
    u = sp.Symbol("u", real=True)
    system = ControlAffineSDE((X, V), (u,), [rate, -sp.sign(V)], [0, 1])
    if message is None:
        assert condition.constraint(system, Barrier(1 - X)).offset != 0
        return
    with pytest.raises(SystemDefinitionError, match=message):
        condition.constraint(system, Barrier(1 - X))


DISK, NOISY = "safe_envs/DubinsDisk-v0", "safe_envs/StochasticDubins-v0"
LEFT = sp.Piecewise((0, X < 0.9), (0.5, True))


def of_drift(step, text) -> SafetyFilter:
    system = ControlAffineSDE((X,), (sp.Symbol("u", real=True),), [step], [1])
    return SafetyFilter(system, 1 - X, text, (-1, 1), dt=0.1, region=[(-2, 2)])


@pytest.mark.parametrize(
    ("make", "error", "fragment"),
    [
        (lambda: constraint(CBF(1.0), DISK), RelativeDegreeError, "degree 2"),
        (lambda: constraint(HOCBF((1.0, 1.0)), "safe_envs/ACC-v0"), RelativeDegreeError, "2 given"),
        (lambda: constraint(ECBF((1.0,)), DISK), RelativeDegreeError, "1 given"),
        (lambda: constraint(RCBF(), NOISY), RelativeDegreeError, "hocbf"),
        (lambda: constraint(SRCBF(), NOISY), RelativeDegreeError, "hocbf"),
        *[
            (lambda wrong=wrong: ECBF(**wrong), ConfigurationError, "real negative")
            for wrong in (
                {"k": (2.0, 1.0)},
                {"k": (1.16, 2.0)},  # -1 +- .4 i
                {"poles": (-1 + 1j, -1 - 1j)},
                {"poles": (-1 + 9e-4j, -2)},
                {"poles": (-1.0, 0.0)},
                {"poles": (2.0,)},
                {"poles": ()},
            )
        ],
        (lambda: ECBF((-1.0, 2.0)), ConfigurationError, "positive"),
        (lambda: ECBF((1.0, 2.0), poles=(-1.0, -1.5)), ConfigurationError, "poles"),
        *[
            (lambda step=step, text=text: of_drift(step, text), SystemDefinitionError, "drift of x")
            for step in (STEP, LEFT)
            for text in ("cbf:sampling_margin=first-order", "cbf:measurement_error=0.1")
        ],
    ],
)
def test_what_makes_no_constraint_is_refused(make, error, fragment):
    with pytest.raises(error, match=fragment):
        make()


def test_a_drift_that_only_the_constraint_has_may_jump():
    for step in (STEP, LEFT):
        assert of_drift(step, "cbf").filter([0.0], [0.5]).feasible


def test_ecbf_takes_real_poles_that_rounding_splits():
    assert ECBF((1.0, 2.0)).chain_rates(2) == pytest.approx((1.0, 1.0))  # a double pole
    assert ECBF((6.0, 11.0, 6.0)).chain_rates(3) == pytest.approx((1.0, 2.0, 3.0))
    rates = np.random.default_rng(0).uniform(0.05, 20.0, 5)
    for p in rates:
        ECBF(k=ECBF.for_gains((p, p)).k)
    ECBF(k=ECBF.for_gains((rates[0],) * 3).k)  # 50 digits of multiple roots take their time


@pytest.mark.parametrize(
    ("h", "smooth"),
    [
        (sp.Piecewise((1 - X, X > 0), (1 + X, True)), 0),
        (sp.Piecewise((1 - X**2, X > 0), (1, True)), 1),
        (sp.Piecewise((1, X < 2), (1 - (X - 2) ** 4, X < 3), (12 - 4 * X, True)), 1),
        (sp.Piecewise((1 - X**3 * (X + 2), X > 0), (1, True)), 2),
        (1 - sp.Piecewise((X**4, X > 0), (0, True)), 3),
        (sp.Piecewise((1 - X, X > 0), (2 + X, True)), -1),
        (sp.Piecewise((1 - X, X**3 + X > 0), (1 + X, True)), -1),
        (sp.Piecewise((1 - X, X > 0)), -1),
    ],
)
def test_pieces_of_a_barrier_have_to_meet_as_smoothly_as_the_chain_differentiates(h, smooth):
    u, y = sp.symbols("u y", real=True)
    noisy = ControlAffineSDE((X,), (u,), [0], [1], [1])
    chain = ControlAffineSDE((X, y), (u,), [y, 0], [0, 1], [0, 1])
    shaken = ControlAffineSDE((X, y), (u,), [y, 0], [0, 1], [1, 0])
    needs = [
        (CBF(1.0), noisy, 1),
        (RCBF(), noisy, 1),
        (CBF(1.0, sampling_margin="first-order"), noisy, 1),
        (HOCBF((1.0, 1.0)), chain, 1),
        (SCBF(), noisy, 1),
        (SRCBF(), noisy, 1),
        (SZCBF((1.0, 1.0)), chain, 1),
        (SZCBF((1.0, 1.0)), shaken, 3),
        (SCBF(sampling_margin="first-order"), noisy, 3),
    ]
    for condition, system, order in needs:
        if order <= smooth:
            condition.constraint(system, Barrier(h))
        else:
            with pytest.raises(SystemDefinitionError, match="one barrier for each of its pieces"):
                condition.constraint(system, Barrier(h))


def test_ecbf_by_poles_has_the_gains_of_their_polynomial_and_keeps_the_sets_of_the_hocbf():
    ecbf = ECBF(poles=(-2.0, -8.0))
    assert ecbf.k == (16.0, 10.0)
    assert ecbf == ECBF((16.0, 10.0))
    problem, placed = constraint(ecbf, "safe_envs/DubinsDisk-v0")
    _, hocbf = constraint(HOCBF((2.0, 8.0)), "safe_envs/DubinsDisk-v0")
    difference = problem.model.numeric(placed.chain[1] - hocbf.chain[1])
    assert (
        abs(float(difference.subs(dict(zip(problem.model.states, (0.3, -0.4, 1.1), strict=True)))))
        < 1e-9
    )


def test_szcbf_has_the_corrected_chain():
    problem, found = constraint(SZCBF((0.7, 3.0)), "safe_envs/StochasticDubins-v0")
    at = dict(zip(problem.model.states, (0.3, -0.4, 1.1), strict=True))
    v, sigma, a_1, a_2 = 2.0, 0.2, 0.7, 3.0
    h = 9 - 0.3**2 - 0.4**2
    a_h = -2 * v * (0.3 * np.cos(1.1) - 0.4 * np.sin(1.1)) - 2 * sigma**2
    h_1 = a_h + a_1 * h
    offset = -2 * v**2 + a_1 * a_h + a_2 * h_1  # A h_1 + alpha_2 h_1, where the print has alpha_2 h
    assert float(problem.model.numeric(found.chain[1]).subs(at)) == pytest.approx(h_1, rel=1e-12)
    assert float(problem.model.numeric(found.offset).subs(at)) == pytest.approx(offset, rel=1e-12)
