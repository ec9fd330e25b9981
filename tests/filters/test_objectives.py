"""What a program adds to its rows: margins for sampling, a goal, priorities, and the cause."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import scipy.optimize
import sympy as sp

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
from safe_envs.wrappers import CBF, HOCBF, RCBF, SCBF, SRCBF, SZCBF, SafetyFilter, parse_conditions
from tests.conftest import problem_of

x, y, u, w = sp.symbols("x y u w", real=True)
LINE = ControlAffineSDE((x,), (u,), [0], [1], [0])
PLANE = ControlAffineSDE((x, y), (u, w), [0, 0], [[1, 0], [0, 1]], [0, 0])
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


@pytest.mark.parametrize("name", ["DubinsDisk", "DubinsObstacle", "QuadrotorAltitude", "Quadrotor"])
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
        ("safe_envs/DubinsDisk-v0", "hocbf:alpha=30,30", 20.0, "nominal"),
        pytest.param(
            "safe_envs/DubinsDisk-v0", "hocbf:alpha=20,20", 20.0, "zero", marks=pytest.mark.oracle
        ),
        ("safe_envs/DubinsObstacle-v0", "hocbf:alpha=12,12", 20.0, "nominal"),
        ("safe_envs/QuadrotorAltitude-v0", "hocbf:alpha=18,18", 50.0, "nominal"),
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


@pytest.mark.parametrize(
    ("margin", "dt", "action"), [(0.25, None, 0.75), ("first-order", 0.1, 1 / 1.1)]
)
def test_margins_are_kept(margin, dt, action):
    # psi = -u + 1 - x, psi' = -u: within the period dt = .1 the action 1/1.1 makes psi fall from
    # .1/1.1 to 0.
    found = on_line((Barrier(1 - x), CBF(1.0, sampling_margin=margin)), dt=dt)
    assert decided(found, [0.0], [5.0]).action == pytest.approx([action])


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


@pytest.mark.parametrize("margin", [None, "first-order"])
@pytest.mark.parametrize("kind", [SRCBF, SZCBF, SCBF])
@pytest.mark.parametrize("objective", ["nearest", "clf"])
def test_one_state_is_decided_as_in_a_batch_by_every_kind_of_program(kind, margin, objective):
    problem = problem_of("safe_envs/ACC-v0")
    given = {} if margin is None else {"sampling_margin": margin}
    condition = kind((1.0,), **given) if kind is SZCBF else kind(**given)
    safety_filter = SafetyFilter.for_problem(problem, condition, objective=objective)
    rng = np.random.default_rng(3)
    states = np.array([20.0, 20.0, 36.0]) + rng.uniform(-3, 3, (30, 3))  # on both sides of the edge
    inputs = rng.uniform(-6000, 6000, (30, 1))
    batch = safety_filter.filter(states, inputs)
    assert batch.active.sum() > 0
    for i in range(30):
        single = safety_filter.filter(states[i], inputs[i])
        for ours, theirs in zip(single, batch, strict=True):
            np.testing.assert_allclose(ours, theirs[i], rtol=1e-9, atol=1e-6)


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
        (
            lambda: on_plane(ONE, weights=[1.0, 1.0], clf=CLF(x**2)),
            ConfigurationError,
            "weights",
        ),
        (lambda: on_plane(ONE, clf=CLF(x**2, slack_weight=0.0)), ConfigurationError, "positive"),
        *((lambda r=r: CLF(x**2, rate=r), ConfigurationError, "rate") for r in (-1.0, np.nan)),
        *(
            (lambda goal=goal: on_plane(ONE, clf=goal), SystemDefinitionError, "symbol u")
            for goal in (CLF(u**2), CLF(x**2, input_weight=u))
        ),
        (lambda: of_problem("Pendulum-v0", "clf"), ConfigurationError, "Pendulum"),
        (lambda: of_problem("ACC-v0", "clff"), ConfigurationError, "did you mean 'clf'"),
        (lambda: CLFController(problem_of("safe_envs/Scalar-v0")), ConfigurationError, "Lyapunov"),
        (
            lambda: CLFController(problem_of("safe_envs/DubinsDisk-v0"), CLF(x**2)),
            ConfigurationError,
            "theta",
        ),
        (
            lambda: CLFController(problem_of("safe_envs/ACC-v0")).predict(np.zeros(2)),
            InvalidInputError,
            "shape",
        ),
        *(
            (
                lambda z=z: on_plane(ONE, clf=CLF(1 / x)).filter(np.zeros(z), np.zeros(z)),
                NumericalError,
                "goal .* x = 0",
            )
            for z in ((2,), (1, 2))
        ),
        *(
            (
                lambda z=z: on_line(ROOTED, dt=0.1).filter(np.zeros(z), -np.ones(z)),
                NumericalError,
                "x = 0",
            )
            for z in ((1,), (2, 1))
        ),
    ],
)
def test_what_does_not_fit_is_refused(call, error, fragment):
    with pytest.raises(error, match=fragment):
        call()
