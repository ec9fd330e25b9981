"""The safety filter without gym: exact, flagged, inside the bounds."""

from __future__ import annotations

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
LINE = ControlAffineSDE((x,), (u,), [0], [1], [0])
PLANE = ControlAffineSDE((x, y), (u, w), [0, 0], [[1, 0], [0, 1]], [0, 0])
CHAIN = ControlAffineSDE((x, y), (u,), [y, 0], [0, 1], [0, 0])


def wall(alpha=1.0, half=3.0, **more):
    """x' = u before a wall at 1: u <= alpha (1 - x)."""
    return SafetyFilter(LINE, [(Barrier(1 - x), CBF(alpha))], input_bounds=[(-half, half)], **more)


@pytest.mark.parametrize(
    ("alpha", "state", "nominal", "action", "slack"),
    [
        (2.0, 0.0, 1.0, 1.0, 0.0),
        (2.0, 0.0, 2.5, 2.0, 0.0),
        (2.0, 0.9, 1.0, 0.2, 0.0),
        (2.0, 0.9, -4.0, -3.0, 0.0),
        (1.0, 6.0, 1.0, -3.0, 2.0),
    ],
)
def test_one_input_in_closed_form(alpha, state, nominal, action, slack):
    for found in (
        wall(alpha).filter([state], [nominal]),
        [part[0] for part in wall(alpha).filter([[state]], [[nominal]])],
    ):
        _action, margin, active, feasible, slacks, _, _, barrier = found
        np.testing.assert_allclose(_action, [action], atol=1e-12)
        assert active.tolist() == [slack > 0.0 or action < min(nominal, 3.0) - 1e-9]
        assert feasible == (slack == 0.0)
        assert slacks == pytest.approx([slack])
        assert barrier == pytest.approx([1 - state])
        assert margin == pytest.approx([alpha * (1 - state) - action], abs=1e-12)


def test_four_inputs_by_a_search():
    problem = problem_of("safe_envs/Quadrotor-v0")
    safety_filter = SafetyFilter.for_problem(problem, HOCBF(problem.gains))
    rng, state = np.random.default_rng(0), np.zeros(12)
    state[[2, 5, 6, 7]] = [6.5, 1.3, 0.2, -0.1]
    low, high = np.array(problem.input_bounds).T
    nominal = rng.uniform(low, high)
    result = safety_filter.filter(state, nominal)
    assert result.active.all()
    assert result.feasible
    best = np.sum((result.action - nominal) ** 2)
    model, (constraint,) = safety_filter.model, safety_filter.constraints
    values = dict(zip(model.states, state, strict=True))
    a = np.array([float(model.numeric(c).subs(values)) for c in constraint.coefficient])
    b = float(model.numeric(constraint.offset).subs(values))
    assert result.margin[0] == pytest.approx(b + a @ result.action, rel=1e-9)
    for scale in (1.0, 1e-1, 1e-2, 1e-3):
        step = scale * (high - low) * rng.normal(size=(20_000, 4))
        tried = np.clip(result.action + step, low, high)
        allowed = tried[b + tried @ a >= 0]
        assert len(allowed)
        assert np.sum((allowed - nominal) ** 2, axis=1).min() >= best * (1 - 1e-9)


@pytest.mark.parametrize("name", ["StochasticDubins", "Quadrotor", "ACC", "CubicSDE"])
def test_batches_equal_single_states(name):
    problem = problem_of(f"safe_envs/{name}-v0")
    safety_filter = SafetyFilter.for_problem(problem, SCBF())
    rng, (low, high) = np.random.default_rng(1), np.array(problem.input_bounds).T
    states = rng.uniform(0.2, 1.5, (4, 3, problem.plant.n))
    inputs = rng.uniform(1.5 * low - 0.5 * high, 1.5 * high - 0.5 * low, (4, 3, problem.plant.m))
    batch = safety_filter.filter(states, inputs)
    for i in np.ndindex(4, 3):
        single = safety_filter.filter(states[i], inputs[i])
        for ours, theirs in zip(single, batch, strict=True):
            np.testing.assert_allclose(ours, theirs[i], rtol=1e-9, atol=1e-9)
        assert np.all((single.action >= low) & (single.action <= high))


@pytest.mark.parametrize(("weights", "action"), [(None, [0.5, 0.5]), ([1.0, 9.0], [0.1, 0.9])])
def test_weights_decide_which_input_gives_way(weights, action):
    row = [(Barrier(1 - x - y), CBF(1.0))]
    found = SafetyFilter(PLANE, row, input_bounds=[(-5.0, 5.0)] * 2, weights=weights)
    np.testing.assert_allclose(found.filter(np.zeros(2), np.ones(2)).action, action)


@pytest.mark.parametrize(
    ("state", "action", "active", "slack"),
    [
        ([0.0, 0.2], 0.6, [True, False], [0.0, 0.0]),
        ([-9.0, 1.9], 0.1, [False, True], [0.0, 0.0]),
        ([3.0, 3.0], -4.0, None, [4.0, 0.0]),
    ],
)
def test_several_barriers_with_conditions_of_their_own(state, action, active, slack):
    # b_2 = -u - 2 y + (1 - x) >= 0 and -u + 2 - y >= 0.
    rows = [
        (Barrier(1 - x, "position"), HOCBF((1.0, 1.0))),
        (Barrier(2 - y, "speed"), CBF(1.0)),
    ]
    safety_filter = SafetyFilter(CHAIN, rows, input_bounds=[(-4.0, 4.0)])
    for shape in ((), (1,)):
        found = safety_filter.filter(np.reshape(state, (*shape, 2)), np.full((*shape, 1), 3.0))
        np.testing.assert_allclose(np.ravel(found.action), [action], atol=1e-7)
        np.testing.assert_allclose(np.ravel(found.barrier), [1 - state[0], 2 - state[1]])
        np.testing.assert_allclose(np.ravel(found.slack), slack, atol=1e-7)
        assert np.all(found.feasible) == (not any(slack))
        assert active is None or np.ravel(found.active).tolist() == active


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
    with pytest.raises(InvalidInputError):
        wall().filter(state, nominal)
    if np.ndim(state):
        with pytest.raises(InvalidInputError):
            wall().filter([np.zeros_like(state), state], [np.zeros_like(nominal), nominal])


@pytest.mark.parametrize("h", [sp.log(x), 1 / x, sp.sqrt(x) + 1])
def test_states_where_the_barrier_or_its_rate_has_no_value_are_not_safe(h):
    safety_filter = SafetyFilter(LINE, [(Barrier(h), CBF(1.0))], input_bounds=[(-1.0, 1.0)])
    found = safety_filter.filter([0.0], [3.0])
    assert (found.feasible, found.slack, found.action.tolist()) == (False, [np.inf], [1.0])
    assert safety_filter.filter([[1.0], [0.0]], np.zeros((2, 1))).feasible.tolist() == [True, False]


@pytest.mark.parametrize("state", [[0.0], [[1.0], [0.0]]])
def test_states_where_the_dynamics_have_no_value_are_errors(state):
    system = ControlAffineSDE((x,), (u,), [sp.log(x)], [1])
    safety_filter = SafetyFilter(system, [(Barrier(1 - x), CBF(1.0))], input_bounds=[(-1.0, 1.0)])
    with pytest.raises(NumericalError, match="x = 0"):
        safety_filter.filter(state, np.zeros_like(state))


ROW = [(Barrier(1 - x), CBF(1.0))]


@pytest.mark.parametrize(
    ("call", "error", "fragment"),
    [
        *(
            (
                lambda box=box: SafetyFilter(LINE, ROW, input_bounds=box),
                ConfigurationError,
                "bounds",
            )
            for box in ([(1, 1)], [(np.inf, np.inf)], [(np.nan, 1)], [(2, 1)], [(0, 1)] * 2)
        ),
        *(
            (lambda given=given: wall(weights=given), ConfigurationError, "weights")
            for given in ([0.0], [-1.0], [np.nan], [1.0, 1.0])
        ),
        (lambda: SafetyFilter(LINE, [], input_bounds=[(-1, 1)]), SystemDefinitionError, "barriers"),
        (
            lambda: SafetyFilter(LINE, [(Barrier(1 - y), CBF(1.0))], input_bounds=[(-1, 1)]),
            SystemDefinitionError,
            "symbol y",
        ),
        (
            lambda: SafetyFilter.for_problem(problem_of("safe_envs/Scalar-v0"), CBF(1.0), "both"),
            ConfigurationError,
            "'both'",
        ),
        (lambda: wall(nois=1.0), TypeError, "'nois'"),
    ],
)
def test_construction_is_checked(call, error, fragment):
    with pytest.raises(error, match=fragment):
        call()


@pytest.mark.parametrize("count", [0, 1])
def test_a_small_batch_keeps_its_leading_axis(count):
    assert wall().filter(np.zeros((count, 1)), np.zeros((count, 1))).action.shape == (count, 1)


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
    rows = [[-1.5, 0.2, 0.1], [0.9, -1.3, 2.0], [1.1, 1.1, -2.0], [-1.2, 0.0, 0.0]]
    states, inputs = np.array(rows, order=order), np.zeros((4, 1))
    columns, proposed = tuple(states.T), tuple(inputs.T)
    # The envs' own states are remembered; these are not to be taken for them.
    gym.make_vec("safe_envs/DubinsDisk-v0", num_envs=4).reset(seed=0)
    for state, row, moved in changes:
        states[row, state] += moved
        inputs[row] = moved
        fresh = safety_filter.filter(states.copy(), inputs.copy())
        for batch in (columns, tuple(c.view() for c in columns)):
            found = safety_filter.decide_arrays(batch, proposed).action[0]
            np.testing.assert_array_equal(found, fresh.action[:, 0])
        np.testing.assert_array_equal(safety_filter.filter(states, inputs).action, fresh.action)
