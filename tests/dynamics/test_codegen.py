"""Generated functions: any formula of symbols of any names is computed as sympy computes it, for
floats and for arrays."""

from __future__ import annotations

import copy
import math
import pickle
import subprocess
import sys

import cloudpickle
import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from safe_envs import SystemDefinitionError
from safe_envs.dynamics.codegen import compile_function, settled

WORDS = """x p0 p1 x0 x1 a000 a001 _c0 _c1 t h _w0 nan pi e I sin cos sqrt pow abs max select array
math print lambda None def _lambdifygenerated x_{1} θ 1 x.y a,b # '"""
NAMES = (*WORDS.split(), "a b", "")
LARGEST = 1e6
VALUES = st.floats(-2.0, 2.0, allow_subnormal=False).map(lambda v: round(v, 3) + 1e-4)


def symbol(name):
    return sp.Symbol(name, real=True)


def grown(parts):
    """Expressions of expressions: smooth functions, kinks, and powers of either sign."""
    exponents = [sp.Rational(1, 2), sp.Rational(-3, 2), sp.Rational(1, 3), sp.Float(0.7)]
    functions = [sp.sin, sp.cos, sp.tanh, sp.atan, sp.erf, sp.Abs, lambda e: sp.exp(-abs(e))]
    return st.one_of(
        st.builds(lambda a, b: a + b, parts, parts),
        st.builds(lambda a, b: a * b, parts, parts),
        st.builds(lambda a, b: a - sp.Rational(3, 7) * b, parts, parts),
        st.builds(lambda a, n: a**n, parts, st.integers(2, 3)),
        st.builds(lambda a, n: (2 + a**2) ** n, parts, st.integers(-3, -1)),
        st.builds(lambda a, e: (1 + a**2) ** e, parts, st.sampled_from(exponents)),
        st.builds(lambda f, a: f(a), st.sampled_from(functions), parts),
        st.builds(lambda a, b: sp.Max(a, b, evaluate=False), parts, parts),
        st.builds(sp.Min, parts, parts, parts),
    )


# Jumps are taken of single symbols only, where no rounding moves a value across one.
JUMPS = (
    sp.sign,
    lambda s: sp.Heaviside(s - 1),
    sp.floor,
    lambda s: sp.Mod(s, 2),
    lambda s: sp.Piecewise((s**2, s < 0), (sp.log(1 + s), True)),
    lambda s: sp.Piecewise((1 / s, sp.And(s > 1, s < 3)), (sp.S.Half, s <= 1), (s, True)),
)


def formulas(symbols):
    leaf = st.sampled_from(symbols)
    leaves = st.one_of(
        leaf,
        st.builds(lambda s, n: s**n, leaf, st.integers(4, 10)),
        st.builds(lambda jump, s: jump(s), st.sampled_from(JUMPS), leaf),
        st.integers(-3, 3).map(sp.Integer),
    )
    return st.recursive(leaves, grown, max_leaves=6)


@st.composite
def cases(draw):
    names = draw(st.lists(st.sampled_from(NAMES), min_size=1, max_size=4, unique=True))
    symbols = tuple(map(symbol, names))
    shared = draw(formulas(symbols))
    expressions = [shared, draw(formulas(symbols)), (shared + 1) * draw(formulas(symbols)) + shared]
    points = st.lists(st.tuples(*[VALUES for _ in symbols]), min_size=2, max_size=2)
    return symbols, expressions, draw(points)


def both(symbols, expressions):
    """Compile expressions for floats and for arrays."""
    return [compile_function(symbols, expressions, flavour) for flavour in ("floats", "arrays")]


class Exactly:
    """Values of expressions at a point, in thirty digits."""

    def __init__(self, at):
        self._numbers = {s: sp.Float(v, 50) for s, v in at.items()}
        self._known = {}

    def __call__(self, expression):
        """The value, and the largest value on the way to it."""
        parts = {e for e in sp.preorder_traversal(expression) if isinstance(e, sp.Expr)}
        for e in parts - set(self._known):
            self._known[e] = complex(sp.N(e.xreplace(self._numbers), 30))
        return self._known[expression].real, max(abs(self._known[e]) for e in parts)


@pytest.mark.parametrize(
    "names", ["p0 p1", "x0 x1", "_c0 _c1", "a001 a000", "sin None", "lambda x_{1}"]
)
def test_names_change_nothing(names):
    def values(first, second):
        total = first + second
        formula = total**2 + 3 * first * sp.sin(total) + 5 * sp.sin(total)
        return [function(1.0, 2.0)[0] for function in both((first, second), [formula])]

    expected = 3.0**2 + 3.0 * math.sin(3.0) + 5.0 * math.sin(3.0)
    assert values(*map(symbol, names.split())) == pytest.approx([expected] * 2, rel=1e-15)
    ordered = values(*map(symbol, sorted(names.split())))
    assert ordered == values(symbol("a"), symbol("b"))


X, Y = symbol("x"), symbol("y")
KINKS = (sp.Max(X, Y), X + sp.Min(X, Y, 2), sp.Abs(X - 5) * sp.Max(X, Y))
POWERS = (sp.Rational(1, 2), sp.Rational(-1, 2), -1, -3, sp.Rational(3, 2), 9, sp.Float(0.7), sp.pi)


@pytest.mark.parametrize(
    ("base", "powers"),
    [*((base, range(-9, 10)) for base in (X, X + 2, sp.sin(X))), *((e, POWERS) for e in KINKS)],
)
def test_powers(base, powers):
    points, expressions = [(0.7, 3.0), (2.0, 1.0)], [base**power for power in powers]
    floats, arrays = both((X, Y), expressions)
    columns = np.broadcast_arrays(*arrays(*np.array(points).T), np.zeros(2))
    for i, (x, y) in enumerate(points):
        exact = {X: sp.Rational(x), Y: sp.Rational(y)}
        expected = [float(e.subs(exact).evalf(30)) for e in expressions]
        assert floats(x, y) == pytest.approx(expected, rel=1e-14)
        assert [c[i] for c in columns[:-1]] == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize("flavour", ["floats", "arrays"])
def test_constants_have_all_their_digits(flavour):
    numbers = [sp.pi, sp.Rational(1, 3), sp.sqrt(2), sp.Float(0.1, 17), sp.exp(1)]
    expected = [math.pi, 1 / 3, math.sqrt(2), 0.1, math.e]
    assert [float(v) for v in compile_function((), numbers, flavour)()] == expected
    inside = compile_function((X,), [X * number for number in numbers], flavour)(1.0)
    assert [float(v) for v in inside] == pytest.approx(expected, rel=2.3e-16, abs=0.0)


def test_a_piece_without_a_value_elsewhere_counts_where_it_applies_only():
    shared = sp.log(X) * sp.sin(sp.log(X)) + 1 / X
    pieces = sp.Piecewise((shared, X > 0), (-1, True))
    floats, arrays = both((X,), [pieces, pieces**2])
    assert floats(-1.0) == (-1.0, 1.0)
    assert floats(0.0) == (-1.0, 1.0)
    assert floats(1.0) == pytest.approx((1.0, 1.0))
    with np.errstate(all="ignore"):
        np.testing.assert_array_equal(arrays(np.array([-1.0, 0.0]))[0], [-1.0, -1.0])


def test_what_has_no_real_value_is_no_number_in_either_flavour():
    floats, arrays = both((X,), [sp.Piecewise((X, X > 0))])
    assert math.isnan(floats(-1.0)[0])
    assert np.isnan(arrays(np.array([-1.0]))[0]).all()
    floats, arrays = both((X,), [X ** sp.Rational(3, 2) + X ** sp.Float(0.4)])
    with pytest.raises(ValueError, match="domain"):
        floats(-1.0)
    with np.errstate(all="ignore"):
        assert np.isnan(arrays(np.array([-1.0]))[0]).all()


@pytest.mark.parametrize("flavour", ["floats", "arrays"])
@pytest.mark.parametrize(
    ("symbols", "expression", "fragment"),
    [
        ((X,), Y + 1, "y"),
        ((X,), sp.Symbol("x") + 1, "holds x"),
        ((X,), sp.Function("exec")(X), "exec"),
        ((X,), sp.diff(sp.sign(X), X), "DiracDelta"),
        ((X,), sp.gamma(X), "gamma"),
        ((X,), sp.Function("f")(X).diff(X), "holds f"),
        ((X,), sp.I * X, "not real"),
        ((X,), sp.zoo * X, "division by 0"),
        ((X,), sp.Integer(10) ** 400 * X, "largest of floats"),
        ((X,), sp.Integer(10) ** 9000 * X, "largest of floats"),
        ((X,), sp.Integral(sp.exp(X**2), (X, 0, X)), "numerical form"),
        ((X, X), X, "two arguments"),
    ],
)
def test_formulas_without_a_number_are_refused(symbols, expression, fragment, flavour):
    with pytest.raises(SystemDefinitionError, match=fragment):
        compile_function(symbols, [expression], flavour)


@given(
    st.lists(st.tuples(st.integers(0, 2), st.floats(-3.0, 3.0)), min_size=1, max_size=12),
    st.booleans(),
)
@settings(max_examples=40)
def test_arrays_that_change_in_place_are_read_anew(changes, views):
    read = compile_function((X, Y), [sp.sin(X) + sp.cos(Y), sp.cos(X)], "arrays")
    settled(np.zeros((2, 3)), (3,))
    memory = np.zeros((2, 3))
    first, second = (memory[0], memory[1]) if views else (memory[0].copy(), memory[1].copy())
    for array in (first, second):
        frozen = array.view()
        frozen.flags.writeable = False
        for where, value in changes:
            array[where] = value
            np.testing.assert_array_equal(read(first, second)[1], np.cos(first))
            np.testing.assert_array_equal(read(frozen, second)[0], np.sin(frozen) + np.cos(second))


def test_settled_arrays_are_remembered_and_cannot_be_changed():
    read = compile_function((X, Y), [sp.sin(X), sp.cos(Y)], "arrays")
    a, b = settled((np.ones(3), 2.0), (3,))
    np.testing.assert_array_equal(b, [2.0] * 3)
    read(np.zeros(3), np.zeros(3))
    sine, cosine = read(a, b)
    np.testing.assert_array_equal([sine, cosine], [np.sin(a), np.cos(b)])
    assert read(a, b)[0] is sine
    assert read(a, b)[1] is cosine
    for array in (a, b, sine, cosine):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 5.0
    view = np.zeros(6)
    taken = settled((view[:3], view[3:]), (3,))
    view[:] = 1.0
    assert not np.any(taken)
    # Those of an earlier step are not kept.
    assert read(a, b)[0] is not sine


NEW_PROCESS = """
import pickle, sys
sys.path[:] = {path!r}
found = [function(.3, .7) for function in pickle.loads({pickled!r})]
print([[float(value).hex() for value in values] for values in found])
"""


def test_functions_are_pickled_as_the_expressions_that_they_are_made_of():
    hidden = sp.Dummy("x", real=True)
    rest = [sp.sqrt(X**2 + Y**2), sp.Rational(1, 3)]
    pieces = [sp.Piecewise((sp.log(X), X > 0), (1 / Y, True))]
    functions = [
        compile_function((X, Y), [sp.sin(X * Y) ** 3 / 7, sp.erf(Y) + X, *rest, *pieces], "floats"),
        compile_function((X, hidden), [sp.erf(hidden) + X, sp.Rational(1, 3)], "arrays"),
    ]
    pickled = pickle.dumps(functions)
    for copies in (pickle.loads(pickled), copy.deepcopy(functions)):
        for function, other in zip(functions, copies, strict=True):
            assert other(0.3, 0.7) == function(0.3, 0.7)
    # In a new process there is no function yet, and hashes of symbols are others.
    script = NEW_PROCESS.format(path=sys.path, pickled=pickled)
    answer = subprocess.check_output([sys.executable, "-c", script], text=True)
    expected = [[float(value).hex() for value in each(0.3, 0.7)] for each in functions]
    assert answer.strip() == str(expected)


def test_unpickling_a_function_reads_no_text_as_code():
    x = sp.Symbol("__import__('os').abort()")
    function = compile_function((x,), [x + 1], "floats")
    assert pickle.loads(pickle.dumps(function))(1.0) == (2.0,)


def test_functions_that_go_to_a_cluster_know_when_arrays_are_outdated():
    function = compile_function((X,), [sp.sin(X)], "arrays")
    # By cloudpickle generated code goes along as it is.
    other = pickle.loads(cloudpickle.dumps(function))
    for value in (0.3, 0.4):
        (at,) = settled((np.full(2, value),), (2,))
        assert other(at)[0] is function(at)[0]
        np.testing.assert_array_equal(other(at)[0], np.sin([value, value]))


@given(cases())
@settings(max_examples=14)
def test_floats_and_arrays_are_what_sympy_computes_whatever_the_names(case):
    symbols, expressions, points = case
    floats, arrays = both(symbols, expressions)
    with np.errstate(all="ignore"):
        columns = np.broadcast_arrays(*arrays(*np.array(points).T), np.zeros(len(points)))[:-1]
    for row, point in enumerate(points):
        ours, exactly = floats(*point), Exactly(dict(zip(symbols, point, strict=True)))
        for i, expression in enumerate(expressions):
            value, largest = exactly(expression)
            if largest < LARGEST:
                assert ours[i] == pytest.approx(value, rel=1e-10, abs=1e-10 * (1 + largest))
                assert columns[i][row] == pytest.approx(value, rel=1e-10, abs=1e-10 * (1 + largest))
