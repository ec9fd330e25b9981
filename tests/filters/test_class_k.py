"""Class-K functions: what they refuse, and what the chains make of them."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

from safe_envs import Barrier, ConfigurationError, ControlAffineSDE, SystemDefinitionError
from safe_envs.filters.conditions.class_k import S
from safe_envs.wrappers import CBF, HOCBF, ClassK, power
from tests.conftest import problem_of

x, y, u = sp.symbols("x y u", real=True)


@pytest.mark.parametrize(
    "text",
    [
        "s",
        "2*s**3",
        "2*s^3",
        "tanh(s)",
        "s*Abs(s)",
        "pi*s",
        "s+sin(s)/2",
        "s + s**5/10",
        "sinh(s)",
        "atan(3*s)",
        "exp(s) - 1",
    ],
)
def test_functions_that_increase_through_0_are_taken_and_round_trip(text):
    alpha = ClassK(text)
    assert alpha(sp.Integer(0)) == 0
    assert ClassK(str(alpha)) == alpha
    assert "," not in str(alpha)
    assert ":" not in str(alpha)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("s**2", "not strictly increasing"),
        ("s - s**3", "not strictly increasing"),
        ("-s", "not strictly increasing"),
        ("s**3 - s/1000", "not strictly increasing"),
        ("s + 1", "is 1.0 at 0"),
        ("sqrt(s)", "not real and finite"),
        ("cbrt(s)", "unknown function 'cbrt'"),
        ("sign(s)*sqrt(Abs(s))", "unknown function 'sign'"),
        ("s**9**9**9", "exponent 9 \\*\\* 9 is no number up to 100"),
        ("s + 0.0005", "is 0.0005 at 0"),
        ("log(s + 1)", "not real and finite|no value"),
        ("1/s", "no value"),
        ("s + t", "'t' is not allowed"),
        ("3", "expression of s alone"),
        ("sin(s)", "not strictly increasing"),
        ("cot(s)", "unknown function 'cot'"),
        ("s if s else 1", "is not allowed"),
        ("s.real", "is not allowed"),
        ("__import__('os').system('true')", "is not allowed|unknown function"),
        ("2*", "no expression of s"),
        ("s/0", "finite expression of s alone"),
        ("'s'", "is not allowed"),
    ],
)
def test_others_are_refused_with_the_reason(text, message):
    with pytest.raises(ConfigurationError, match=message):
        ClassK(text)


def test_sympy_expressions_are_taken_as_they_are():
    assert CBF(S**3).alpha == ClassK("s**3")
    assert HOCBF((1, sp.tanh(S))).alpha == (1.0, ClassK("tanh(s)"))
    assert CBF(sp.Symbol("s") ** 3).alpha == ClassK("s**3")
    with pytest.raises(ConfigurationError, match="s alone"):
        CBF(x**3)
    for no_text in (
        S + 10 * sp.sign(S),
        sp.Max(S, 2 * S),
        sp.Piecewise((S, S < 1), (2 * S - 1, True)),
    ):
        with pytest.raises(ConfigurationError, match="class-K function"):
            CBF(no_text)
    for nothing in (None, [1], object()):
        with pytest.raises(ConfigurationError):
            CBF(nothing)


def test_specs_keep_every_digit():
    alpha = power(0.1 + 0.2, 3)
    assert ClassK(str(alpha)) == alpha
    assert alpha != power(0.3, 3)


def test_power():
    for exponent in (1, 3, 2, 1.5):
        alpha = power(2.0, exponent)
        for value in (-1.7, -0.2, 0.0, 0.4, 3.0):
            assert float(alpha(sp.Float(value))) == pytest.approx(
                2 * np.sign(value) * abs(value) ** exponent
            )
    for arguments in ((0.0, 3), (-1.0, 3), (1.0, 0.5), (1.0, float("nan"))):
        with pytest.raises(ConfigurationError):
            power(*arguments)


def test_chain_of_curved_functions_follows_the_chain_rule():
    # x' = y, y' = u, h = 1 - x: b_1 = -y + (1 - x)^3, b_2 = -u - 3 (1 - x)^2 y + tanh(b_1).
    chain = ControlAffineSDE((x, y), (u,), [y, 0], [0, 1], [0, 0])
    found = HOCBF((power(1, 3), ClassK("tanh(s)"))).constraint(chain, Barrier(1 - x))
    b_1 = -y + (1 - x) ** 3
    assert sp.simplify(found.chain[1] - b_1) == 0
    assert found.coefficient == (-1,)
    assert sp.simplify(found.offset + 3 * (1 - x) ** 2 * y - sp.tanh(b_1)) == 0


def test_functions_that_are_not_smooth_enough_are_refused():
    third = ControlAffineSDE(
        (x, y, sp.Symbol("w", real=True)),
        (u,),
        [y, sp.Symbol("w", real=True), 0],
        [0, 0, 1],
        [0, 0, 0],
    )
    barrier = Barrier(1 - x)
    HOCBF((1.0, power(1.0, 2), power(1.0, 2))).constraint(third, barrier)
    with pytest.raises(
        SystemDefinitionError,
        match=r"s\*Abs\(s\) is the 1\. of 3 and needs 2 continuous derivatives",
    ):
        HOCBF((power(1, 2), 1.0, 1.0)).constraint(third, barrier)
    with pytest.raises(
        SystemDefinitionError, match=r"is the 2\. of 3 and needs 1 continuous derivatives"
    ):
        HOCBF((1.0, power(1, 1.5), 1.0)).constraint(third, barrier)


def test_a_steeper_function_near_the_edge_lets_the_policy_go_nearer():
    problem = problem_of("safe_envs/Scalar-v0", noise=0.0)
    rows = {
        c: c.constraint(problem.model, problem.barriers[0])
        for c in (CBF(1.0), CBF(power(1.0, 3)), CBF(ClassK("tanh(5*s)")))
    }
    margins = [float(r.offset.subs(problem.model.states[0], 0.9)) for r in rows.values()]
    assert margins == pytest.approx([0.1 - 0.9, 0.001 - 0.9, np.tanh(0.5) - 0.9])
