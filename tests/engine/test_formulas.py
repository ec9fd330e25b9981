"""Formulas in programs: the numbers of `compile_function`, as plain Python and compiled."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import sympy as sp

from safe_envs.dynamics.codegen import SUPPORTED, compile_function
from safe_envs.engine.formulas import Source, formula_max, formula_min, formulas
from safe_envs.engine.program import Program
from safe_envs.engine.slots import Data
from safe_envs.errors import SystemDefinitionError
from tests.engine import kernels

x, y, t = sp.symbols("x y t", real=True)
POINTS = [(0.3, 1.7, 0.5), (0.9, 1.1, 2.0), (0.2, 2.9, -1.0)]


def program(expressions: list, data: Data) -> Program:
    source = formulas("values_of", {"values": (x, y), "time": t}, expressions, data)
    values = "values_of((values[0], values[1]), values[2], values[3:])"
    call = f"def reward_of(values):\n    return {values}[0]\n"
    return Program("formulas", [kernels.read], source + Source(call))


def read(functions: dict, data: Data, point: tuple) -> float:
    return functions["read"](np.array([*point, *data.array()]))


def applied(function: type) -> list:
    """Expressions of a function with arguments in its domain, and with numbers of every kind."""
    if function is sp.Piecewise:
        return [sp.Piecewise((x / 3, x < 0.5), (sp.sqrt(y), sp.And(x < 0.7, t > 0)), (t, True))]
    two = function in (sp.atan2, sp.Mod)
    beyond = function in (sp.acosh, sp.asec, sp.acsc)
    first = function(x, y) if two else function(y if beyond else x)
    return [first * 2 + sp.Rational(1, 3) * y**3 + sp.Float(0.1) * t * first**2 + sp.pi]


EXPRESSIONS = [
    *(e for function in SUPPORTED for e in applied(function)),
    sp.Max(x, y, t) + sp.Min(x * y, t),
    x**9 + y**-3 + (1 + t**2) ** sp.Rational(-3, 2) + x**y,
    sp.Integer(10) ** 30 * x + sp.Integer(2) ** 40,
    sp.Integer(3),
]


WAYS = pytest.mark.parametrize(
    "functions_of",
    [Program.plain, pytest.param(Program.compiled, marks=pytest.mark.oracle)],
    ids=["plain", "compiled"],
)


@WAYS
def test_programs_compute_formulas(functions_of: Callable) -> None:
    for expression in EXPRESSIONS:
        data = Data()
        functions = functions_of(program([expression], data))
        expected = compile_function((x, y, t), [expression], "floats")
        for point in POINTS:
            assert read(functions, data, point) == pytest.approx(expected(*point)[0], rel=1e-14)


def test_numbers_are_data_and_not_text() -> None:
    found = []
    for number in (0.5, 12.25):
        data = Data()
        text = program([sp.Float(number) * sp.sin(x) + sp.Float(number + 1) * y], data).text
        found.append((text, data.array().tolist()))
    assert found[0][0] == found[1][0]
    assert sorted(found[0][1]) == [0.5, 1.5]
    assert sorted(found[1][1]) == [12.25, 13.25]


def test_what_has_no_number_is_refused_as_elsewhere() -> None:
    for expression in (sp.gamma(x), x + sp.Symbol("z"), sp.I * x):
        with pytest.raises(SystemDefinitionError):
            formulas("f", {"values": (x, y)}, [expression], Data())


def test_nan_remains_nan() -> None:
    for expression in (sp.Max(t, x - y), sp.Min(t, x - y), sp.sign(x - y)):
        data = Data()
        functions = program([expression], data).plain()
        with np.errstate(invalid="ignore"):
            assert math.isnan(read(functions, data, (math.inf, math.inf, 1.0)))
        at = {x: 1, y: 2, t: 1}
        assert read(functions, data, (1.0, 2.0, 1.0)) == float(expression.subs(at))
    for kernel, plain in ((formula_max, max), (formula_min, min)):
        assert math.isnan(kernel(math.nan, 1.0))
        assert math.isnan(kernel(1.0, math.nan))
        assert kernel(2.0, 1.0) == kernel(1.0, 2.0) == plain(1.0, 2.0)


@WAYS
def test_whole_numbers_have_no_largest_one(functions_of: Callable) -> None:
    data = Data()
    functions = functions_of(program([sp.floor(x) - 2 * sp.ceiling(y)], data))
    for value in (1e30, -1e19, 2.5, -2.5, 0.0, -7.0, math.inf):
        found = read(functions, data, (value, 0.5, 0.0))
        assert found == np.floor(value) - 2.0
