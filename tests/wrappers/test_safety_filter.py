"""The safety filter without gym: exact, flagged, inside the box."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from safe_envs import (
    Barrier,
    ConfigurationError,
    ControlAffineSDE,
    InvalidInputError,
    NumericalError,
    SystemDefinitionError,
)
from safe_envs.wrappers import CBF, HOCBF, SCBF, SafetyFilter
from tests.conftest import problem_of

x, y, u, w = sp.symbols("x y u w", real=True)


def integrator(**changes):
    arguments = {
        "states": (x,),
        "inputs": (u,),
        "drift": [0],
        "input_matrix": [1],
        "diffusion": [0],
        **changes,
    }
    return ControlAffineSDE(**arguments)


def plane():
    """Two integrators with an input each."""
    return ControlAffineSDE((x, y), (u, w), [0, 0], [[1, 0], [0, 1]], [0, 0])


def test_nearest_action_of_a_scalar_system_in_closed_form():
    # h = 1 - x, x' = u: u <= alpha (1 - x).
    safety_filter = SafetyFilter(integrator(), [(Barrier(1 - x), CBF(2.0))], bounds=[(-3.0, 3.0)])
    for state, nominal, action, active in (
        (0.0, 1.0, 1.0, False),
        (0.0, 2.5, 2.0, True),
        (0.9, 1.0, 0.2, True),
        (0.9, -4.0, -3.0, False),
    ):
        result = safety_filter.filter(np.array([state]), np.array([nominal]))
        np.testing.assert_allclose(result.action, [action], atol=1e-12)
        assert result.active.tolist() == [active]
        assert result.feasible is True
        assert result.barrier[0] == pytest.approx(1 - state)
        assert result.margin[0] == pytest.approx(2 * (1 - state) - action, abs=1e-12)
        assert result.slack.tolist() == [0.0]


def test_infeasible_states_give_the_least_violating_action_with_its_slack():
    safety_filter = SafetyFilter(integrator(), [(Barrier(1 - x), CBF(1.0))], bounds=[(-3.0, 3.0)])
    result = safety_filter.filter(np.array([6.0]), np.array([1.0]))
    assert (result.action.tolist(), result.feasible, result.slack.tolist()) == (
        [-3.0],
        False,
        [2.0],
    )
    batch = safety_filter.filter(np.array([[6.0], [0.0]]), np.array([[1.0], [0.5]]))
    assert batch.action.tolist() == [[-3.0], [0.5]]
    assert batch.feasible.tolist() == [False, True]
    assert batch.slack.tolist() == [[2.0], [0.0]]


def test_quadrotor_filter_equals_a_search_over_its_four_inputs():
    problem = problem_of("safe_envs/Quadrotor-v0")
    safety_filter = SafetyFilter.for_problem(problem, HOCBF(problem.gains))
    rng = np.random.default_rng(0)
    state = np.zeros(12)
    state[[2, 5, 6, 7]] = [6.5, 1.3, 0.2, -0.1]
    low, high = np.array(problem.box).T
    nominal = rng.uniform(low, high)
    result = safety_filter.filter(state, nominal)
    assert result.active.all()
    assert result.feasible
    best = np.sum((result.action - nominal) ** 2)
    a, b = row_of(safety_filter, state)
    assert result.margin[0] == pytest.approx(b + a @ result.action, rel=1e-9)
    for scale in (1.0, 1e-1, 1e-2, 1e-3):
        tried = np.clip(
            result.action + scale * (high - low) * rng.normal(size=(20_000, 4)), low, high
        )
        allowed = tried[b + tried @ a >= 0]
        assert len(allowed)
        assert np.sum((allowed - nominal) ** 2, axis=1).min() >= best * (1 - 1e-9)


def row_of(safety_filter, state):
    model, (constraint,) = safety_filter.model, safety_filter.constraints
    values = dict(zip(model.states, state, strict=True))
    a = np.array([float(model.numeric(c).subs(values)) for c in constraint.coefficient])
    return a, float(model.numeric(constraint.offset).subs(values))


@pytest.mark.parametrize("name", ["StochasticDubins", "Quadrotor", "ACC", "CubicSDE"])
def test_batches_equal_single_states(name):
    problem = problem_of(f"safe_envs/{name}-v0")
    safety_filter = SafetyFilter.for_problem(problem, SCBF())
    rng = np.random.default_rng(1)
    low, high = np.array(problem.box).T
    states = rng.uniform(0.2, 1.5, (4, 3, problem.plant.n))
    inputs = rng.uniform(1.5 * low - 0.5 * high, 1.5 * high - 0.5 * low, (4, 3, problem.plant.m))
    batch = safety_filter.filter(states, inputs)
    assert batch.action.shape == inputs.shape
    assert batch.margin.shape == (4, 3, 1)
    assert batch.feasible.shape == (4, 3)
    for i in np.ndindex(4, 3):
        single = safety_filter.filter(states[i], inputs[i])
        for ours, theirs in zip(single, batch, strict=True):
            np.testing.assert_allclose(ours, theirs[i], rtol=1e-9, atol=1e-9)
        assert np.all((single.action >= low) & (single.action <= high))


def test_weights_decide_which_input_gives_way():
    rows = [(Barrier(1 - x - y), CBF(1.0))]
    even = SafetyFilter(plane(), rows, bounds=[(-5.0, 5.0)] * 2).filter(
        np.zeros(2), np.array([1.0, 1.0])
    )
    np.testing.assert_allclose(even.action, [0.5, 0.5])
    uneven = SafetyFilter(plane(), rows, bounds=[(-5.0, 5.0)] * 2, weights=[1.0, 9.0]).filter(
        np.zeros(2), np.array([1.0, 1.0])
    )
    np.testing.assert_allclose(uneven.action, [0.1, 0.9])


def test_several_barriers_with_conditions_of_their_own():
    chain = ControlAffineSDE((x, y), (u,), [y, 0], [0, 1], [0, 0])
    position, speed = Barrier(1 - x, "position"), Barrier(2 - y, "speed")
    safety_filter = SafetyFilter(
        chain, [(position, HOCBF((1.0, 1.0))), (speed, CBF(1.0))], bounds=[(-4.0, 4.0)]
    )
    # b_2 = -u - 2 y + (1 - x) >= 0 and -u + 2 - y >= 0.
    result = safety_filter.filter(np.array([0.0, 0.2]), np.array([3.0]))
    np.testing.assert_allclose(result.action, [0.6], atol=1e-7)
    assert result.active.tolist() == [True, False]
    np.testing.assert_allclose(result.barrier, [1.0, 1.8])
    result = safety_filter.filter(np.array([-9.0, 1.9]), np.array([3.0]))
    np.testing.assert_allclose(result.action, [0.1], atol=1e-7)
    assert result.active.tolist() == [False, True]
    result = safety_filter.filter(np.array([3.0, 3.0]), np.array([3.0]))
    np.testing.assert_allclose(result.action, [-4.0])
    assert result.feasible is False
    np.testing.assert_allclose(result.slack, [4.0, 0.0], atol=1e-7)
    batch = safety_filter.filter(np.array([[0.0, 0.2], [3.0, 3.0]]), np.array([[3.0], [3.0]]))
    np.testing.assert_allclose(batch.action, [[0.6], [-4.0]], atol=1e-7)
    assert batch.feasible.tolist() == [True, False]


@pytest.mark.parametrize(
    ("state", "nominal"),
    [
        ([np.nan], [0.0]),
        ([0.0], [np.nan]),
        ([0.0], [np.inf]),
        ([-np.inf], [0.0]),
        ([0.0, 0.0], [0.0]),
        ([0.0], [0.0, 0.0]),
        (0.0, [0.0]),
    ],
)
def test_inputs_that_are_none_are_errors(state, nominal):
    safety_filter = SafetyFilter(integrator(), [(Barrier(1 - x), CBF(1.0))], bounds=[(-1.0, 1.0)])
    with pytest.raises(InvalidInputError):
        safety_filter.filter(np.array(state), np.array(nominal))
    if np.ndim(state):
        with pytest.raises(InvalidInputError):
            safety_filter.filter(
                np.stack([np.zeros_like(state), state]), np.stack([np.zeros_like(nominal), nominal])
            )


@pytest.mark.parametrize("h", [sp.log(x), 1 / x, sp.sqrt(x) + 1])
def test_states_where_the_barrier_or_its_rate_has_no_value_are_not_safe(h):
    safety_filter = SafetyFilter(integrator(), [(Barrier(h), CBF(1.0))], bounds=[(-1.0, 1.0)])
    found = safety_filter.filter(np.array([0.0]), np.array([3.0]))
    assert (found.feasible, found.slack, found.action.tolist()) == (False, [np.inf], [1.0])
    found = safety_filter.filter(np.array([[1.0], [0.0]]), np.zeros((2, 1)))
    assert found.feasible.tolist() == [True, False]


def test_states_where_the_dynamics_have_no_value_are_errors():
    system = ControlAffineSDE((x,), (u,), [sp.log(x)], [1])
    safety_filter = SafetyFilter(system, [(Barrier(1 - x), CBF(1.0))], bounds=[(-1.0, 1.0)])
    with pytest.raises(NumericalError, match="no finite value at x = 0"):
        safety_filter.filter(np.array([0.0]), np.array([0.0]))
    with pytest.raises(NumericalError, match="no finite value at x = 0"):
        safety_filter.filter(np.array([[1.0], [0.0]]), np.zeros((2, 1)))


def test_construction_is_checked():
    rows = [(Barrier(1 - x), CBF(1.0))]
    for box in ([(1.0, 1.0)], [(np.inf, np.inf)], [(np.nan, 1.0)], [(2.0, 1.0)], [(0.0, 1.0)] * 2):
        with pytest.raises(ConfigurationError, match="bounds"):
            SafetyFilter(integrator(), rows, bounds=box)
    for weights in ([0.0], [-1.0], [np.nan], [1.0, 1.0]):
        with pytest.raises(ConfigurationError, match="weights"):
            SafetyFilter(integrator(), rows, bounds=[(-1.0, 1.0)], weights=weights)
    with pytest.raises(SystemDefinitionError, match="barriers is empty"):
        SafetyFilter(integrator(), [], bounds=[(-1.0, 1.0)])
    with pytest.raises(SystemDefinitionError, match="unknown symbol y"):
        SafetyFilter(integrator(), [(Barrier(1 - y), CBF(1.0))], bounds=[(-1.0, 1.0)])
    with pytest.raises(ConfigurationError, match="knowledge = 'both'"):
        SafetyFilter.for_problem(problem_of("safe_envs/Scalar-v0"), CBF(1.0), "both")


def test_single_state_of_batch_one_keeps_its_leading_axis():
    safety_filter = SafetyFilter(integrator(), [(Barrier(1 - x), CBF(1.0))], bounds=[(-1.0, 1.0)])
    assert safety_filter.filter(np.zeros((1, 1)), np.zeros((1, 1))).action.shape == (1, 1)
    assert safety_filter.filter(np.zeros((0, 1)), np.zeros((0, 1))).action.shape == (0, 1)


@given(
    st.lists(
        st.tuples(st.integers(0, 2), st.integers(0, 3), st.floats(-1.0, 1.0)),
        min_size=1,
        max_size=8,
    ),
    st.sampled_from(["C", "F"]),
)
@settings(max_examples=15)
def test_batches_may_change_in_place_between_decisions(changes, order):
    problem = problem_of("safe_envs/DubinsDisk-v0")
    safety_filter = SafetyFilter.for_problem(problem, "hocbf")
    states = np.array(
        [[-1.5, 0.2, 0.1], [0.9, -1.3, 2.0], [1.1, 1.1, -2.0], [-1.2, 0.0, 0.0]], order=order
    )
    inputs = np.zeros((4, 1))
    columns, proposed = tuple(states.T), tuple(inputs.T)
    # The envs' own states are remembered; these are not to be taken for them.
    envs = gym.make_vec("safe_envs/DubinsDisk-v0", num_envs=4)
    envs.reset(seed=0)
    for state, row, moved in changes:
        states[row, state] += moved
        inputs[row] = moved
        fresh = safety_filter.filter(states.copy(), inputs.copy())
        for batch in (columns, tuple(c.view() for c in columns)):
            np.testing.assert_array_equal(
                safety_filter.decide_arrays(batch, proposed).action[0], fresh.action[:, 0]
            )
        np.testing.assert_array_equal(safety_filter.filter(states, inputs).action, fresh.action)


def test_the_states_of_a_batch_of_envs_cannot_be_written_to():
    envs: Any = gym.make_vec("safe_envs/DubinsDisk-v0", num_envs=3)
    envs.reset(seed=0)
    for _ in range(2):
        for component in envs.components:
            with pytest.raises(ValueError, match="read-only"):
                component[0] = 1.0
        with pytest.raises(ValueError, match="read-only"):
            envs.state[:] = 7.0
        envs.step(np.zeros((3, 1)))
    assert abs(envs.state).max() < 7.0


def test_decisions_share_no_memory_with_what_was_given():
    x, u = sp.symbols("x u", real=True)
    system = ControlAffineSDE.from_rate((x,), (u,), [u])
    for barriers in (1 - x, [1 - x, 2 + x]):
        safety_filter = SafetyFilter(system, barriers, "cbf", bounds=(-1.0, 1.0))
        for shape in ((1,), (3, 1), (1, 1), (2, 3, 1)):
            states, inputs = np.zeros(shape), np.full(shape, 0.5)
            decision = safety_filter.filter(states, inputs)
            for part in decision:
                assert not np.shares_memory(part, states)
                assert not np.shares_memory(part, inputs)
            inputs[:] = 7.0
            np.testing.assert_array_equal(decision.proposed, np.full(shape, 0.5))
