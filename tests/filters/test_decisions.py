"""Decisions for one state, for a batch, and in a program are the same."""

from __future__ import annotations

import itertools
from contextlib import suppress
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, InvalidInputError, NumericalError, RelativeDegreeError
from safe_envs.engine.slots import Data
from safe_envs.errors import NotCompilableError
from safe_envs.filters.decision_source import filter_source
from safe_envs.wrappers import (
    CBF,
    DDSCBF,
    BayesianSCBF,
    LearnedHOCBF,
    SafetyFilter,
    SafetyFilterVectorWrapper,
    parse_conditions,
)
from tests.conftest import problem_of
from tests.oracles.filter_cases import (
    CASES,
    KINDS,
    Corrected,
    case_of,
    check,
    integrators,
    situations,
)
from tests.oracles.programs import decision_of
from tests.wrappers.learned import Terms

x, y, u, v = sp.symbols("x y u v", real=True)
CONDITIONS = (
    "cbf",
    "ecbf",
    "hocbf",
    "hocbf:sampling_margin=first-order",
    "rcbf",
    "srcbf:form=log",
    "szcbf",
    "scbf",
    "scbf:sampling_margin=first-order",
)
OPTIONS = (
    {},
    {"knowledge": "plant", "priorities": (1.0, 5.0, 0.2, 3.0, 2.0)},
    {"objective": "clf"},
)


def test_a_filter_of_every_id(env_id: str) -> None:
    problem = problem_of(env_id)
    safety_filter = SafetyFilter.for_problem(problem, parse_conditions("scbf", problem))
    found = check(safety_filter, *situations(problem, 500))
    assert "met" in found
    assert len(found) > 1


def test_decisions_on_the_way_of_a_filtered_quadrotor() -> None:
    env_id = "safe_envs/QuadrotorLimits-v0"
    problem = problem_of(env_id)
    safety_filter = SafetyFilter.for_problem(problem, parse_conditions("hocbf", problem))
    env: Any = SafetyFilterVectorWrapper(gym.make_vec(env_id, num_envs=10, noise=0.1), "hocbf")
    env.reset(seed=0)
    rng, states, inputs = np.random.default_rng(0), [], []
    low, high = np.array(problem.input_bounds).T
    for _ in range(40):
        actions = np.clip(rng.normal(0.1, 0.7, env.action_space.shape), -1.0, 1.0)
        states.append(np.array(env.unwrapped.state))
        inputs.append(low + (high - low) * (actions + 1.0) / 2.0)
        env.step(actions.astype(np.float32))
    found = check(safety_filter, np.concatenate(states), np.concatenate(inputs), most=25)
    assert found >= {"idle", "met"}


@pytest.mark.oracle
def test_every_filter_of_every_id(env_id: str) -> None:
    problem = problem_of(env_id)
    states, inputs = situations(problem, 2000)
    found = set()
    for condition, options in itertools.product(CONDITIONS, OPTIONS):
        given: dict[str, Any] = dict(options)
        if "priorities" in given:
            given["priorities"] = given["priorities"][: len(problem.barriers)]
        if "objective" not in given or problem.clf is not None:
            with suppress(RelativeDegreeError):
                conditions = parse_conditions(condition, problem)
                made = SafetyFilter.for_problem(problem, conditions, **given)
                found |= check(made, states, inputs, most=40)
    assert found == KINDS


@pytest.mark.oracle
def test_a_compiled_filter_of_every_id(env_id: str) -> None:
    problem = problem_of(env_id)
    safety_filter = SafetyFilter.for_problem(problem, parse_conditions("scbf", problem))
    check(safety_filter, *situations(problem, 2000), most=500, compiled=True)


@pytest.mark.parametrize("name", CASES)
def test_everything_that_a_filter_may_have(name: str) -> None:
    assert check(*case_of(name), most=8) == KINDS


@pytest.mark.oracle
@pytest.mark.parametrize("name", ["goal of several", "several learned", "planes above"])
def test_everything_compiled(name: str) -> None:
    assert check(*case_of(name), most=200, compiled=True) == KINDS


@pytest.mark.parametrize("name", CASES)
def test_numbers_that_are_not_finite_are_reported(name: str) -> None:
    safety_filter, states, inputs = case_of(name)
    decide = decision_of(safety_filter)
    far, nothing = np.full_like(states[0], 1e200), np.full_like(inputs[0], np.nan)
    for state, proposal, error in (
        (far, inputs[0], NumericalError),
        (states[0], nothing, InvalidInputError),
    ):
        for given in ((state, proposal), (state[None], proposal[None])):
            with pytest.raises(error):
                safety_filter.filter(*given)
        assert not decide(state, proposal).sound


@pytest.mark.parametrize(
    ("problem", "learned", "condition"),
    [
        ("disk", "residual", LearnedHOCBF),
        ("top", "network", DDSCBF),
        pytest.param("gap", "diffusion", DDSCBF, marks=pytest.mark.oracle),
        pytest.param("cubic", "posterior", BayesianSCBF, marks=pytest.mark.oracle),
    ],
)
def test_learned_filters(problem: str, learned: str, condition: Any, request) -> None:
    tried, model = request.getfixturevalue(problem), request.getfixturevalue(learned)
    settings = {"confidence": 0.9} if condition is BayesianSCBF else {}
    found = condition.from_learned(model, tried.gains_of(0), **settings)
    safety_filter = SafetyFilter.for_problem(tried, found)
    assert check(safety_filter, *situations(tried, 500), most=8) >= {"idle", "met"}


def test_learned_terms_without_a_compiled_form_are_refused() -> None:
    class Elsewhere(type(CASES["learned"][1][0][1].learned)):
        """Computes otherwise than the class whose `source` it has."""

        def floats(self, x: Any) -> list[float]:
            return [0.0 for _ in self.symbols]

    system = integrators(1)
    for terms in (
        Terms(system, 1, [sp.Integer(1), x]),
        Elsewhere(system, [sp.Integer(1), x]),
    ):
        made = SafetyFilter(system, [(1 - x, Corrected(1.0, learned=terms))], None, (-1, 1))
        with pytest.raises(NotCompilableError, match=type(terms).__name__):
            filter_source(made.qp, Data())


def test_without_a_filter_every_input_passes() -> None:
    found = decision_of(2)([1.0], [0.3, 7.0])
    assert found.action.tolist() == found.proposed.tolist() == [0.3, 7.0]
    assert (found.active, found.feasible, found.sound) == (False, True, True)


def test_what_no_input_changes_is_the_cause_where_nothing_else_acts() -> None:
    system = ControlAffineSDE((x, y), (u, v), [0, 0], np.eye(2, dtype=int), [0, 0])
    barriers = [9 + y, -1 - x**2, -2 - x**2]
    # Flat and met; two flat and unmet; with a steep one that acts; all of them steep.
    states = np.array([[0.0, 0.0], [0.0, 1.0], [0.0, -8.5], [0.5, 0.0]])
    inputs = np.array([[1.0, 1.0], [0.0, 0.0], [0.0, -1.0], [0.0, 0.0]])
    for conditions in ("cbf", ["srcbf" if i == 0 else "cbf" for i in range(3)]):
        safety_filter = SafetyFilter(system, barriers, conditions, (-1, 1))
        found, decide = safety_filter.filter(states, inputs), decision_of(safety_filter)
        assert found.active[:, 1:].all()
        wanted = [1, 1, 0 if found.active[2, 0] else 1, 2]
        assert found.cause.tolist() == wanted
        assert isinstance(conditions, list) or found.active[2, 0]
        ones = list(zip(states, inputs, strict=True))
        assert [safety_filter.filter(*each).cause for each in ones] == wanted
        assert [decide(*each).cause for each in ones] == wanted


def test_weights_count_in_the_distance_of_a_cause() -> None:
    # From (1, 1) both constraints are .5 away, of which an input that is cheap to move makes less.
    system = ControlAffineSDE((x, y), (u, v), [0, 0], np.eye(2, dtype=int), [0, 0])
    for weights, cause in (((1.0, 9.0), 1), ((9.0, 1.0), 0)):
        made = SafetyFilter(system, [0.5 - x, 0.5 - y], CBF(1.0), (-2, 2), weights)
        for state, proposal in (([0, 0], [1, 1]), ([[0, 0]], [[1, 1]])):
            assert np.all(made.filter(state, proposal).cause == cause)
        assert decision_of(made)([0, 0], [1, 1]).cause == cause


def test_a_plane_above_a_root_is_above_it_where_bounds_hold_an_input() -> None:
    # The faces of an input that its bounds hold are equal but for rounding, which is no slope.
    safety_filter, states, inputs = case_of("plane above")
    (c,), form = safety_filter.constraints, np.array([[0.1, 0, 0], [0, 0.2, 0.1], [0, 0.1, 0.2]])
    row = sp.lambdify(safety_filter.model.states, [*c.coefficient, c.offset])
    low = np.random.default_rng(7).uniform(-1.0, 0.5, inputs.shape)
    bounds = np.stack([low, low + np.array([1.0, 0.0])], axis=-1)
    found = safety_filter.filter(states, inputs, input_bounds=bounds)
    assert 20 < found.feasible.sum() < len(states)
    for state, action, feasible in zip(states, found.action, found.feasible, strict=True):
        whole = np.array([1.0, *action])
        *slopes, offset = row(*state)
        if feasible:
            assert np.dot(slopes, action) + offset >= np.sqrt(whole @ form @ whole) - 1e-12


def test_many_inputs_take_no_more_memory_than_their_constraints() -> None:
    # Uncertain constraints need all corners of the bounds, of which 40 inputs have 1e12.
    states, given = sp.symbols("x:40", real=True), sp.symbols("u:40", real=True)
    system = ControlAffineSDE(states, given, [0] * 40, sp.eye(40).tolist(), [0] * 40)
    made = SafetyFilter(system, [1 - states[0], 2 + sum(states)], "cbf", (-1, 1))
    found = made.filter(np.full(40, 0.9), np.ones(40))
    assert found.feasible
    np.testing.assert_allclose(found.action, [0.1] + [1.0] * 39)


def test_large_proposals_whose_sum_overflows_are_proposals() -> None:
    system = ControlAffineSDE((x, y), (u, v), [0, 0], np.eye(2, dtype=int), [0, 0])
    made = SafetyFilter(system, [0.5 - x, 0.5 - y], "cbf", (-2, 2))
    for state, proposal in (([0, 0], [1.7e308] * 2), ([[0, 0]], [[1.7e308] * 2])):
        np.testing.assert_allclose(np.ravel(made.filter(state, proposal).action), 0.5)
