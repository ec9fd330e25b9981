"""Named sets of a problem: `safe`, `goal` and regions."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, SafetyProblem
from safe_envs.errors import ConfigurationError, NumericalError, SystemDefinitionError
from safe_envs.problem.builder import define_problem
from safe_envs.problem.named_sets import NamedSets, set_expressions, set_names
from tests.conftest import problem_of

x, y, u, k = sp.symbols("x y u k", real=True)
SYSTEM = ControlAffineSDE((x, y), (u,), [y, -k * x], [0, 1], [[0], [0]], {k: 2.0})


def own_problem(**rest) -> SafetyProblem:
    return define_problem(
        SYSTEM,
        [1 - y, 1 + y],
        input_bounds=(-1.0, 1.0),
        start=[0.0, 0.0],
        dt=0.1,
        horizon=1.0,
        **rest,
    )


def test_sets_of_an_own_problem() -> None:
    problem = own_problem(goal=x - 1, regions={"gate": 0.25 - x**2, "left": -x})
    assert set_names(problem) == ("safe", "goal", "gate", "left")
    assert set_names(own_problem()) == ("safe",)
    assert set_expressions(problem, "safe") == (1 - y, 1 + y)
    sets = NamedSets(problem, ("gate", "safe", "goal"))
    states = (np.array([0.5, 0.0, 2.0]), np.array([0.5, -1.0, 3.0]))
    values = sets.values(states)
    np.testing.assert_allclose(values, [[0, 0.25, -3.75], [0.5, 0, -2], [-0.5, -1, 1]])
    # At its edge a state is in a region, and not in the safe set.
    expected = [[True, True, False], [True, False, False], [False, False, True]]
    assert sets.inside(values).tolist() == expected


def test_regions_outlive_other_numbers_and_pickle() -> None:
    problem = own_problem(regions={"gate": 0.25 - x**2}).configured(dt=0.05, plant={"k": 3.0})
    assert dict(problem.regions) == {"gate": 0.25 - x**2}
    assert pickle.loads(pickle.dumps(problem)).regions == problem.regions


@pytest.mark.parametrize(
    ("regions", "message"),
    [
        *(({name: x}, "region is named") for name in ("safe", "goal", "until", "not", "2nd")),
        *(({name: x}, "region is named") for name in ("a b", "", "ä", 3)),
        ({"gate": "x > 0"}, "region gate is a text"),
        ({"gate": x > 0}, "true or false"),
        ({"gate": sp.Symbol("x")}, "region gate uses the unknown symbol x"),
        ({"gate": k * x}, "region gate uses the unknown symbol k"),
        ([x], "give a mapping"),
        ({f"r{i}": x for i in range(21)}, "up to 20 names"),
    ],
)
def test_regions_are_expressions_of_the_states_with_names_for_specifications(
    regions: object, message: str
) -> None:
    with pytest.raises(SystemDefinitionError, match=message):
        own_problem(regions=regions)


@pytest.mark.parametrize(
    ("parts", "name", "message"),
    [
        ({"regions": {"gate": x}}, "gat", "no set 'gat'; did you mean 'gate'"),
        ({}, "goal", "no set 'goal'; allowed: safe"),
        ({"goal": x - u}, "goal", "goal of problem depends on u"),
    ],
)
def test_sets_that_are_not_there_are_refused(parts, name, message) -> None:
    for read in (set_expressions, lambda problem, name: NamedSets(problem, [name])):
        with pytest.raises(ConfigurationError, match=message):
            read(own_problem(**parts), name)


def test_a_set_without_a_value_is_reported() -> None:
    sets = NamedSets(own_problem(regions={"gate": sp.sqrt(x)}), ["safe", "gate"])
    with pytest.raises(NumericalError, match=r"the set 'gate' of problem has no value .*\[-1.0, 2"):
        sets.values((np.array([1.0, -1.0]), np.array([1.0, 2.0])))


def test_registered_problem_with_a_region() -> None:
    problem = problem_of("safe_envs/DubinsReach-v0")
    assert set_names(problem) == ("safe", "goal", "gate")
    at = tuple(np.array([c]) for c in (-0.6, 1.1, 0.0, 0.0, -1.2))
    safe, goal, gate = NamedSets(problem, set_names(problem)).values(at)[:, 0]
    assert safe == pytest.approx(0.36 + 2.3**2 - 0.16)
    assert goal == pytest.approx(0.09 - 4.0 - 0.01)
    assert gate == pytest.approx(0.16)
