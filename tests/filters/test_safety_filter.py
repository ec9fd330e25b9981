"""The safety filter without gym: exact, flagged, inside the bounds, whatever its program has."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import scipy.optimize
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from safe_envs import (
    CLF,
    Barrier,
    ConfigurationError,
    ControlAffineSDE,
    InvalidInputError,
    NumericalError,
    SystemDefinitionError,
)
from safe_envs.agents import evaluate
from safe_envs.agents.policies.nominal import CLFController
from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.integrators import Integrator
from safe_envs.wrappers import CBF, HOCBF, RCBF, SCBF, SRCBF, SafetyFilter, parse_conditions
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


ROW, SCALAR = [(Barrier(1 - x), CBF(1.0))], problem_of("safe_envs/Scalar-v0")


def of_rows(rows, box=((-1, 1),)):
    return SafetyFilter(LINE, rows, input_bounds=box)


@pytest.mark.parametrize(
    ("call", "error", "fragment"),
    [
        *(
            (lambda box=box: of_rows(ROW, box), ConfigurationError, "bounds")
            for box in ([(1, 1)], [(np.inf, np.inf)], [(np.nan, 1)], [(2, 1)], [(0, 1)] * 2)
        ),
        *(
            (lambda given=given: wall(weights=given), ConfigurationError, "weights")
            for given in ([0.0], [-1.0], [np.nan], [1.0, 1.0])
        ),
        (lambda: of_rows([]), SystemDefinitionError, "barriers"),
        (lambda: of_rows([(Barrier(1 - y), CBF(1.0))]), SystemDefinitionError, "symbol y"),
        (lambda: SafetyFilter.for_problem(SCALAR, CBF(1.0), "both"), ConfigurationError, "'both'"),
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
    st.lists(st.tuples(st.integers(0, 2), st.integers(0, 3), st.floats(-1.0, 1.0)), max_size=8),
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


# What a program adds to its rows: margins for sampling, a goal, priorities, and the cause.


UNIT = CBF(1.0)
EACH = [(), (1,)]
"""Shapes in front of one state: by itself, and in a batch of one."""


def on_line(*rows, half=9.0, **more):
    return SafetyFilter(LINE, list(rows), input_bounds=[(-half, half)], **more)


def on_plane(*rows, half=9.0, **more):
    return SafetyFilter(PLANE, list(rows), input_bounds=[(-half, half)] * 2, **more)


def decided(safety_filter, state, nominal):
    """Decide for one state and for a batch of it; return what they agree on."""
    one, batch = (
        safety_filter.filter(np.reshape(state, (*shape, -1)), np.reshape(nominal, (*shape, -1)))
        for shape in EACH
    )
    for mine, theirs in zip(one, batch, strict=True):
        np.testing.assert_allclose(mine, theirs[0], rtol=1e-9, atol=1e-6)
    return one


def joint(*rows, half=3.0, **changes):
    given = {"rate": 2.0, "input_weight": 0.5, "slack_weight": 3.0, **changes}
    goal = CLF((x - 2) ** 2 + (y + 1) ** 2, **given)
    default = ((Barrier(1 - x), UNIT), (Barrier(2 - x**2 - y**2), CBF(2.0)))
    return on_plane(*(rows or default), half=half, clf=goal)


@pytest.mark.parametrize("name", ["DubinsDisk", "QuadrotorAltitude"])
def test_change_of_a_row_is_its_slope_along_the_held_input(name):
    problem = problem_of(f"safe_envs/{name}-v0")
    model, dt = problem.model, 1e-4
    condition = HOCBF(problem.gains_of(0), sampling_margin="first-order")
    found = condition.constraint(model, problem.barriers[0])
    entries = [model.numeric(e) for e in (*found.coefficient, found.offset)]
    row = compile_function(model.states, entries, "floats")
    symbols = (*model.states, *model.inputs)
    change = compile_function(symbols, [model.numeric(found.change)], "floats")
    flow = Integrator(model, dt, 1, "floats")
    reverse = replace(model, drift=-model.drift, input_matrix=-model.input_matrix)
    back = Integrator(reverse, dt, 1, "floats")
    rng = np.random.default_rng(0)
    for _ in range(5):
        state = rng.uniform(0.1, 0.9, model.n).tolist()
        held = [rng.uniform(low, high) for low, high in problem.input_bounds]

        def value(at, held=held):
            *a, b = row(*at)
            return np.dot(a, held) + b

        slope = (value(flow.step(state, held, [])) - value(back.step(state, held, []))) / (2 * dt)
        assert change(*state, *held)[0] == pytest.approx(slope, rel=1e-5, abs=1e-5)


def test_a_stochastic_condition_takes_the_generator_of_its_row():
    # A h = -u - sigma^2 ... has no state in it, x^3 has: psi = -3 x^2 u - 3 x, A psi = (-6 x u - 3)
    # u - 3 u.
    system = ControlAffineSDE((x,), (u,), [0], [1], [1])
    found = SCBF(sampling_margin="first-order").constraint(system, Barrier(1 - x**3))
    assert sp.expand(found.change - (-6 * x * u**2 - 3 * u - 3 * u)) == 0


@pytest.mark.parametrize(
    ("env_id", "filters", "bound", "policy"),
    [
        ("DubinsDisk-v0", "hocbf:alpha=30,30", 20.0, "nominal"),
        *(
            pytest.param(*case, marks=pytest.mark.oracle)
            for case in (
                ("DubinsDisk-v0", "hocbf:alpha=20,20", 20.0, "zero"),
                ("DubinsObstacle-v0", "hocbf:alpha=12,12", 20.0, "nominal"),
                ("QuadrotorAltitude-v0", "hocbf:alpha=18,18", 50.0, "nominal"),
            )
        ),
    ],
)
def test_margin_of_first_order_keeps_stiff_conditions_at_the_period_of_the_thesis(
    env_id, filters, bound, policy
):
    # Noise-free, with the true model, dt = .05: the continuous condition keeps h >= 0, the sampled
    # one does not.
    options = {"input_bounds": [-bound, bound], "horizon": 10.0}
    names = (filters, f"{filters}:sampling_margin=first-order")
    given = {"options": options, "episodes": 30, "knowledge": "plant", "bounds": False}
    plain, with_margin = evaluate(env_id, policy, names, engine="numpy", **given).rows
    assert plain.safe < 30
    assert with_margin.safe == 30


def test_joint_program_equals_a_general_solver():
    safety_filter = joint()
    rng = np.random.default_rng(0)
    states, nominal = rng.uniform(-0.9, 0.9, (12, 2)), rng.uniform(-1, 1, (12, 2))
    batch = safety_filter.filter(states, nominal)
    assert batch.feasible.all()
    assert batch.active.any()
    for i, (state, proposed) in enumerate(zip(states, nominal, strict=True)):
        a, b = state
        demand = 2 * ((a - 2) ** 2 + (b + 1) ** 2)
        slope = np.array([2 * (a - 2), 2 * (b + 1)])

        def cost(z):
            return 0.5 * np.sum(z[:2] ** 2) + 3 * z[2] ** 2

        def rows(z, demand=demand, slope=slope, a=a, b=b):
            goal = z[2] - demand - slope @ z[:2]
            return goal, 1 - a - z[0], 2 * (2 - a * a - b * b) - 2 * (a * z[0] + b * z[1])

        reference = scipy.optimize.minimize(
            cost,
            [0, 0, 1],
            constraints={"type": "ineq", "fun": rows},
            bounds=[(-3, 3), (-3, 3), (0, None)],
            options={"ftol": 1e-13, "maxiter": 300},
        )
        np.testing.assert_allclose(batch.action[i], reference.x[:2], atol=2e-5)
        np.testing.assert_allclose(
            safety_filter.filter(state, proposed).action, batch.action[i], atol=1e-7
        )


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("ACC", [5, 5, 5], [25, 25, 60]), ("CubicSDE", [-1.5, -1.5], [0.5, 1.5])],
)
def test_joint_program_of_one_input_is_the_filter_over_the_goals_controller(name, low, high):
    # The cost is convex in a single input, so that its minimiser on an interval is the nearest
    # point of it.
    problem, rng = problem_of(f"safe_envs/{name}-v0"), np.random.default_rng(1)
    states = rng.uniform(low, high, (200, problem.plant.n))
    nearest = SafetyFilter.for_problem(problem, SCBF())
    both = SafetyFilter.for_problem(problem, SCBF(), objective="clf")
    actions, _ = CLFController(problem).predict(states)
    high = problem.input_bounds[0][1]
    expected = nearest.filter(states, actions * high)
    found = both.filter(states, np.zeros((200, 1)))
    np.testing.assert_allclose(found.action, expected.action, rtol=1e-6, atol=1e-6 * high)
    assert (found.feasible == expected.feasible).all()
    assert expected.active.any()


def test_clf_controller_equals_the_closed_form_inside_the_box_and_is_optimal_at_it():
    problem = problem_of("safe_envs/CubicSDE-v0")
    law = compile_function(
        problem.model.states, [problem.model.numeric(e) for e in problem.nominal], "arrays"
    )
    states = np.random.default_rng(2).uniform(-2, 2, (300, 2))
    expected = np.clip(law(*states.T)[0], -10, 10)
    actions, _ = CLFController(problem).predict(states)
    np.testing.assert_allclose(actions[:, 0] * 10, expected, atol=1e-7)
    one, _ = CLFController(problem).predict(states[0])
    np.testing.assert_allclose(one, actions[0], atol=1e-9)


CONTRADICTING = (Barrier(x - 0.5), UNIT), (Barrier(-0.5 - x), UNIT)


@pytest.mark.parametrize("weight", [1e-6, 1.0, 1e6])
def test_barrier_slack_is_dearer_than_any_goal(weight):
    # The goal pulls with a huge weight to where the contradicting rows are missed more.
    # u >= .5 - .2 and u <= -.5 - .2: equal slacks in the middle.
    result = decided(joint(*CONTRADICTING, slack_weight=weight), [0.2, 0.3], [0.0, 0.0])
    assert result.action[0] == pytest.approx(-0.2, abs=1e-6)
    np.testing.assert_allclose(result.slack, [0.5, 0.5], atol=1e-6)
    assert not result.feasible


@pytest.mark.parametrize(
    ("priorities", "action"),
    [(None, 0.0), ((1.0, 1.0), 0.0), ((3.0, 1.0), 0.25), ((1.0, 9.0), -0.4)],
)
def test_priorities_say_which_row_gives_way(priorities, action):
    result = decided(on_line(*CONTRADICTING, half=3.0, priorities=priorities), [0.0], [2.0])
    np.testing.assert_allclose(result.action, [action], atol=1e-9)
    np.testing.assert_allclose(result.slack, [0.5 - action, 0.5 + action], atol=1e-9)


WALLS = (Barrier(1 - x), UNIT), (Barrier(2 - x), UNIT), (Barrier(x + 1), UNIT)
CORNER = (Barrier(1 - x), UNIT), (Barrier(0.5 - y), UNIT)
FLAT = SafetyFilter(
    ControlAffineSDE((x, y), (u,), [-1, 0], [0, 1], [0, 0]),
    [(Barrier(y + 0.5), UNIT), (Barrier(1 - y), UNIT)],
    input_bounds=[(-9.0, 9.0)],
)


@pytest.mark.parametrize(
    ("made", "proposal", "cause"),
    [
        *((on_line(*WALLS), [v], c) for v, c in ((5.0, 0), (0.5, -1), (-7.0, 2), (1.5, 0))),
        (FLAT, [4.0], 1),
        # In the weighted distance: 3 beyond the first row, 2.5 beyond the second.
        (on_plane(*CORNER), [4.0, 3.0], 0),
        (on_plane(*CORNER, weights=[1.0, 4.0]), [4.0, 3.0], 1),
        (on_plane(CORNER[0]), [0.0, 0.0], -1),
        (on_plane(CORNER[0]), [4.0, 0.0], 0),
        # A distance and not a miss of the row: u + w <= 1 is missed by 3 and lies 3/sqrt(2) = 2.1
        # off, w <= .5 by 2; and with a row half as steep, 1 and 2 against 1.5.
        *(
            (on_plane((Barrier(h), UNIT), CORNER[1]), proposal, cause)
            for h, pair in (
                (1 - x - y, ([1.5, 2.5], [1.0, 2.5])),
                (1 - 0.5 * x, ([4.0, 2.0], [4.0, 2.9])),
            )
            for cause, proposal in enumerate(pair)
        ),
    ],
)
def test_cause_is_the_active_row_furthest_from_the_proposal(made, proposal, cause):
    assert decided(made, [0.0] * made.model.n, proposal).cause == cause


@pytest.mark.parametrize("text", ["rcbf", "rcbf:form=log", "srcbf", "srcbf:form=log"])
def test_reciprocal_rows_with_a_margin_on_both_sides_of_the_edge(text):
    problem = problem_of("safe_envs/Scalar-v0", noise=0.2)
    conditions = parse_conditions(f"{text}:sampling_margin=first-order", problem)
    safety_filter = SafetyFilter.for_problem(problem, conditions)
    for state in (-1.0, 0.5, 0.9, 1.0 - 1e-12, 1.0, 1.3):
        found = decided(safety_filter, [state], [8.0])
        if state >= 1.0:
            assert (found.action.tolist(), found.feasible) == ([-10.0], False)


def test_margin_of_a_reciprocal_row_takes_its_demand_into_account():
    # x' = x + u, h = 1 - x, B = 1/h: psi = -(x + u) + h^3, psi' = -(x + u)(1 + 3 h^2).
    system = ControlAffineSDE((x,), (u,), [x], [1], [0])
    found = RCBF(sampling_margin="first-order").constraint(system, Barrier(1 - x))
    expected = -(x + u) * (1 + 3 * (1 - x) ** 2)
    assert sp.simplify(sp.nsimplify(found.change) - expected) == 0


@pytest.mark.parametrize("half", [10.0, 1e6])
def test_a_condition_without_meaning_does_not_harm_another_barrier(half):
    # y is beyond its edge, x is not: y is to fall as fast as x allows, however wide the box.
    both = ControlAffineSDE((x, y), (u,), [0, 0], [1, 1], [0, 0])
    rows = [(Barrier(x), UNIT), (Barrier(-y), RCBF())]
    result = decided(SafetyFilter(both, rows, input_bounds=[(-half, half)]), [0.1, 1.0], [0.0])
    np.testing.assert_allclose(result.action, [-0.1], atol=1e-9)
    assert result.slack[0] == pytest.approx(0.0, abs=1e-9)
    assert (result.cause, result.feasible) == (1, False)


@dataclass(frozen=True)
class Doubtful(CBF):
    """A row that is known up to an error, whose form is as given."""

    form: tuple[Any, ...] = ()

    def derived(self, model, barrier):
        form = tuple(map(sp.sympify, self.form))
        return replace(super().derived(model, barrier), uncertainty=form)


@dataclass(frozen=True)
class Rooted(CBF):
    """A row with a root of the state in it."""

    def derived(self, model, barrier):
        return replace(super().derived(model, barrier), offset=sp.sqrt(x))


@pytest.mark.parametrize(("state", "largest"), [(0.0, 1.0), (0.5, 0.0), (-0.5, 1.0), (0.25, 0.5)])
def test_an_uncertainty_with_constant_entries_follows_the_state_all_the_same(state, largest):
    # 1 - x - u >= |x| in the box of u, and w has no part: entries (0, 0), (0, u), (0, w), (u, u),
    # (u, w), (w, w).
    found = on_plane((Barrier(1 - x), Doubtful(1.0, form=(x**2, 0, 0, 0, 0, 0))))
    action = decided(found, [state, 0.0], [5.0, 0.3]).action
    np.testing.assert_allclose(action, [largest, 0.3], atol=1e-14)


ONE = (Barrier(1 - x), UNIT)
LATE = (Barrier(1 - x), CBF(1.0, sampling_margin="first-order"))
# psi = sqrt(x) - u with x' = u has the rate u/(2 sqrt(x)) - ..., infinite at 0, unlike the row.
ROOTED = (Barrier(1 - x), Rooted(1.0, sampling_margin="first-order"))


SINGULAR, JUMPING = on_plane(ONE, clf=CLF(1 / x)), on_line(ROOTED, dt=0.1)


def controller(name, *goal):
    return CLFController(problem_of(f"safe_envs/{name}-v0"), *goal)


def of_problem(name, objective):
    return SafetyFilter.for_problem(problem_of(f"safe_envs/{name}"), SCBF(), objective=objective)


@pytest.mark.parametrize(
    ("call", "error", "fragment"),
    [
        (lambda: on_line(LATE), ConfigurationError, "control period"),
        (lambda: on_line(LATE, dt=-1.0), ConfigurationError, "dt = -1"),
        *(
            (lambda p=p: on_line(*CONTRADICTING, priorities=p), ConfigurationError, "priorities")
            for p in ((1.0,), (1.0, 0.0), (1.0, np.nan))
        ),
        (lambda: on_plane(ONE, weights=[1.0, 1.0], clf=CLF(x**2)), ConfigurationError, "weights"),
        (lambda: on_plane(ONE, clf=CLF(x**2, slack_weight=0.0)), ConfigurationError, "positive"),
        *((lambda r=r: CLF(x**2, rate=r), ConfigurationError, "rate") for r in (-1.0, np.nan)),
        *(
            (lambda goal=goal: on_plane(ONE, clf=goal), SystemDefinitionError, "symbol u")
            for goal in (CLF(u**2), CLF(x**2, input_weight=u))
        ),
        (lambda: of_problem("Pendulum-v0", "clf"), ConfigurationError, "Pendulum"),
        (lambda: of_problem("ACC-v0", "clff"), ConfigurationError, "did you mean 'clf'"),
        (lambda: controller("Scalar"), ConfigurationError, "Lyapunov"),
        (lambda: controller("DubinsDisk", CLF(x**2)), ConfigurationError, "theta"),
        (lambda: controller("ACC").predict(np.zeros(2)), InvalidInputError, "shape"),
        *(
            (lambda z=z: SINGULAR.filter(np.zeros(z), np.zeros(z)), NumericalError, "goal .* x = 0")
            for z in ((2,), (1, 2))
        ),
        *(
            (lambda z=z: JUMPING.filter(np.zeros(z), -np.ones(z)), NumericalError, "x = 0")
            for z in ((1,), (2, 1))
        ),
    ],
)
def test_what_does_not_fit_is_refused(call, error, fragment):
    with pytest.raises(error, match=fragment):
        call()


# Reciprocal conditions: their closed forms, their box, and what they do outside C.


def scalar(sigma):
    return ControlAffineSDE((x,), (u,), [x], [1], [sigma])


def upper_limits(condition, sigma, states, most=1e4):
    """Largest input that the filter allows on h = 1 - x, where the thesis has closed forms."""
    safety_filter = SafetyFilter(
        scalar(sigma), [(Barrier(1 - x), condition)], input_bounds=[(-most, most)]
    )
    return safety_filter.filter(states[:, None], np.full((len(states), 1), most)).action[:, 0]


def test_the_motivating_example_of_sec_4_2_2():
    states = np.linspace(-2.0, 0.99, 30)
    h = 1 - states
    np.testing.assert_allclose(upper_limits(RCBF(), 0.0, states), h**3 - states, rtol=1e-12)
    np.testing.assert_allclose(
        upper_limits(SRCBF(), 0.4, states), h**3 - states - 0.16 / h, rtol=1e-12
    )
    np.testing.assert_allclose(
        upper_limits(SRCBF(0.1), 0.4, states), 0.1 * h**3 - states - 0.16 / h, rtol=1e-12
    )
    np.testing.assert_allclose(upper_limits(SCBF(), 0.4, states), -states, rtol=1e-12)
    # The deterministic one needs bounded control at the edge, the stochastic one does not: it knows
    # no noise.
    np.testing.assert_allclose(upper_limits(RCBF(), 0.4, states), h**3 - states, rtol=1e-12)


def test_the_logarithmic_form():
    # B = -log(h/(1+h)), B' = -1/(h(1+h)), B'' = (1+2h)/(h(1+h))^2: A B <= gamma/B.
    states = np.linspace(-2.0, 0.99, 30)
    h = 1 - states
    b = -np.log(h / (1 + h))
    np.testing.assert_allclose(
        upper_limits(RCBF(0.5, "log"), 0.0, states), 0.5 * h * (1 + h) / b - states, rtol=1e-9
    )
    spread = 0.5 * 0.16 * (1 + 2 * h) / (h * (1 + h))
    np.testing.assert_allclose(
        upper_limits(SRCBF(0.5, "log"), 0.4, states),
        0.5 * h * (1 + h) / b - states - spread,
        rtol=1e-9,
    )


def test_control_of_the_stochastic_one_is_unbounded_near_the_edge_and_a_box_breaks_it():
    near = 1 - np.array([1e-3, 1e-4, 1e-6])
    asked = upper_limits(SRCBF(), 0.4, near, most=1e9)
    np.testing.assert_allclose(asked * (1 - near), -0.16, rtol=1e-2)
    safety_filter = SafetyFilter(
        scalar(0.4), [(Barrier(1 - x), SRCBF())], input_bounds=[(-10.0, 10.0)]
    )
    result = safety_filter.filter(near[:, None], np.zeros((3, 1)))
    assert result.feasible.tolist() == [False] * 3
    np.testing.assert_allclose(result.action, -10.0)
    np.testing.assert_allclose(result.slack[:, 0], 0.16 / (1 - near) - 10 + near, rtol=1e-6)


@pytest.mark.parametrize("condition", [RCBF(), SRCBF(), RCBF(form="log"), SRCBF(0.1, "log")])
@pytest.mark.parametrize("state", [1.0, 1.0 + 1e-13, 1.5, 40.0])
def test_outside_the_action_raises_h_most_and_is_flagged(condition, state):
    safety_filter = SafetyFilter(
        scalar(0.4), [(Barrier(1 - x), condition)], input_bounds=[(-3.0, 4.0)]
    )
    for result in (
        safety_filter.filter([state], [2.0]),
        safety_filter.filter([[state], [0.0]], [[2.0], [0.1]]),
    ):
        first = [np.asarray(part).reshape(-1)[0] for part in result]
        action, margin, active, feasible, slack, cause, _, barrier = first
        assert action == -3.0
        assert not feasible
        assert active
        assert cause == 0
        assert barrier == pytest.approx(1 - state, abs=1e-12)
        assert margin == pytest.approx(3.0 - state)  # A h at the action
        assert slack == pytest.approx(max(0.0, state - 3.0))
    assert result.feasible.tolist() == [False, True]


def test_outside_with_several_inputs_and_flat_ones():
    plane = ControlAffineSDE((x, y), (u, w), [0, 0], [[1, 0], [0, 0]], [sp.Rational(1, 5), 0])
    safety_filter = SafetyFilter(
        plane, [(Barrier(1 - x), SRCBF())], input_bounds=[(-3.0, 4.0), (-2.0, 2.0)]
    )
    for state, nominal in (([1.2, 0.0], [1.0, 0.7]), ([[1.2, 0.0]], [[1.0, 0.7]])):
        result = safety_filter.filter(np.array(state), np.array(nominal))
        np.testing.assert_allclose(np.ravel(result.action), [-3.0, 0.7])
        assert not np.any(result.feasible)


def test_beside_another_barrier():
    # Outside the first, which asks for all it can get; the second one still has its say, by least
    # squares.
    rows = [(Barrier(1 - x), RCBF()), (Barrier(x + 3), CBF(1.0))]
    safety_filter = SafetyFilter(scalar(0.0), rows, input_bounds=[(-3.0, 3.0)])
    inside = safety_filter.filter([0.5], [3.0])
    np.testing.assert_allclose(inside.action, [0.125 - 0.5], atol=1e-9)
    assert inside.feasible
    outside = safety_filter.filter([1.5], [3.0])
    np.testing.assert_allclose(outside.action, [-3.0], atol=1e-6)
    assert not outside.feasible
    assert outside.cause == 0
