"""Where functions are not smooth, found by what they are made of."""

from __future__ import annotations

import pytest
import sympy as sp

from safe_envs.proofs.safe_set import edges
from tests.wrappers.verification.verified import made, made_bound, problem_with, x


@pytest.mark.parametrize(
    ("expression", "smooth", "rough"),
    [
        (sp.sqrt(2 - 2 * sp.cos(x)), 0.5, 0.0),
        (1 / x, 0.5, 0.0),
        (sp.log(1 - x), 0.5, 1.0),
        (sp.acos(x / 2), 0.5, 2.0),
        (sp.asin(x / 2), 0.5, -2.0),
        (sp.acosh(x), 1.5, 1.0),
        (sp.atanh(x), 0.5, 1.0),
        (sp.tan(x), 0.5, sp.pi / 2),
        (sp.cot(x), 0.5, sp.pi),
        (sp.sec(x), 0.5, sp.pi / 2),
        (sp.csc(x), 0.5, 0),
        (x ** sp.Float(1.5), 0.5, 0.0),
        (sp.atan2(x - 1, -2), 0.5, 1.0),
    ],
)
def test_an_edge_is_where_its_base_is_zero(expression, smooth, rough):
    found = [edge.base for edge in edges(expression)]
    assert any(abs(float(base.subs(x, rough))) < 1e-12 for base in found)
    assert all(abs(complex(base.subs(x, smooth))) > 1e-3 for base in found)


@pytest.mark.parametrize(
    "expression",
    [x**3 - x, sp.sin(x) * sp.exp(x), sp.tanh(x), (1 + x**2) ** 2, 2**x, sp.Integer(3)],
)
def test_what_is_smooth_everywhere_has_no_edges(expression):
    assert not list(edges(sp.sympify(expression)))


@pytest.mark.parametrize(
    ("barrier", "note"),
    [
        (
            0.5 - sp.sqrt(2 - 2 * sp.cos(x)),
            "h_1 is not twice differentiable, which Ito's formula asks for, near x = ",
        ),
        (1 / x - 0.6, "h_1 has a pole near x = "),
        # Beyond the edge of C, and beyond the workspace, nothing matters.
        (sp.sqrt((x + 1) ** 2 + 1e-9) - 0.5 - (x - 2) ** 2 / 4, None),
        (1 - x**2 + sp.log(x + 4), None),
    ],
)
def test_only_what_is_in_the_safe_set_counts(barrier, note):
    found = made_bound(problem_with([0 * x], [barrier], noise=(0.3,)), "szcbf:alphas=0.1")
    assert (
        (found.note or "").startswith(note or "")
        if note
        else "differentiable" not in (found.note or "") + found.remark
    )


@pytest.mark.parametrize(
    "near",
    [
        1 / sp.sqrt(x**2 + 1e-6),
        sp.sqrt(sp.cosh(2 * x) - sp.Float("0.99999999")),
        1 / (sp.Float("1.0000001") - sp.sin(x)),
    ],
)
def test_what_comes_near_a_pole_or_kink_only_is_left_to_the_judge(near):
    found = made_bound(problem_with([0 * x], [1 - x**2 + near / 1000], noise=(0.3,)), "szcbf")
    assert (found.note, found.proof.regular) == (None, True)


def test_what_is_near_a_kink_and_not_judged_is_not_established():
    near = sp.sqrt(sp.cosh(2 * x) - sp.Float("0.99999999"))
    problem = problem_with([0 * x], [1 - x**2 + near / 1000], noise=(0.3,))
    rough = made(problem, "szcbf", samples=512).analysis.rough
    start = "it is not established that h_1 is twice differentiable, which Ito's formula asks for,"
    assert rough.startswith(f"{start} near x = ")
    square = problem_with([0 * x], [1 - x**2 - sp.Abs(x) ** 3], noise=(0.3,))
    assert "differentiable" not in (made_bound(square, "szcbf").note or "")


def test_without_noise_a_kink_is_no_matter_and_a_pole_is():
    kink = problem_with(
        [(x**2 + 1e-4) ** sp.Rational(1, 4) * (1 - x) ** sp.Rational(3, 2)], [1 - x**2]
    )
    assert made(kink, "cbf", samples=512).analysis.rough == ""
    pole = problem_with([0 * x], [1 / x - 0.6])
    assert made(pole, "cbf", samples=512).analysis.rough.startswith("h_1 has a pole near x = ")
    drift = problem_with([1 / (x - 0.3)], [1 - x**2])
    assert made(drift, "cbf", samples=512).analysis.rough.startswith(
        "the condition on h_1 has a pole near x = 0.3"
    )
