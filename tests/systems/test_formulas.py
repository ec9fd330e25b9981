"""The formulas of docstrings, which pages show, are those that are simulated."""

from __future__ import annotations

import inspect
import re

import numpy as np
import pytest
import sympy as sp
from sympy.parsing.sympy_parser import (
    convert_xor,
    implicit_multiplication,
    parse_expr,
    standard_transformations,
)

from safe_envs.problem.signals import TIME
from safe_envs.registry import env_class, make_problem

CONSTANTS = {
    "DubinsDisk": "r=1",
    "DubinsObstacle": "r_O=.5",
    "DubinsReach": "r_O=.4",
    "StochasticDubins": "r=3",
    "QuadrotorAltitude": "c=5 p=2 z_ref=5+2.5*sin(t)",
    "Quadrotor": "c=5 p=2 z_ref=5+2.5*sin(t)",
    "QuadrotorLimits": "z_ref=5+2.5*sin(t) x_ref=2*sin(1.5*t) z_min=3 z_max=7 a=.5",
    "ACC": "tau=1.8",
    "ACCGap": "D=10",
    "Pendulum": "c=.2",
    "CubicSDE": "offset=1",
    "CubicSDEDisk": "r=1",
    "Scalar": "limit=1",
}
"""What the letters of the formulas stand for, as the docstrings say."""

WITH_REWARD = set(CONSTANTS) - {"DubinsObstacle", "DubinsReach"}
CIRCLE = "d=sqrt((x-r/2)**2+y**2) R=.75*r a=theta-atan2(y,x-r/2)-pi/2"


def section(name: str, heading: str) -> str:
    text = inspect.getdoc(env_class(f"safe_envs/{name}-v0")) or ""
    return text.split(f"## {heading}\n")[1].split("\n## ")[0]


def formula_in(name: str, text: str, constants: str) -> sp.Expr:
    """Return a formula of a docstring with numbers for its constants."""
    transformations = (*standard_transformations, convert_xor, implicit_multiplication)

    def parsed(formula: str) -> sp.Expr:
        words = set(re.findall(r"[A-Za-z]\w*", formula)) - {"sin", "cos", "exp", "sqrt", "atan2"}
        known = {word: sp.Symbol(word, real=True) for word in words - {"pi"}}
        return parse_expr(formula, known | {"t": TIME}, transformations)

    expression = parsed(text)
    for word, _, value in (part.partition("=") for part in constants.split()):
        expression = expression.subs(sp.Symbol(word, real=True), parsed(value))
    return expression


def assert_same(first: sp.Expr, second: sp.Expr) -> None:
    symbols = sorted(first.free_symbols | second.free_symbols, key=str)
    points = np.random.default_rng(0).uniform(0.1, 2.0, (5, len(symbols)))
    for point in points:
        at = dict(zip(symbols, point.tolist(), strict=True))
        a, b = (float(expression.subs(at)) for expression in (first, second))
        assert a == pytest.approx(b, rel=1e-9, abs=1e-9)


def displayed(text: str) -> str:
    (found,) = re.findall(r"\$\$(.*?)\$\$", text)
    return found.partition("=")[2] or found


@pytest.mark.parametrize("name", sorted(set(CONSTANTS) - {"QuadrotorLimits"}))
def test_barrier_of_the_docstring_is_that_of_the_problem(name: str):
    stated = formula_in(name, displayed(section(name, "Barrier")), CONSTANTS[name])
    assert_same(stated, make_problem(f"{name}-v0").barriers[0].expression)


def test_barriers_of_a_table_are_those_of_the_problem():
    rows = re.findall(r"^\| `(\w+)` \| \$(.*?)\$", section("QuadrotorLimits", "Barrier"), re.M)
    barriers = make_problem("QuadrotorLimits-v0").barriers
    assert [name for name, _ in rows] == [barrier.name for barrier in barriers]
    for (_, formula), barrier in zip(rows, barriers, strict=True):
        stated = formula_in("QuadrotorLimits", formula, CONSTANTS["QuadrotorLimits"])
        assert_same(stated, barrier.expression)


def test_barriers_of_several_obstacles_are_those_of_the_problem():
    formula = displayed(section("DubinsObstacles", "Barrier"))
    problem = make_problem("DubinsObstacles-v0", num_obstacles=1)
    stated = formula_in("DubinsObstacles", formula, "r_O=.4")
    x, y = sp.symbols("x y", real=True)
    center = [sp.Symbol(f"{c}_i", real=True) for c in "xy"]
    # The centre is where both partial derivatives vanish.
    (barrier,) = problem.barriers
    there = sp.solve([barrier.expression.diff(c) for c in (x, y)], [x, y], dict=True)[0]
    assert_same(
        stated.subs(dict(zip(center, (there[x], there[y]), strict=True))), barrier.expression
    )


@pytest.mark.parametrize("name", sorted(WITH_REWARD))
def test_reward_of_the_docstring_is_that_of_the_problem(name: str):
    problem = make_problem(f"{name}-v0")
    constants = CONSTANTS[name]
    if "Dubins" in name:
        constants = f"{CIRCLE} {constants}"
    if name == "CubicSDEDisk":
        constants = f"h=r**2-x_1**2-x_2**2 {constants}"
    stated = formula_in(name, displayed(section(name, "Reward")), constants)
    assert_same(stated, problem.reward)
