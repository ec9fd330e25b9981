"""What a program adds to its rows: margins for sampling, a goal, priorities, and the barrier that
is to blame."""

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


def integrator():
    return ControlAffineSDE((x,), (u,), [0], [1], [0])


def plane():
    """Two integrators with an input each."""
    return ControlAffineSDE((x, y), (u, w), [0, 0], [[1, 0], [0, 1]], [0, 0])


@pytest.mark.parametrize("name", ["DubinsDisk", "DubinsObstacle", "QuadrotorAltitude", "Quadrotor"])
def test_change_of_a_row_is_its_slope_along_the_held_input(name):
    problem = problem_of(f"safe_envs/{name}-v0")
    model, dt = problem.model, 1e-4
    found = HOCBF(problem.gains_of(0), sampling_margin="first-order").constraint(
        model, problem.barriers[0]
    )
    row = compile_function(
        model.states, [model.numeric(e) for e in (*found.coefficient, found.offset)], "floats"
    )
    change = compile_function(
        (*model.states, *model.inputs), [model.numeric(found.change)], "floats"
    )
    flow = Integrator(model, dt, 1, "floats")
    reverse = ControlAffineSDE(
        model.states,
        model.inputs,
        -model.drift,
        -model.input_matrix,
        model.diffusion,
        model.parameters,
    )
    back = Integrator(reverse, dt, 1, "floats")
    rng = np.random.default_rng(0)
    for _ in range(5):
        state = rng.uniform(0.1, 0.9, model.n).tolist()
        held = [rng.uniform(low, high) for low, high in problem.box]

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
    ("env_id", "filters", "options", "policy"),
    [
        (
            "safe_envs/DubinsDisk-v0",
            "hocbf:p=30,30",
            {"box": [-20.0, 20.0], "horizon": 10.0},
            "nominal",
        ),
        (
            "safe_envs/DubinsDisk-v0",
            "hocbf:p=20,20",
            {"box": [-20.0, 20.0], "horizon": 10.0},
            "zero",
        ),
        ("safe_envs/DubinsObstacle-v0", "hocbf:p=12,12", {"box": [-20.0, 20.0]}, "nominal"),
        ("safe_envs/QuadrotorAltitude-v0", "hocbf:p=18,18", {"box": [-50.0, 50.0]}, "nominal"),
    ],
)
def test_margin_of_first_order_keeps_stiff_conditions_at_the_period_of_the_thesis(
    env_id, filters, options, policy
):
    # Noise-free, with the true model, dt = .05: the continuous condition keeps h >= 0, the sampled
    # one does not.
    names = (filters, f"{filters}:sampling_margin=first-order")
    plain, with_margin = evaluate(
        env_id, policy, names, options=options, episodes=30, knowledge="plant", bounds=False
    ).rows
    assert plain.safe < 30
    assert with_margin.safe == 30


def test_numeric_margins_are_kept_and_first_order_needs_a_period():
    row = [(Barrier(1 - x), CBF(1.0, sampling_margin=0.25))]
    assert SafetyFilter(integrator(), row, bounds=[(-9.0, 9.0)]).filter(
        [0.0], [5.0]
    ).action == pytest.approx([0.75])
    row = [(Barrier(1 - x), CBF(1.0, sampling_margin="first-order"))]
    with pytest.raises(ConfigurationError, match="needs the control period"):
        SafetyFilter(integrator(), row, bounds=[(-9.0, 9.0)])
    with pytest.raises(ConfigurationError, match=r"dt = -1"):
        SafetyFilter(integrator(), row, bounds=[(-9.0, 9.0)], dt=-1.0)
    # psi = -u + 1 - x, psi' = -u: within the period dt = .1 the action 1/1.1 makes psi fall from
    # .1/1.1 to 0.
    for state, nominal in (([0.0], [5.0]), ([[0.0]], [[5.0]])):
        result = SafetyFilter(integrator(), row, bounds=[(-9.0, 9.0)], dt=0.1).filter(
            state, nominal
        )
        assert np.ravel(result.action) == pytest.approx([1 / 1.1])


def joint(low=-3.0, high=3.0, rows=None, **changes):
    goal = CLF(
        **{
            "V": (x - 2) ** 2 + (y + 1) ** 2,
            "rate": 2.0,
            "input_weight": 0.5,
            "slack_weight": 3.0,
            **changes,
        }
    )
    rows = rows or [(Barrier(1 - x), CBF(1.0)), (Barrier(2 - x**2 - y**2), CBF(2.0))]
    return goal, SafetyFilter(plane(), rows, bounds=[(low, high)] * 2, clf=goal)


def test_joint_program_equals_a_general_solver():
    goal, safety_filter = joint()
    rng = np.random.default_rng(0)
    states, nominal = rng.uniform(-0.9, 0.9, (40, 2)), rng.uniform(-1, 1, (40, 2))
    batch = safety_filter.filter(states, nominal)
    assert batch.feasible.all()
    assert batch.active.any()
    for i, (state, proposed) in enumerate(zip(states, nominal, strict=True)):
        a, b = state
        demand = 2 * ((a - 2) ** 2 + (b + 1) ** 2)
        slope = np.array([2 * (a - 2), 2 * (b + 1)])

        def cost(z):
            return 0.5 * np.sum(z[:2] ** 2) + 3 * z[2] ** 2

        constraints = [
            {
                "type": "ineq",
                "fun": lambda z, demand=demand, slope=slope: z[2] - demand - slope @ z[:2],
            },
            {"type": "ineq", "fun": lambda z, a=a: 1 - a - z[0]},
            {
                "type": "ineq",
                "fun": lambda z, a=a, b=b: 2 * (2 - a * a - b * b) - 2 * (a * z[0] + b * z[1]),
            },
        ]
        reference = scipy.optimize.minimize(
            cost,
            [0, 0, 1],
            constraints=constraints,
            bounds=[(-3, 3), (-3, 3), (0, None)],
            options={"ftol": 1e-13, "maxiter": 300},
        )
        np.testing.assert_allclose(batch.action[i], reference.x[:2], atol=2e-5)
        np.testing.assert_allclose(
            safety_filter.filter(state, proposed).action, batch.action[i], atol=1e-7
        )
    assert goal.slack_weight == 3.0


def test_joint_program_of_one_input_is_the_filter_over_the_goals_controller():
    # The cost is convex in a single input, so that its minimiser on an interval is the nearest
    # point of it.
    for env_id in ("safe_envs/ACC-v0", "safe_envs/CubicSDE-v0"):
        problem = problem_of(env_id)
        rng = np.random.default_rng(1)
        low, high = (
            ([5, 5, 5], [25, 25, 60]) if problem.name == "ACC" else ([-1.5, -1.5], [0.5, 1.5])
        )
        states = rng.uniform(low, high, (200, problem.plant.n))
        nearest = SafetyFilter.for_problem(problem, SCBF())
        both = SafetyFilter.for_problem(problem, SCBF(), objective="clf")
        actions, _ = CLFController(problem).predict(states)
        high = problem.box[0][1]
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


def test_barrier_slack_is_dearer_than_any_goal():
    # The goal pulls with a huge weight to where the contradicting rows are missed more.
    rows = [(Barrier(x - 0.5), CBF(1.0)), (Barrier(-0.5 - x), CBF(1.0))]
    for weight in (1e-6, 1.0, 1e6):
        _, safety_filter = joint(rows=rows, slack_weight=weight)
        for state in ([0.2, 0.3], [[0.2, 0.3]]):
            result = safety_filter.filter(np.array(state), np.zeros_like(state))
            # u >= .5 - .2 and u <= -.5 - .2: equal slacks in the middle.
            np.testing.assert_allclose(np.ravel(result.action)[0], -0.2, atol=1e-6)
            np.testing.assert_allclose(np.ravel(result.slack), [0.5, 0.5], atol=1e-6)
            assert not np.any(result.feasible)


def test_goals_are_checked():
    with pytest.raises(ConfigurationError, match="weights of a joint QP"):
        SafetyFilter(
            plane(),
            [(Barrier(1 - x), CBF(1.0))],
            bounds=[(-1.0, 1.0)] * 2,
            weights=[1.0, 1.0],
            clf=CLF(x**2),
        )
    with pytest.raises(ConfigurationError, match="Pendulum has no control Lyapunov function"):
        SafetyFilter.for_problem(problem_of("safe_envs/Pendulum-v0"), SCBF(), objective="clf")
    with pytest.raises(ConfigurationError, match="objective = 'clff'; did you mean 'clf'"):
        SafetyFilter.for_problem(problem_of("safe_envs/ACC-v0"), SCBF(), objective="clff")
    with pytest.raises(ConfigurationError, match="positive"):
        SafetyFilter(
            plane(),
            [(Barrier(1 - x), CBF(1.0))],
            bounds=[(-1.0, 1.0)] * 2,
            clf=CLF(x**2, slack_weight=0.0),
        )
    with pytest.raises(ConfigurationError, match="no control Lyapunov function"):
        CLFController(problem_of("safe_envs/Scalar-v0"))
    with pytest.raises(ConfigurationError, match="does not hold theta"):
        CLFController(problem_of("safe_envs/DubinsDisk-v0"), CLF(x**2))
    with pytest.raises(InvalidInputError):
        CLFController(problem_of("safe_envs/ACC-v0")).predict(np.zeros(2))


def test_priorities_say_which_row_gives_way():
    rows = [(Barrier(x - 0.5), CBF(1.0)), (Barrier(-0.5 - x), CBF(1.0))]
    for priorities, action in (
        (None, 0.0),
        ((1.0, 1.0), 0.0),
        ((3.0, 1.0), 0.25),
        ((1.0, 9.0), -0.4),
    ):
        safety_filter = SafetyFilter(
            integrator(), rows, bounds=[(-3.0, 3.0)], priorities=priorities
        )
        for state in ([0.0], [[0.0]]):
            result = safety_filter.filter(state, np.full_like(state, 2.0))
            np.testing.assert_allclose(np.ravel(result.action), [action], atol=1e-9)
            np.testing.assert_allclose(
                np.ravel(result.slack), [0.5 - action, 0.5 + action], atol=1e-9
            )
    for wrong in ((1.0,), (1.0, 0.0), (1.0, np.nan)):
        with pytest.raises(ConfigurationError, match="priorities"):
            SafetyFilter(integrator(), rows, bounds=[(-3.0, 3.0)], priorities=wrong)


def test_cause_is_the_active_row_furthest_from_the_proposal():
    rows = [(Barrier(1 - x), CBF(1.0)), (Barrier(2 - x), CBF(1.0)), (Barrier(x + 1), CBF(1.0))]
    safety_filter = SafetyFilter(integrator(), rows, bounds=[(-9.0, 9.0)])
    states, inputs = np.zeros((4, 1)), np.array([[5.0], [0.5], [-7.0], [1.5]])
    assert safety_filter.filter(states, inputs).cause.tolist() == [0, -1, 2, 0]
    assert [safety_filter.filter(s, v).cause for s, v in zip(states, inputs, strict=True)] == [
        0,
        -1,
        2,
        0,
    ]
    flat = ControlAffineSDE((x, y), (u,), [-1, 0], [0, 1], [0, 0])
    both = SafetyFilter(
        flat, [(Barrier(y + 0.5), CBF(1.0)), (Barrier(1 - y), CBF(1.0))], bounds=[(-9.0, 9.0)]
    )
    assert both.filter([0.0, 0.0], [4.0]).cause == 1


@pytest.mark.parametrize(
    "condition",
    [
        SRCBF(),
        SZCBF((1.0,)),
        SCBF(sampling_margin="first-order"),
        SRCBF(sampling_margin="first-order"),
    ],
)
@pytest.mark.parametrize("objective", ["nearest", "clf"])
def test_floats_equal_arrays_for_every_kind_of_program(condition, objective):
    problem = problem_of("safe_envs/ACC-v0")
    safety_filter = SafetyFilter.for_problem(problem, condition, objective=objective)
    rng = np.random.default_rng(3)
    states = np.array([20.0, 20.0, 36.0]) + rng.uniform(-3, 3, (60, 3))  # on both sides of the edge
    inputs = rng.uniform(-6000, 6000, (60, 1))
    batch = safety_filter.filter(states, inputs)
    assert batch.active.sum() > 0
    for i in range(60):
        single = safety_filter.filter(states[i], inputs[i])
        for ours, theirs in zip(single, batch, strict=True):
            np.testing.assert_allclose(ours, theirs[i], rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("text", ["rcbf", "rcbf:form=log", "srcbf", "srcbf:form=log"])
def test_reciprocal_rows_with_a_margin_on_both_sides_of_the_edge(text):
    problem = problem_of("safe_envs/Scalar-v0", noise=0.2)
    (condition,) = parse_conditions(f"{text}:sampling_margin=first-order", problem)
    safety_filter = SafetyFilter.for_problem(problem, condition)
    states = np.array([[-1.0], [0.5], [0.9], [1.0 - 1e-12], [1.0], [1.3]])
    batch = safety_filter.filter(states, np.full((6, 1), 8.0))
    for i, state in enumerate(states):
        single = safety_filter.filter(state, [8.0])
        np.testing.assert_allclose(single.action, batch.action[i], rtol=1e-9)
        assert single.feasible == batch.feasible[i]
    assert batch.action[-2:, 0].tolist() == [-10.0, -10.0]
    assert not batch.feasible[-2:].any()


def test_margin_of_a_reciprocal_row_takes_its_demand_into_account():
    # x' = x + u, h = 1 - x, B = 1/h: psi = -(x + u) + h^3, psi' = -(x + u)(1 + 3 h^2).
    system = ControlAffineSDE((x,), (u,), [x], [1], [0])
    found = RCBF(sampling_margin="first-order").constraint(system, Barrier(1 - x))
    expected = -(x + u) * (1 + 3 * (1 - x) ** 2)
    assert sp.simplify(sp.nsimplify(found.change) - expected) == 0


def test_a_condition_without_meaning_does_not_harm_another_barrier():
    # y is beyond its edge, x is not: y is to fall as fast as x allows, however wide the box.
    both = ControlAffineSDE((x, y), (u,), [0, 0], [1, 1], [0, 0])
    for half in (10.0, 1e6):
        safety_filter = SafetyFilter(
            both, [(Barrier(x), CBF(1.0)), (Barrier(-y), RCBF())], bounds=[(-half, half)]
        )
        for state in ([0.1, 1.0], [[0.1, 1.0]]):
            result = safety_filter.filter(np.array(state), np.zeros((*np.shape(state)[:-1], 1)))
            np.testing.assert_allclose(np.ravel(result.action), [-0.1], atol=1e-9)
            assert np.ravel(result.slack)[0] == pytest.approx(0.0, abs=1e-9)
            assert np.ravel(result.cause) == [1]
            assert not np.any(result.feasible)


def test_cause_is_measured_in_the_weighted_distance():
    rows = [(Barrier(1 - x), CBF(1.0)), (Barrier(0.5 - y), CBF(1.0))]
    proposal = np.array([4.0, 3.0])  # 3 beyond the first row, 2.5 beyond the second
    for weights, cause in ((None, 0), ([1.0, 4.0], 1)):
        safety_filter = SafetyFilter(plane(), rows, bounds=[(-9.0, 9.0)] * 2, weights=weights)
        assert safety_filter.filter(np.zeros(2), proposal).cause == cause
        assert safety_filter.filter(np.zeros((1, 2)), proposal[None]).cause.tolist() == [cause]
    alone = SafetyFilter(plane(), rows[:1], bounds=[(-9.0, 9.0)] * 2)
    assert alone.filter(np.zeros(2), np.zeros(2)).cause == -1
    assert alone.filter(np.zeros((2, 2)), np.array([[0.0, 0.0], [4.0, 0.0]])).cause.tolist() == [
        -1,
        0,
    ]


def test_cause_is_a_distance_and_not_a_miss_of_the_row():
    # u + w <= 1 is missed by 3 and lies 3/sqrt(2) = 2.1 off, w <= .5 by 2; and with a row half as
    # steep, 1 and 2 against 1.5.
    for first, proposals in (
        (1 - x - y, ([1.5, 2.5], [1.0, 2.5])),
        (1 - 0.5 * x, ([4.0, 2.0], [4.0, 2.9])),
    ):
        safety_filter = SafetyFilter(
            plane(),
            [(Barrier(first), CBF(1.0)), (Barrier(0.5 - y), CBF(1.0))],
            bounds=[(-9.0, 9.0)] * 2,
        )
        for cause, proposal in enumerate(proposals):
            assert safety_filter.filter(np.zeros(2), proposal).active.all()
            assert safety_filter.filter(np.zeros(2), proposal).cause == cause
            assert safety_filter.filter(np.zeros((1, 2)), [proposal]).cause.tolist() == [cause]


@dataclass(frozen=True)
class Doubtful(CBF):
    """A row that is known up to an error, whose form is as given."""

    form: tuple[Any, ...] = ()

    def derived(self, model, barrier):
        return replace(
            super().derived(model, barrier), uncertainty=tuple(map(sp.sympify, self.form))
        )


def test_an_uncertainty_with_constant_entries_follows_the_state_all_the_same():
    # 1 - x - u >= |x| in the box of u, and w has no part: entries (0, 0), (0, u), (0, w), (u, u),
    # (u, w), (w, w).
    safety_filter = SafetyFilter(
        plane(),
        [(Barrier(1 - x), Doubtful(1.0, form=(x**2, 0, 0, 0, 0, 0)))],
        bounds=[(-9.0, 9.0)] * 2,
    )
    for state, largest in ((0.0, 1.0), (0.5, 0.0), (-0.5, 1.0), (0.25, 0.5)):
        np.testing.assert_allclose(
            safety_filter.filter([state, 0.0], [5.0, 0.3]).action, [largest, 0.3], atol=1e-14
        )
        np.testing.assert_allclose(
            safety_filter.filter([[state, 0.0]], [[5.0, 0.3]]).action, [[largest, 0.3]], atol=1e-14
        )


def test_a_loss_without_a_value_is_an_error():
    # psi = sqrt(x) - u with x' = u has the rate u/(2 sqrt(x)) - ..., which is infinite at 0, where
    # the row itself is finite.
    row = [(Barrier(1 - x), Rooted(1.0, sampling_margin="first-order"))]
    safety_filter = SafetyFilter(integrator(), row, bounds=[(-9.0, 9.0)], dt=0.1)
    for state in ([0.0], [[0.25], [0.0]]):
        with pytest.raises(NumericalError, match="no finite value at x = 0"):
            safety_filter.filter(state, np.full_like(state, -1.0))


@dataclass(frozen=True)
class Rooted(CBF):
    """A row with a root of the state in it."""

    def derived(self, model, barrier):
        found = super().derived(model, barrier)
        return replace(found, offset=sp.sqrt(x))


def test_goals_are_checked_for_their_symbols():
    q = sp.Symbol("q", real=True)
    row = [(Barrier(1 - x), CBF(1.0))]
    for goal in (CLF(q**2), CLF(x**2, input_weight=q)):
        with pytest.raises(SystemDefinitionError, match="unknown symbol q"):
            SafetyFilter(plane(), row, bounds=[(-1.0, 1.0)] * 2, clf=goal)
    for rate in (-1.0, float("nan")):
        with pytest.raises(ConfigurationError, match="rate"):
            CLF(x**2, rate=rate)
    undefined = SafetyFilter(plane(), row, bounds=[(-1.0, 1.0)] * 2, clf=CLF(1 / x))
    with pytest.raises(NumericalError, match=r"the goal has no finite value at x = 0"):
        undefined.filter(np.zeros(2), np.zeros(2))
    with pytest.raises(NumericalError, match=r"the goal has no finite value at x = 0"):
        undefined.filter(np.zeros((1, 2)), np.zeros((1, 2)))
