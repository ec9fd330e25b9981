"""What a filter is made of: every form of it is read, and what is wrong is told."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import sympy as sp

import safe_envs
from safe_envs import (
    CLF,
    Barrier,
    ConfigurationError,
    ControlAffineSDE,
    RelativeDegreeError,
    SafeEnvsError,
    SystemDefinitionError,
)
from safe_envs.filters.arguments import WIDEST
from safe_envs.wrappers import CBF, HOCBF, RCBF, SCBF, SZCBF, SafetyFilter
from tests.conftest import problem_of

x, v, y, u, w, p = sp.symbols("x v y u w p", real=True)
mass = sp.Symbol("mass", positive=True)
H = 1 - x**2


def mass_point(noise: float = 0.0) -> ControlAffineSDE:
    """A point with a mass: relative degree 2 for positions, 1 for speeds."""
    return ControlAffineSDE(
        (x, v), (u,), [v, 0], [[0], [1 / mass]], [[0], [noise]], parameters={mass: 2.0}
    )


def plane() -> ControlAffineSDE:
    return ControlAffineSDE((x, y), (u, w), [0, 0], [[1, 0], [0, 1]], [0, 0])


def conditions_of(barriers: Any, conditions: Any, noise: float = 0.0) -> list[Any]:
    return [c for _, c in SafetyFilter(mass_point(noise), barriers, conditions, (-5, 5)).pairs]


def test_barriers_and_conditions_come_in_every_form():
    two = HOCBF((2.0, 8.0))
    assert conditions_of(H, "hocbf:alpha=2,8") == [two]
    assert conditions_of(Barrier(H), two) == [two]
    assert conditions_of([H, H], two) == [two, two]
    assert conditions_of((H, 1 - v), "hocbf:alpha=2,8+cbf:alpha=3") == [two, CBF(3.0)]
    assert conditions_of([H, 1 - v], ["hocbf:alpha=2,8", CBF(3.0)]) == [two, CBF(3.0)]
    assert conditions_of([(H, two), (Barrier(1 - v), "cbf:alpha=3")], None) == [two, CBF(3.0)]
    assert conditions_of((H, two), None) == [two]


def test_rates_that_are_not_named_are_ones_for_each_relative_degree():
    assert conditions_of([H, 1 - v], "hocbf") == [HOCBF((1.0, 1.0)), HOCBF((1.0,))]
    assert conditions_of(H, "szcbf:sampling_margin=.5", noise=1.0) == [
        SZCBF((1.0, 1.0), sampling_margin=0.5)
    ]
    assert conditions_of(H, None) == [HOCBF((1.0, 1.0))]
    assert conditions_of([H, 1 - v], None, noise=1.0) == [SZCBF((1.0, 1.0)), SZCBF((1.0,))]
    # The noise gives the curved barrier its input an order later than the drift does.
    curved = ControlAffineSDE((x, v), (u,), [v, 0], [[0], [1]], [[x], [1]])
    assert SafetyFilter(curved, H, "scbf", (-1, 1)).pairs[0][1] == SCBF()


def test_barriers_are_named_one_by_one():
    found = SafetyFilter(mass_point(), [H, Barrier(1 - v, "speed")], "hocbf", (-5, 5))
    assert [barrier.name for barrier, _ in found.pairs] == ["h_1", "speed"]


def test_conditions_of_a_users_file(tmp_path):
    path = tmp_path / "eager.py"
    path.write_text(
        "from dataclasses import dataclass\n"
        "from safe_envs.wrappers import HOCBF\n\n\n"
        "@dataclass(frozen=True)\nclass Eager(HOCBF):\n    name = 'eager'\n"
    )
    (found,) = conditions_of(H, f"{path}:Eager:alpha=3,4")
    assert (found.name, found.alpha) == ("eager", (3.0, 4.0))


def test_the_filter_is_a_name_of_the_package():
    assert safe_envs.SafetyFilter is SafetyFilter


@pytest.mark.parametrize(
    ("bounds", "low", "high"),
    [
        ((-5, 5), [-5.0, -5.0], [5.0, 5.0]),
        ([(-1, 2), (-3, 4)], [-1.0, -3.0], [2.0, 4.0]),
        (np.array([[0.0, 1.0], [0.0, math.inf]]), [0.0, 0.0], [1.0, WIDEST]),
        ((-math.inf, math.inf), [-WIDEST] * 2, [WIDEST] * 2),
    ],
)
def test_bounds_are_one_pair_for_all_inputs_or_one_for_each(bounds, low, high):
    qp = SafetyFilter(plane(), 1 - x - y, "cbf", bounds).qp
    assert (qp.low, qp.high) == (tuple(low), tuple(high))
    assert {type(each) for each in (qp.weights, qp.priorities)} == {tuple}


ENDLESS = (-math.inf, 1.0)


@pytest.mark.parametrize(
    ("changes", "advice"),
    [
        ({"system": H}, "give a ControlAffineSDE"),
        ({"barriers": []}, "barriers is empty"),
        ({"barriers": "1 - x**2"}, "text"),
        ({"barriers": H > 0}, "expression"),
        ({"barriers": None}, "a barrier is NoneType"),
        ({"barriers": 1 - y}, "symbol y"),
        ({"barriers": 1 - mass * x}, "mass"),
        ({"barriers": sp.Integer(1)}, "no relative degree"),
        ({"barriers": [(H, HOCBF()), H]}, "pairs"),
        ({"barriers": [(H, HOCBF())]}, "pairs"),
        ({"barriers": [(H, HOCBF())], "filters": [(-5, 5)]}, "input_bounds="),
        ({"box": (-5, 5)}, "'box'.*input_bounds"),
        ({"weight": [1.0]}, "'weights'"),
        ({"filters": "hocbff"}, "did you mean 'hocbf'"),
        ({"filters": "hocbf:alpha=1,2,3"}, "degree 2"),
        ({"filters": "hocbf+hocbf"}, "2 conditions"),
        ({"filters": "promise"}, "promise"),
        ({"filters": "certified"}, "SafetyFilter.for_problem"),
        ({"filters": "ddscbf:file=model.npz"}, "SafetyFilter.for_problem"),
        ({"filters": [HOCBF()] * 2}, "2 conditions"),
        ({"filters": [(-5.0, 5.0)]}, "bounds="),
        ({"filters": 3j}, "give a Condition"),
        ({"input_bounds": None}, r"give \(low, high\)"),
        ({"input_bounds": ("-5", "5")}, r"give \(low, high\)"),
        ({"input_bounds": [(-5, 5)] * 2}, "each of the 1"),
        ({"input_bounds": (5, -5)}, "u.*lower"),
        ({"input_bounds": (math.inf, math.inf)}, "u.*lower"),
        ({"input_bounds": (0, 1e200)}, "within 1e\\+100"),
        ({"input_bounds": ENDLESS, "clf": CLF(x**2)}, "needs finite ones"),
        ({"input_bounds": ENDLESS, "barriers": 1 - v, "filters": RCBF()}, "needs finite ones"),
        ({"weights": "heavy"}, "give 1 positive numbers"),
        ({"priorities": [-1.0]}, "give 1 positive numbers"),
        ({"weights": [1.0], "clf": CLF(x**2)}, "weights and clf"),
        ({"clf": x**2}, r"give a CLF\(V\)"),
        ({"clf": CLF((x - y) ** 2)}, "symbol y"),
        ({"dt": "fast"}, "dt = 'fast'"),
        ({"filters": HOCBF((1.0, 1.0), sampling_margin="first-order")}, "dt="),
        ({"adjustable": ["weight"]}, "weight"),
        ({"adjustable": x}, "no parameter of the system"),
    ],
)
def test_what_is_wrong_is_told(changes, advice):
    given = {"system": mass_point(), "barriers": H, "filters": "hocbf", "input_bounds": (-5, 5)}
    with pytest.raises(SafeEnvsError, match=advice):
        SafetyFilter(**{**given, **changes})


def test_a_symbol_of_which_more_than_a_sign_is_declared_is_not_adjustable():
    count = sp.Symbol("count", integer=True)
    system = ControlAffineSDE((x,), (u,), [0], [[1 / count]], [0], parameters={count: 2})
    with pytest.raises(ConfigurationError, match="more is declared of its symbol than a sign"):
        SafetyFilter(system, 1 - x, "cbf", (-1, 1), adjustable="count")


def test_a_barrier_that_no_input_reaches_has_no_default_rates():
    system = ControlAffineSDE((x, v), (u,), [0, 0], [[0], [1]], [[0], [0]])
    with pytest.raises(RelativeDegreeError, match="no input"):
        SafetyFilter(system, 1 - x, "hocbf", (-1, 1))


def test_problems_and_systems_have_a_call_of_their_own():
    problem = problem_of("safe_envs/Scalar-v0")
    with pytest.raises(SystemDefinitionError, match=r"SafetyFilter\.for_problem\(problem"):
        SafetyFilter(problem, 1 - x, "cbf", (-1, 1))  # pyright: ignore[reportArgumentType]
    with pytest.raises(SystemDefinitionError, match=r"SafetyFilter\(system, barriers"):
        SafetyFilter.for_problem(problem.model, "cbf")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ConfigurationError, match="did you mean 'model'"):
        SafetyFilter.for_problem(problem, "cbf", "modell")
    with pytest.raises(ConfigurationError, match=r"objective = .*allowed: nearest, clf"):
        SafetyFilter.for_problem(problem, "cbf", objective=np.zeros(2))  # pyright: ignore[reportArgumentType]
