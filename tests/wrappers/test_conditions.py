"""Conditions: what they derive, what they refuse, and how they are written as text."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, RelativeDegreeError
from tests.conftest import problem_of
from wrappers import CBF, CONDITIONS, ECBF, HOCBF, SCBF, parse_condition


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


def test_hocbf_of_the_disk_is_the_polynomial_of_its_rates():
    p1, p2 = 0.7, 3.0
    problem, found = constraint(HOCBF((p1, p2)), "safe_envs/DubinsDisk-v0")
    values = dict(zip(problem.model.states, (0.3, -0.4, 1.1), strict=True))
    x, y, theta, v = 0.3, -0.4, 1.1, 0.5
    h, hdot = 1 - x * x - y * y, -2 * v * (x * np.cos(theta) + y * np.sin(theta))
    offset = -2 * v**2 + (p1 + p2) * hdot + p1 * p2 * h
    assert float(problem.model.numeric(found.offset).subs(values)) == pytest.approx(offset, rel=1e-12)
    assert float(problem.model.numeric(found.chain[1]).subs(values)) == pytest.approx(hdot + p1 * h, rel=1e-12)


@pytest.mark.parametrize("env_id", ["safe_envs/DubinsObstacle-v0", "safe_envs/Quadrotor-v0", "safe_envs/ACC-v0"])
def test_hocbf_equals_the_ecbf_with_the_gains_of_its_polynomial(env_id):
    gains = problem_of(env_id).gains
    problem, hocbf = constraint(HOCBF.for_gains(gains), env_id)
    _, ecbf = constraint(ECBF.for_gains(gains), env_id)
    assert hocbf.coefficient == ecbf.coefficient
    rng = np.random.default_rng(0)
    for _ in range(5):
        values = dict(zip(problem.model.states, rng.uniform(0.1, 1.0, problem.model.n), strict=True))
        first, second = (float(problem.model.numeric(c.offset).subs(values)) for c in (hocbf, ecbf))
        assert first == pytest.approx(second, rel=1e-10)


def test_cbf_ignores_the_noise_and_scbf_does_not():
    problem, cbf = constraint(CBF(2.0), "safe_envs/CubicSDEDisk-v0")
    _, scbf = constraint(SCBF(), "safe_envs/CubicSDEDisk-v0")
    h = problem.barriers[0].expression
    difference = problem.model.exact(cbf.offset - scbf.offset - 2 * h)
    assert sp.simplify(sp.nsimplify(difference)) == sp.Rational(8, 100)


def test_wrong_relative_degrees_are_named():
    with pytest.raises(RelativeDegreeError, match=r"relative degree 2.*use hocbf or ecbf"):
        constraint(CBF(1.0), "safe_envs/DubinsDisk-v0")
    with pytest.raises(RelativeDegreeError, match=r"relative degree 1 and needs as many rates; 2 given"):
        constraint(HOCBF((1.0, 1.0)), "safe_envs/ACC-v0")
    with pytest.raises(RelativeDegreeError, match=r"relative degree 2 and needs as many gains; 1 given"):
        constraint(ECBF((1.0,)), "safe_envs/DubinsDisk-v0")


def test_ecbf_needs_real_negative_poles():
    assert ECBF((1.0, 2.0)).k == (1.0, 2.0)  # a double pole at -1
    assert ECBF((6.0, 11.0, 6.0)).k == (6.0, 11.0, 6.0)  # -1, -2, -3
    for p in np.random.default_rng(0).uniform(0.05, 20.0, 50):
        ECBF.for_gains((p, p))  # double poles, which rounding splits
        ECBF.for_gains((p, p, p))
    with pytest.raises(ConfigurationError, match="complex poles"):
        ECBF((2.0, 1.0))
    with pytest.raises(ConfigurationError, match="positive"):
        ECBF((-1.0, 2.0))


@pytest.mark.parametrize("text", ["cbf:alpha=0.3", "ecbf:k=2.0,3.0", "hocbf:p=2.0,8.0", "scbf"])
def test_text_round_trips(text):
    condition = parse_condition(text, (1.0,))
    assert condition.spec == text
    assert parse_condition(condition.spec, ()) == condition


def test_parameters_default_to_the_gains():
    assert parse_condition("hocbf", (2.0, 8.0)) == HOCBF((2.0, 8.0))
    assert parse_condition("cbf", (5.0,)) == CBF(5.0)
    assert parse_condition("ecbf", (2.0, 8.0)) == ECBF((16.0, 10.0))
    assert set(CONDITIONS) == {"cbf", "ecbf", "hocbf", "scbf"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scfb", "unknown filter 'scfb'; did you mean 'scbf'"),
        ("hocbf:q=1", "no parameter 'q'"),
        ("hocbf:p=1,x", "p = '1,x' is no number"),
        ("hocbf:p=", "p = '' is no number"),
        ("hocbf:p=1,-2", "give positive rates"),
        ("hocbf:p=nan", "give positive rates"),
        ("cbf:alpha=1,2", "alpha takes one number"),
        ("scbf:alpha=1", "filter scbf has no parameter 'alpha'"),
    ],
)
def test_text_that_makes_no_condition_is_explained(text, message):
    with pytest.raises(ConfigurationError, match=message):
        parse_condition(text, (1.0, 1.0))
