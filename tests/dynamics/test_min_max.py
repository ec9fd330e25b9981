"""Functions with kinks as the least of maxima of functions without them."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from safe_envs.dynamics.min_max import clauses

x, y, z = sp.symbols("x y z", real=True)

LINES = st.sampled_from([x, y, z, 1 - x, x + y - 2, x * y, x**2 - z, sp.Integer(1), sp.Integer(-2)])
NESTED = st.recursive(
    LINES,
    lambda parts: (
        st.builds(sp.Min, parts, parts)
        | st.builds(sp.Max, parts, parts)
        | st.builds(sp.Abs, parts)
        | st.builds(lambda a, b: a - 2 * b, parts, parts)
        | st.builds(lambda a: (1 + x**2) * a, parts)
    ),
    max_leaves=4,
)


@given(NESTED)
@settings(max_examples=60, deadline=None)
def test_clauses_have_the_sign_of_the_function(h):
    found = clauses(sp.sympify(h))
    for at in np.random.default_rng(0).normal(scale=2.0, size=(6, 3)).tolist():
        values = dict(zip((x, y, z), at, strict=True))
        least = min(max(float(e.subs(values)) for e in clause) for clause in found)
        assert (least >= 0.0) == (float(sp.sympify(h).subs(values)) >= 0.0)


@pytest.mark.parametrize(
    ("h", "expected"),
    [
        (1 - sp.Max(x, y), [{1 - x}, {1 - y}]),
        (1 - x - sp.Abs(y), [{1 - x - y}, {1 - x + y}]),
        (sp.Min(sp.Max(x, y), z), [{x, y}, {z}]),
        (sp.Max(sp.Min(x, y), z), [{x, z}, {y, z}]),
        (sp.Min(1 - x**2, 5), [{1 - x**2}]),
        (sp.Piecewise((x, x >= 0), (-x, True)), [{x, -x}]),
        (1 - sp.Piecewise((x, x > y), (y, True)), [{1 - x}, {1 - y}]),
        (1 - sp.Max(x, 0) ** 2 - sp.Abs(y), [{1 - sp.Max(x, 0) ** 2 - s * y} for s in (1, -1)]),
    ],
)
def test_minima_and_maxima_are_taken_apart(h, expected):
    found = [set(clause) for clause in clauses(h)]
    assert all(clause in found for clause in expected)
    assert len(found) == len(expected)


@pytest.mark.parametrize(
    "h",
    [
        1 - x**2,
        x * sp.Abs(y),
        sp.Min(x, y) ** 3,
        sp.Piecewise((1 - x, x > 0), (2 + x, True)),
        sp.Max(x, 2),
        sum(-sp.Abs(s) for s in sp.symbols("a:7", real=True)),
    ],
)
def test_what_cannot_be_taken_apart_stays_whole(h):
    assert clauses(h) == ((h,),)
