"""A margin of first order holds at the input to which it leads."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, define_problem
from safe_envs.agents import evaluate
from safe_envs.dynamics.codegen import compile_function
from safe_envs.wrappers import SafetyFilter
from tests.oracles.programs import decision_of

x, v, y, w, u, a = sp.symbols("x v y w u a", real=True)
CART = ControlAffineSDE.from_rate((x, v), (u,), [v, u])
POINT = ControlAffineSDE.from_rate((x, v, y, w), (u, a), [v, u, w, a])
MARGIN = "cbf:alpha=1:sampling_margin=first-order"
DT = 0.1


def rows_of(safety_filter, states, inputs):
    """Both rows of each constraint, of shape (2 k, B, U), for every input (U, m) at states (B, n).

    They are the constraint, and what becomes of it within the period at its rate of change.
    """
    model, found = safety_filter.model, []
    at = [c[:, None] for c in states.T] + [c[None] for c in inputs.T]
    for c in safety_filter.constraints:
        row = c.offset + sum(e * s for e, s in zip(c.coefficient, model.inputs, strict=True))
        for expression in (row, row + safety_filter.qp.dt * c.change):
            number = model.numeric(expression)
            shape = len(states), len(inputs)
            (value,) = compile_function((*model.states, *model.inputs), [number], "arrays")(*at)
            found.append(np.broadcast_to(value, shape))
    return np.array(found)


def random_barriers(rng, states, count):
    """Random quadratic functions, of which some are convex and some are concave."""
    z = sp.Matrix(states)
    for _ in range(count):
        bend, slope = rng.normal(size=(z.rows, z.rows)), rng.normal(size=(1, z.rows))
        yield rng.uniform(0.2, 1.5) + (z.T * sp.Matrix(bend) * z + sp.Matrix(slope) * z)[0]


def test_a_harmless_input_stays_harmless():
    # psi = .6975 - .1 u and psi' = -.055 - 1.1 u - 2 u^2: at the proposed input psi would fall by
    # 2.1, so that no input but one far off has such a reserve at its own psi.
    safety_filter = SafetyFilter(CART, 1 - x**2 - v**2, MARGIN, input_bounds=(-20, 20), dt=DT)
    state, nominal = np.array([0.5, 0.05]), np.array([3.0])
    root = (-0.21 + (0.21**2 + 4 * 0.2 * 0.692) ** 0.5) / 0.4
    one, batch = safety_filter.filter(state, nominal), safety_filter.filter([state], [nominal])
    program = decision_of(safety_filter)(state, nominal)
    for action in (one.action[0], batch.action[0, 0], program.action[0]):
        assert action == pytest.approx(root, rel=1e-8)
    assert one.feasible
    assert one.active.all()
    at = [state[0] + DT * state[1] + DT**2 * root / 2, state[1] + DT * root]
    assert 1 - np.dot(at, at) > 0.70
    for harmless in (-2.0, 0.0, 1.4):
        assert safety_filter.filter(state, [harmless]).action == [harmless]


@pytest.mark.parametrize("seed", [0, 3])
def test_one_input_is_the_nearest_at_which_all_constraints_hold(seed):
    rng = np.random.default_rng(seed)
    barriers = list(random_barriers(rng, (x, v), 1 + seed % 2))
    safety_filter = SafetyFilter(CART, barriers, MARGIN, input_bounds=(-6, 6), dt=DT)
    states, nominal = rng.normal(0.0, 0.6, (150, 2)), rng.uniform(-7, 7, (150, 1))
    found = safety_filter.filter(states, nominal)
    grid = np.linspace(-6, 6, 12001)
    held = (rows_of(safety_filter, states, grid[:, None]) >= 0.0).all(axis=0)
    solvable = held.any(axis=1)
    assert solvable.sum() > 30
    distance = np.where(held, abs(grid - nominal), np.inf).min(axis=1)
    assert found.feasible[solvable].all()
    ours = abs(found.action - nominal)[:, 0]
    np.testing.assert_array_less(ours[solvable], distance[solvable] + 1e-5)
    # The margin holds at the executed input itself, wherever the filter says so.
    pairs = zip(states[:, None], found.action[:, None], strict=True)
    reached = [rows_of(safety_filter, *pair) for pair in pairs]
    assert (np.min(reached, axis=(1, 2, 3))[found.feasible] > -1e-12).all()
    assert (abs(found.action) <= 6.0).all()


@pytest.mark.parametrize("seed", [0, 1])
def test_several_inputs_end_at_one_that_has_been_checked(seed):
    rng = np.random.default_rng(seed)
    barriers = [2 - x**2 - v**2 - y**2 - w**2, *random_barriers(rng, (x, v, y, w), seed)]
    safety_filter = SafetyFilter(POINT, barriers, MARGIN, input_bounds=(-6, 6), dt=DT)
    states, nominal = rng.normal(0.0, 0.5, (80, 4)), rng.uniform(-9, 9, (80, 2))
    found = safety_filter.filter(states, nominal)
    axis = np.linspace(-6, 6, 121)
    grid = np.array(list(itertools.product(axis, axis)))
    values = rows_of(safety_filter, states, grid)
    solvable = (values >= 0.0).all(axis=0).any(axis=1)
    assert solvable.sum() > 10
    assert found.feasible[solvable].mean() > 0.95
    pairs = zip(states[:, None], found.action[:, None], strict=True)
    reached = [rows_of(safety_filter, *pair) for pair in pairs]
    assert (np.min(reached, axis=(1, 2, 3))[found.feasible] > -1e-12).all()
    # Where none holds, the squared violations are about as small as on the grid.
    lost = ~solvable & ~found.feasible
    least = (np.minimum(values, 0.0) ** 2).sum(axis=0).min(axis=1)[lost]
    ours = (np.minimum(np.squeeze(reached, (2, 3)), 0.0) ** 2).sum(axis=1)[lost]
    assert (ours < 2.5 * least + 1e-3).all()
    decide = decision_of(safety_filter)
    for i in range(40):
        single = safety_filter.filter(states[i], nominal[i])
        np.testing.assert_allclose(single.action, found.action[i], atol=1e-6)
        np.testing.assert_allclose(decide(states[i], nominal[i]).action, found.action[i], atol=1e-6)


def test_where_no_input_holds_the_filter_says_so():
    # Inwards by no more than what the bounds allow: psi = -2 x v - 2 v u + h stays negative.
    safety_filter = SafetyFilter(CART, 1 - x**2 - v**2, MARGIN, input_bounds=(-0.3, 1), dt=DT)
    found = safety_filter.filter([0.5, 0.85], [0.5])
    assert not found.feasible
    assert found.action == [-0.3]
    worst = rows_of(safety_filter, np.array([[0.5, 0.85]]), np.array([[-0.3]])).min()
    assert found.slack == pytest.approx([-worst], rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("policy", "alpha", "half"), [("zero", 5, 10.0), ("nominal", 1, 30.0)])
def test_a_cart_pole_at_15_hz_is_no_less_safe_with_the_margin(policy, alpha, half, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples"))
    monkeypatch.delitem(sys.modules, "cart_pole", raising=False)
    import cart_pole as example

    theta, omega = example.theta, example.omega
    problem = define_problem(
        example.cart_pole,
        1 - (theta / 0.2) ** 2 - omega**2,
        input_bounds=(-half, half),
        start=[(-0.3, 0.3), (-0.3, 0.3), (-0.05, 0.05), (-0.1, 0.1)],
        dt=1 / 15,
        horizon=5.0,
        nominal=60 * theta + 14 * omega + 6 * example.x + 8 * example.v,
        gains=(2.0,),
    ).configured(noise=0.0)
    text = f"cbf:alpha={alpha}"
    rows = evaluate(
        problem, policy, [text, f"{text}:sampling_margin=first-order"], episodes=40, bounds=False
    ).rows
    assert rows[1].safe == 40 >= rows[0].safe
