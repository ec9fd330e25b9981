"""Formulas of docstrings, which pages show, and those that the thesis prints, are those that are
simulated."""

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

from safe_envs.dynamics.lie import generator, lie_derivative_f, lie_derivative_g
from safe_envs.problem.signals import TIME
from safe_envs.registry import env_class
from tests.conftest import problem_of

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


def parsed(formula: str) -> sp.Expr:
    """Read a formula as it is printed: without signs of multiplication, with ^ for powers."""
    transformations = (*standard_transformations, convert_xor, implicit_multiplication)
    words = set(re.findall(r"[A-Za-z]\w*", formula)) - {"sin", "cos", "exp", "sqrt", "atan2", "pi"}
    known = {word: sp.Symbol(word, real=True) for word in words}
    return parse_expr(formula, known | {"t": TIME}, transformations)


def formula_in(text: str, constants: str) -> sp.Expr:
    """Return a formula with expressions for the letters of constants."""
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
    stated = formula_in(displayed(section(name, "Barrier")), CONSTANTS[name])
    assert_same(stated, problem_of(f"safe_envs/{name}-v0").barriers[0].expression)


def test_barriers_of_a_table_are_those_of_the_problem():
    rows = re.findall(r"^\| `(\w+)` \| \$(.*?)\$", section("QuadrotorLimits", "Barrier"), re.M)
    barriers = problem_of("safe_envs/QuadrotorLimits-v0").barriers
    assert [name for name, _ in rows] == [barrier.name for barrier in barriers]
    for (_, formula), barrier in zip(rows, barriers, strict=True):
        assert_same(formula_in(formula, CONSTANTS["QuadrotorLimits"]), barrier.expression)


def test_barriers_of_several_obstacles_are_those_of_the_problem():
    formula = displayed(section("DubinsObstacles", "Barrier"))
    (barrier,) = problem_of("safe_envs/DubinsObstacles-v0", num_obstacles=1).barriers
    x, y = sp.symbols("x y", real=True)
    # The centre is where both partial derivatives vanish.
    (there,) = sp.solve([barrier.expression.diff(c) for c in (x, y)], [x, y], dict=True)
    stated = formula_in(formula, "r_O=.4")
    centre = {sp.Symbol(f"{c}_i", real=True): there[c] for c in (x, y)}
    assert_same(stated.subs(centre), barrier.expression)


@pytest.mark.parametrize("name", sorted(WITH_REWARD))
def test_reward_of_the_docstring_is_that_of_the_problem(name: str):
    constants = CONSTANTS[name]
    if "Dubins" in name:
        constants = f"{CIRCLE} {constants}"
    if name == "CubicSDEDisk":
        constants = f"h=r**2-x_1**2-x_2**2 {constants}"
    stated = formula_in(displayed(section(name, "Reward")), constants)
    assert_same(stated, problem_of(f"safe_envs/{name}-v0").reward)


DRAG = "(f_0 + f_1*v + f_2*v**2)/M"
PRINTED = {
    "DubinsDisk": {
        "L_f": "-2*v*(x*cos(theta) + y*sin(theta))",
        "L_f^2": "-2*v**2",
        "L_g L_f": "-2*v*(y*cos(theta) - x*sin(theta))",
    },
    # The print forgets the obstacle's velocity.
    "DubinsObstacle": {
        "L_f": "2*v*((x - x_o)*cos(theta) + (y - y_o)*sin(theta)) - 2*v_o*(x - x_o)",
        "L_f^2": "2*v**2 - 4*v*v_o*cos(theta) + 2*v_o**2",
    },
    # The print has another sign of g, and zdot for its square.
    "QuadrotorAltitude": {
        "L_f": "-4*(z - 5)**3*zdot/16",
        "L_f^2": "4*(z - 5)**3*g/16 - 12*(z - 5)**2*zdot**2/16",
        "L_g L_f": "-4*(z - 5)**3/(16*m)",
    },
    "Pendulum": {
        "L_f": "-(2*sqrt(3)*theta + 2*thetadot)*thetadot"
        "-(2*theta + 2*sqrt(3)*thetadot)*100/7*sin(theta)",
        "L_g": "-(2*theta + 2*sqrt(3)*thetadot)/.49",
        "A - L_f": "-sqrt(3)*(theta/10)**2",
    },
    "CubicSDE": {"A": ".6*x_1 + x_2 - 2*x_1**3*x_2 - (x_2/10)**2"},
    # The print has x_1 x_2 for 2 x_1 x_2, and sigma_2 twice.
    "CubicSDEDisk": {"A": "1.2*x_1**2 + 2*x_1*x_2 - 2*x_1**3*x_2 - .08"},
    "ACC": {
        "A": "x_2 - x_1 + 1.8*(f_0 + f_1*x_1 + f_2*x_1**2)/M",
        "L_g": "-1.8/M",
        "A - L_f": "0",
    },
    # Terms of the print are corrected.
    "ACCGap": {
        "A": "5*(z - 10)**4*(v_f - v) + 10*sigma_2**2*(z - 10)**3",
        "A^2": "20*(z - 10)**3*(v_f - v)**2 + 60*sigma_2**2*(z - 10)**2*(v_f - v)"
        f"+ 5*(z - 10)**4*{DRAG} + 30*sigma_2**4*(z - 10)",
        "L_g A": "-5*(z - 10)**4/M",
    },
    "Scalar": {"A": "-x"},
}
"""Derivatives of barriers as the thesis prints them, where it is right, and else as it should."""
ALONG = {"A": generator, "L_f": lie_derivative_f, "L_g": lambda *given: lie_derivative_g(*given)[0]}


def applied(operators: str, system, h: sp.Expr) -> sp.Expr:
    """Apply operators to a barrier, the last one first: `L_g L_f`, `A^2`."""
    for word in reversed(operators.split()):
        name, _, times = word.partition("^")
        for _ in range(int(times or 1)):
            h = ALONG[name](system, h)
    return h


@pytest.mark.parametrize(
    ("name", "operators"), [(name, key) for name, each in PRINTED.items() for key in each]
)
def test_derivatives_are_those_of_the_thesis(name: str, operators: str):
    problem = problem_of(f"safe_envs/{name}-v0")
    system, h = problem.model, problem.barriers[0].expression
    first, _, second = operators.partition(" - ")
    ours = applied(first, system, h) - (applied(second, system, h) if second else 0)
    values = {s.name: s for s in (*system.states, *system.parameters)}
    theirs = parsed(PRINTED[name][operators])
    theirs = theirs.xreplace({s: values[s.name] for s in theirs.free_symbols})
    assert_same(system.numeric(ours), system.numeric(theirs))
