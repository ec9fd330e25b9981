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

NAMES = (
    *(
        "x",
        "p0",
        "p1",
        "x0",
        "x1",
        "a000",
        "a001",
        "_c0",
        "_c1",
        "t",
        "h",
        "_w0",
        "nan",
        "pi",
        "e",
        "I",
    ),
    *(
        "sin",
        "cos",
        "sqrt",
        "pow",
        "abs",
        "max",
        "select",
        "array",
        "math",
        "print",
        "lambda",
        "None",
        "def",
        "_lambdifygenerated",
    ),
    *("x_{1}", "a b", "θ", "1", "", "x.y", "a,b", "#", "'"),
)
LARGEST = 1e6
VALUES = st.floats(-2.0, 2.0, allow_subnormal=False).map(lambda v: round(v, 3) + 1e-4)


def symbol(name):
    return sp.Symbol(name, real=True)


def grown(parts):
    """Expressions of expressions: smooth functions, kinks, and powers of either sign."""
    pair = st.tuples(parts, parts)
    return st.one_of(
        pair.map(lambda p: p[0] + p[1]),
        pair.map(lambda p: p[0] * p[1]),
        pair.map(lambda p: p[0] - sp.Rational(3, 7) * p[1]),
        st.tuples(parts, st.integers(2, 3)).map(lambda p: p[0] ** p[1]),
        st.tuples(parts, st.integers(-3, -1)).map(lambda p: (2 + p[0] ** 2) ** p[1]),
        st.tuples(
            parts,
            st.sampled_from(
                [sp.Rational(1, 2), sp.Rational(-3, 2), sp.Rational(1, 3), sp.Float(0.7)]
            ),
        ).map(lambda p: (1 + p[0] ** 2) ** p[1]),
        st.tuples(
            parts, st.sampled_from([sp.sin, sp.cos, sp.tanh, sp.atan, sp.erf, sp.Abs, sp.exp])
        ).map(lambda p: p[1](-abs(p[0]) if p[1] is sp.exp else p[0])),
        pair.map(lambda p: sp.Max(*p, evaluate=False)),
        st.tuples(parts, parts, parts).map(lambda p: sp.Min(*p)),
    )


def formulas(symbols):
    """Jumps are taken of single symbols only, where no rounding moves a value across one."""
    jump = st.sampled_from(
        [
            lambda s: sp.sign(s),
            lambda s: sp.Heaviside(s - 1),
            lambda s: sp.floor(s),
            lambda s: sp.Mod(s, 2),
            lambda s: sp.Piecewise((s**2, s < 0), (sp.log(1 + s), True)),
            lambda s: sp.Piecewise((1 / s, sp.And(s > 1, s < 3)), (sp.S.Half, s <= 1), (s, True)),
        ]
    )
    leaf = st.sampled_from(symbols)
    power = st.tuples(leaf, st.integers(4, 10)).map(lambda p: p[0] ** p[1])
    leaves = st.one_of(
        leaf,
        power,
        st.tuples(jump, leaf).map(lambda p: p[0](p[1])),
        st.integers(-3, 3).map(sp.Integer),
    )
    return st.recursive(leaves, grown, max_leaves=6)


@st.composite
def cases(draw):
    symbols = tuple(
        symbol(name)
        for name in draw(st.lists(st.sampled_from(NAMES), min_size=1, max_size=4, unique=True))
    )
    shared = draw(formulas(symbols))
    expressions = [shared, draw(formulas(symbols)), (shared + 1) * draw(formulas(symbols)) + shared]
    return (
        symbols,
        expressions,
        draw(st.lists(st.tuples(*[VALUES for _ in symbols]), min_size=2, max_size=2)),
    )


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


@given(cases())
@settings(max_examples=18)
def test_floats_and_arrays_are_what_sympy_computes_whatever_the_names(case):
    symbols, expressions, points = case
    floats, arrays = (
        compile_function(symbols, expressions, flavour) for flavour in ("floats", "arrays")
    )
    with np.errstate(all="ignore"):
        columns = np.broadcast_arrays(*arrays(*np.array(points).T), np.zeros(len(points)))[:-1]
    for row, point in enumerate(points):
        ours, exactly = floats(*point), Exactly(dict(zip(symbols, point, strict=True)))
        for i, expression in enumerate(expressions):
            value, largest = exactly(expression)
            if largest < LARGEST:
                assert ours[i] == pytest.approx(value, rel=1e-10, abs=1e-10 * (1 + largest))
                assert columns[i][row] == pytest.approx(value, rel=1e-10, abs=1e-10 * (1 + largest))


@pytest.mark.parametrize("flavour", ["floats", "arrays"])
@pytest.mark.parametrize(
    "names",
    [
        ("p0", "p1"),
        ("x0", "x1"),
        ("_c0", "_c1"),
        ("a001", "a000"),
        ("sin", "None"),
        ("lambda", "x_{1}"),
    ],
)
def test_names_change_nothing(names, flavour):
    def read(first, second):
        both = first + second
        return compile_function(
            (first, second), [both**2 + 3 * first * sp.sin(both) + 5 * sp.sin(both)], flavour
        )

    expected = 3.0**2 + 3.0 * math.sin(3.0) + 5.0 * math.sin(3.0)
    assert read(*map(symbol, names))(1.0, 2.0)[0] == pytest.approx(expected, rel=1e-15)
    assert (
        read(*map(symbol, sorted(names)))(1.0, 2.0)[0]
        == read(symbol("a"), symbol("b"))(1.0, 2.0)[0]
    )


@pytest.mark.parametrize("flavour", ["floats", "arrays"])
@pytest.mark.parametrize("power", range(-9, 10))
def test_powers_of_either_sign(power, flavour):
    x = symbol("x")
    for base in (x, x + 2, sp.sin(x)):
        given = np.array([0.7]) if flavour == "arrays" else 0.7
        value = compile_function((x,), [base**power], flavour)(given)[0]
        expected = float((base**power).subs(x, sp.Rational(0.7)).evalf(30))
        assert value == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize(
    "power",
    [sp.Rational(1, 2), sp.Rational(-1, 2), -1, -3, sp.Rational(3, 2), 9, sp.Float(0.7), sp.pi],
)
@pytest.mark.parametrize(
    "base",
    [
        lambda x, y: sp.Max(x, y),
        lambda x, y: x + sp.Min(x, y, 2),
        lambda x, y: sp.Abs(x - 5) * sp.Max(x, y),
    ],
)
def test_powers_of_kinks(base, power):
    x, y = symbol("x"), symbol("y")
    points = [(1.0, 3.0), (2.0, 1.0)]
    arrays = compile_function((x, y), [base(x, y) ** power], "arrays")(*np.array(points).T)[0]
    for value, point in zip(arrays, points, strict=True):
        assert value == pytest.approx(
            float((base(x, y) ** power).subs(dict(zip((x, y), point, strict=True)))), rel=1e-14
        )


@pytest.mark.parametrize("flavour", ["floats", "arrays"])
def test_constants_have_all_their_digits(flavour):
    x = symbol("x")
    numbers = [sp.pi, sp.Rational(1, 3), sp.sqrt(2), sp.Float(0.1, 17), sp.exp(1)]
    expected = [math.pi, 1 / 3, math.sqrt(2), 0.1, math.e]
    assert [float(v) for v in compile_function((), numbers, flavour)()] == expected
    inside = [
        float(v) for v in compile_function((x,), [x * number for number in numbers], flavour)(1.0)
    ]
    assert inside == pytest.approx(expected, rel=2.3e-16, abs=0.0)


def test_a_piece_without_a_value_elsewhere_counts_where_it_applies_only():
    x = symbol("x")
    shared = sp.log(x) * sp.sin(sp.log(x)) + 1 / x
    pieces = sp.Piecewise((shared, x > 0), (-1, True))
    floats, arrays = (
        compile_function((x,), [pieces, pieces**2], flavour) for flavour in ("floats", "arrays")
    )
    assert floats(-1.0) == (-1.0, 1.0)
    assert floats(0.0) == (-1.0, 1.0)
    assert floats(1.0) == pytest.approx((1.0, 1.0))
    with np.errstate(all="ignore"):
        np.testing.assert_array_equal(arrays(np.array([-1.0, 0.0]))[0], [-1.0, -1.0])


def test_what_has_no_real_value_is_no_number_in_either_flavour():
    x = symbol("x")
    unfinished = sp.Piecewise((x, x > 0))
    floats, arrays = (
        compile_function((x,), [unfinished], flavour) for flavour in ("floats", "arrays")
    )
    assert math.isnan(floats(-1.0)[0])
    assert np.isnan(arrays(np.array([-1.0]))[0]).all()
    root = x ** sp.Rational(3, 2) + x ** sp.Float(0.4)
    floats, arrays = (compile_function((x,), [root], flavour) for flavour in ("floats", "arrays"))
    with pytest.raises(ValueError, match="domain"):
        floats(-1.0)
    with np.errstate(all="ignore"):
        assert np.isnan(arrays(np.array([-1.0]))[0]).all()


@pytest.mark.parametrize("flavour", ["floats", "arrays"])
@pytest.mark.parametrize(
    ("expression", "message"),
    [
        (symbol("y") + 1, "holds y"),
        (sp.Symbol("x") + 1, "holds x"),
        (sp.Function("exec")(symbol("x")), "holds exec"),
        (sp.diff(sp.sign(symbol("x")), symbol("x")), "DiracDelta"),
        (sp.gamma(symbol("x")), "holds gamma"),
        (sp.Function("f")(symbol("x")).diff(symbol("x")), "holds f"),
        (sp.I * symbol("x"), "not real"),
        (sp.zoo * symbol("x"), "division by 0"),
        (sp.Integer(10) ** 400 * symbol("x"), "largest of floats"),
        (sp.Integer(10) ** 9000 * symbol("x"), "largest of floats"),
        (sp.Integral(sp.exp(symbol("x") ** 2), (symbol("x"), 0, symbol("x"))), "numerical form"),
    ],
)
def test_formulas_without_a_number_are_refused(expression, message, flavour):
    with pytest.raises(SystemDefinitionError, match=message):
        compile_function((symbol("x"),), [expression], flavour)


def test_a_symbol_is_one_argument():
    with pytest.raises(SystemDefinitionError, match="stands for two arguments"):
        compile_function((symbol("x"), symbol("x")), [symbol("x")], "floats")


@given(
    st.lists(st.tuples(st.integers(0, 2), st.floats(-3.0, 3.0)), min_size=1, max_size=12),
    st.booleans(),
)
@settings(max_examples=40)
def test_arrays_that_change_in_place_are_read_anew(changes, views):
    x, y = symbol("x"), symbol("y")
    read = compile_function((x, y), [sp.sin(x) + sp.cos(y), sp.cos(x)], "arrays")
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
    x, y = symbol("x"), symbol("y")
    read = compile_function((x, y), [sp.sin(x), sp.cos(y)], "arrays")
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
    x, y = sp.symbols("x y", real=True)
    hidden = sp.Dummy("x", real=True)
    expressions = [
        sp.sin(x * y) ** 3 / 7,
        sp.sqrt(x**2 + y**2),
        sp.erf(hidden) + x,
        sp.Rational(1, 3),
    ]
    pieces = [sp.Piecewise((sp.log(x), x > 0), (1 / y, True))]
    functions = [
        compile_function((x, y), [e.subs(hidden, y) for e in expressions], "floats"),
        compile_function((x, hidden), expressions[2:], "arrays"),
        compile_function((x, y), pieces, "floats"),
    ]
    pickled = pickle.dumps(functions)
    for copies in (pickle.loads(pickled), copy.deepcopy(functions)):
        for function, other in zip(functions, copies, strict=True):
            assert other(0.3, 0.7) == function(0.3, 0.7)
    # There no function is at hand, and hashes of symbols are others.
    script = NEW_PROCESS.format(path=sys.path, pickled=pickled)
    told = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert told.stdout.strip() == str(
        [[float(value).hex() for value in function(0.3, 0.7)] for function in functions]
    )


def test_unpickling_a_function_reads_no_text_as_code():
    x = sp.Symbol("__import__('os').abort()")
    function = compile_function((x,), [x + 1], "floats")
    assert pickle.loads(pickle.dumps(function))(1.0) == (2.0,)


def test_functions_that_go_to_a_cluster_know_when_arrays_are_outdated():
    x = sp.Symbol("x", real=True)
    function = compile_function((x,), [sp.sin(x)], "arrays")
    # By cloudpickle generated code goes along as it is.
    other = pickle.loads(cloudpickle.dumps(function))
    for value in (0.3, 0.4):
        (at,) = settled((np.full(2, value),), (2,))
        assert other(at)[0] is function(at)[0]
        np.testing.assert_array_equal(other(at)[0], np.sin([value, value]))
