"""Envelopes lie around exact values: by quadrature, products, simulation and in hostile cases."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, ControlAffineSDE, SystemDefinitionError, state_problem
from safe_envs.values.look_ahead import LookAhead
from safe_envs.values.solve import solve
from safe_envs.values.tables import ValueSettings
from tests.values.systems import (
    quadrature,
    require_around,
    require_promised,
    row,
    s,
    scalar,
    solved,
    u,
    v,
    x,
    y,
)

SCANNED = np.linspace(-1.0, 1.0, 5)


@pytest.mark.parametrize("drift", [0, x * (1 - x), sp.sin(3 * x)])
@pytest.mark.parametrize("leaving", ["violation", "safe"])
def test_envelopes_lie_around_the_value_and_close_in(drift, leaving):
    problem = scalar(drift)
    beyond = (2.0, np.inf) if leaving == "safe" else None
    q, exact = quadrature(problem, SCANNED, (0.0, 2.0), beyond)
    _, most = quadrature(problem, np.linspace(-1, 1, 9), (0.0, 2.0), beyond)
    gaps = [
        require_around(solved(problem, count, inputs=5, leaving=leaving), q, exact, most)
        for count in (40, 160)
    ]
    # The error is of first order; that of five inputs stays.
    assert gaps[1] < 0.5 * gaps[0]


@pytest.mark.parametrize("sigma", [0.2 + 0.3 * x**2, 0.5 * sp.exp(-x)])
def test_noise_that_depends_on_the_state(sigma):
    problem = scalar(-x, sigma)
    q, exact = quadrature(problem, SCANNED, (0.0, 2.0))
    table = solved(problem, 150, inputs=5)
    assert require_around(table, q, exact, exact) < 0.4
    require_promised(problem, table)


@pytest.mark.filterwarnings("ignore:the input bounds")
@pytest.mark.parametrize("size", [0.15, 0.6, 30.0])
def test_noise_on_a_periodic_axis(size):
    problem = scalar(
        0.5 * sp.sin(x),
        barriers=sp.cos(x) + 0.5,
        workspace={},
        units={x: "rad"},
        s=size,
        start=(0.1,),
    )
    edge = math.acos(-0.5)
    q, exact = quadrature(problem, SCANNED, (-edge, edge), period=2 * math.pi)
    table = solved(problem, 150, inputs=5)
    assert table.grid.axes[0].period == pytest.approx(2 * math.pi)
    assert require_around(table, q, exact, exact) < 0.2
    require_promised(problem, table)


def test_a_safe_set_that_the_angle_s_end_cuts():
    problem = scalar(
        0, barriers=-0.5 - sp.cos(x), workspace={}, units={x: "rad"}, start=(3.0,), s=0.5
    )
    edge = math.acos(-0.5)
    q, exact = quadrature(problem, SCANNED, (edge, 2 * math.pi - edge), period=2 * math.pi)
    assert require_around(solved(problem, 150, inputs=5), q, exact, exact) < 0.2


def test_robust_envelopes_are_below_those_of_every_parameter():
    problem = scalar(-s * x, 0.3, s=1.0)
    robust = solved(problem, 120, inputs=5, intervals={"s": (0.0, 2.0)})
    for value in (0.0, 0.7, 2.0):
        q, exact = quadrature(scalar(-s * x, 0.3, s=value), SCANNED, (0.0, 2.0))
        require_around(robust, q, exact, exact)


def test_robust_against_the_size_of_the_noise():
    robust = solved(scalar(), 120, inputs=5, intervals={"s": (0.2, 0.5)})
    for value in (0.2, 0.35, 0.5):
        q, exact = quadrature(scalar(s=value), SCANNED, (0.0, 2.0))
        require_around(robust, q, exact, exact)


def deterministic(**options):
    """Return dx = -x^2 + u (1 + x), whose best input for h = x - 0.3 is the largest one."""
    system = ControlAffineSDE(
        states=[x], inputs=[u], drift=[-(x**2) - 0.5], input_matrix=[[1 + x]], diffusion=[[0]]
    )
    given = {"box": (0.0, 0.4), "start": (1.0,), "dt": 0.1, "horizon": 2.0, **options}
    return state_problem(system, x - 0.3, workspace={x: (-1.0, 2.0)}, name="braking", **given)


def test_without_noise_a_step_of_runge_and_kutta():
    problem = deterministic()
    table = solved(problem, 400, inputs=5)
    ahead = LookAhead(table, problem)
    rate = lambda at: -(at**2) - 0.5 + 0.4 * (1 + at)  # noqa: E731
    start = np.linspace(0.301, 1.99, 300)
    at, safe = start, np.full(start.shape, True)
    h = problem.dt
    for _ in range(problem.steps):
        a = rate(at)
        b = rate(at + 0.5 * h * a)
        c = rate(at + 0.5 * h * b)
        at = at + h / 6 * (a + 2 * b + 2 * c + rate(at + h * c))
        safe &= at >= 0.3
    assert 20 < safe.sum() < 280
    lower, upper = (each[table.grid.cell_of([start])] for each in row(table, 0))
    assert set(np.unique(lower)) <= {0.0, 1.0}
    assert (lower <= safe).all()
    assert (upper >= safe).all()
    assert (upper - lower).mean() < 0.15
    k = np.zeros(300, dtype=int)
    assert (ahead.values(k, (start,)) <= ahead.scanned(k, (start,)).max(axis=1)).all()


def plane(barriers=(x, y), **options):
    """Return two systems side by side."""
    system = ControlAffineSDE(
        states=[x, y],
        inputs=[u, v],
        drift=[0, -y / 2],
        input_matrix=sp.eye(2),
        diffusion=sp.diag(s, sp.Rational(3, 10)),
        parameters={s: 0.4},
    )
    given = {
        "box": (-1.0, 1.0),
        "start": (0.5, 0.5),
        "dt": 0.1,
        "horizon": 0.4,
        "workspace": {x: (-1.0, 2.0), y: (-1.0, 1.5)},
        **options,
    }
    return state_problem(system, list(barriers), name="plane", **given)


def test_the_value_of_a_product_is_the_product_of_values():
    problem = plane()
    table = solved(problem, 50, 50, inputs=3)
    tried = np.linspace(-1, 1, 3)
    p, first = quadrature(scalar(horizon=0.4), tried, (0.0, 2.0), nodes=60)
    r, second = quadrature(scalar(-x / 2, 0.3, horizon=0.4), tried, (0.0, 1.5), nodes=60)
    p, r = (each.ravel() for each in np.meshgrid(p, r, indexing="ij"))
    cells = table.grid.cell_of([p, r])
    for k in range(problem.steps + 1):
        exact = np.outer(first[k], second[k]).ravel()
        lower, upper = (each[cells] for each in row(table, k))
        assert (lower <= exact + 1e-9).all()
        assert (exact <= upper + 1e-9).all()
    assert (upper - lower).mean() < 0.2
    require_promised(problem, table)


@pytest.mark.parametrize(
    ("harder", "easier"),
    [
        (scalar(), scalar(box=(-1.5, 1.5))),
        (scalar(s=0.6), scalar(s=0.3)),
        (scalar(horizon=2.0), scalar()),
        (scalar(barriers=x - sp.Rational(1, 5)), scalar()),
    ],
)
def test_what_is_easier_has_the_larger_value(harder, easier):
    tables = [solved(problem, 120) for problem in (harder, easier)]
    q = [np.linspace(0.25, 1.95, 50)]
    low, high = ([e[t.grid.cell_of(q)] for e in row(t, 0)] for t in tables)
    assert (low[0] <= high[1]).all()
    assert low[0].mean() <= low[1].mean()
    assert high[0].mean() < high[1].mean() + 1e-9


def test_values_do_not_rise_backwards_in_time():
    for leaving in ("violation", "safe"):
        table = solved(scalar(horizon=2.0), 80, leaving=leaving)
        assert (np.diff(table.upper, axis=0) >= 0).all()
        assert (np.diff(table.lower, axis=0) >= -0.003).all()
        assert (table.lower <= table.upper).all()
        assert table.lower.min() >= 0
        assert table.upper.max() <= 1


def test_values_that_no_longer_change_are_kept_once():
    problem = scalar(-10 * x, 0, barriers=1 - x, horizon=5.0, s=0)
    table = solved(problem, 60)
    assert table.first > 0
    assert table.steps == problem.steps
    ahead = LookAhead(table, problem)
    np.testing.assert_array_equal(ahead.values(np.array([0, 3]), (np.full(2, 0.2),)), [1, 1])


def test_leaving_the_workspace_counts_as_said():
    problem = scalar(3, s=0.2)
    staying, left = (solved(problem, 100, leaving=each) for each in ("violation", "safe"))
    at = (np.array([0.8]),)
    assert LookAhead(staying, problem).start_bounds(at)[1] < 0.05
    assert LookAhead(left, problem).start_bounds(at)[0] > 0.95


def test_leaving_beyond_another_end_of_the_safe_set():
    # The corner beyond x = 1 is safe only where y has left its workspace.
    problem = plane(
        [sp.Max(1 - x, y - 1)],
        workspace={x: (-2.0, 2.0), y: (-1.0, 1.0)},
        box=(3.0, 8.0),
        horizon=0.3,
    )
    table = solved(problem, 30, 30, leaving="safe", inputs=3)
    at = (np.array([0.9]), np.array([0.7]))
    low, high = LookAhead(table, problem).start_bounds(at)
    assert low > 0.5
    assert high > 0.99


def test_a_step_that_may_lead_anywhere_is_refused_where_leaving_is_safe():
    with pytest.raises(ConfigurationError, match="very far out"):
        solved(scalar(1 / x), 20, leaving="safe")


def test_the_goal_ends_an_episode():
    problem = replace(scalar(-3, s=0.2), goal=sp.Rational(1, 2) - x)
    table = solved(problem, 100)
    lower, upper = row(table, 0)
    middle = 0.5 * (table.grid.axes[0].edges[:-1] + table.grid.axes[0].edges[1:])
    inside = (middle > 0.02) & (middle < 0.45)
    assert (lower[inside] == 1).all()
    assert (upper[inside] == 1).all()
    # A cell that the goal's edge cuts counts for the upper envelope alone.
    cut = table.grid.cell_of([np.array([0.5 - 1e-9, 0.5 + 1e-9])])
    assert (upper[cut] == 1).all()
    # Without the goal the drift leads out of the safe set.
    assert row(solved(replace(problem, goal=None), 100), 0)[1][inside].max() < 0.1
    require_promised(problem, table)


@pytest.mark.filterwarnings("ignore:the input bounds")
@pytest.mark.parametrize("count", [5, 60])
@pytest.mark.parametrize(
    "given",
    [
        {"s": 1e-3},
        {"s": 1e-9},
        {"s": 40.0},
        {"s": 1e4},
        {"gain": 1e-9},
        {"drift": 30},
        {"drift": 1e6 * x},
        {"barriers": (x - 1) ** 2 - sp.Rational(1, 4), "start": (0.2,)},
        {"barriers": x + 1},
        {"barriers": 2 - x},
        {"barriers": 1e-6 - (x - sp.Rational(1, 3)) ** 2, "start": (1 / 3,)},
        {"barriers": sp.Abs(x) - sp.Rational(1, 10)},
        {"barriers": sp.Max(x, sp.Rational(-1, 2))},
    ],
)
def test_hostile_problems(given, count):
    problem = scalar(horizon=0.5, **given)
    table = solved(problem, count, inputs=5)
    h = sp.lambdify(x, problem.barriers[0].expression, "numpy")
    # Envelopes at random states against simulated episodes under a constant input.
    rng = np.random.default_rng(3)
    start = rng.uniform(-1, 2, 40)
    if not (h(start) >= 0).any():
        start = np.full(40, 1 / 3)
    reachable = np.zeros(40)
    drift = sp.lambdify(x, problem.plant.drift[0], "numpy")
    size, gain = given.get("s", 0.4), given.get("gain", 1)
    runs = 500
    for held in (-1.0, 1.0):
        at = np.repeat(start, runs)
        safe = (h(at) >= 0) & (at >= -1) & (at <= 2)
        for _ in range(problem.steps):
            at = at + 0.1 * (drift(at) + gain * held)
            at = np.clip(at + size * math.sqrt(0.1) * rng.normal(size=at.size), -1e9, 1e9)
            safe &= (h(at) >= 0) & (at >= -1) & (at <= 2)
        reachable = np.maximum(reachable, safe.reshape(40, runs).mean(axis=1))
    k = np.zeros(40, dtype=int)
    lower = LookAhead(table, problem).start_bounds((start,))[1]
    margin = 4 * np.sqrt(0.25 / runs)
    assert (lower >= reachable - margin).all()
    cells = table.grid.cell_of([start])
    upper = np.where(cells >= 0, row(table, 0)[1][cells], 0)
    assert (upper >= reachable - margin).all()
    assert (LookAhead(table, problem).values(k, (start,)) <= upper).all()


def test_a_step_without_a_finite_value_somewhere():
    # 1/x has no bound where the safe set begins: what the model makes of it counts as anything.
    problem = scalar(1 / x, box=(-1, 1), horizon=0.3)
    table = solved(problem, 50)
    lower, upper = row(table, 0)
    assert (lower <= upper).all()
    assert upper[table.grid.cell_of([np.array([1e-12])])] > 0.9
    effect = scalar(0, gain=1 / x, horizon=0.3)
    table = solved(effect, 50)
    assert np.isfinite(table.lower).all()
    assert row(table, 0)[1][table.grid.cell_of([np.array([1e-3])])] > 0.4


def test_zero_of_the_barrier_is_neither_promised_nor_excluded():
    # An evaluation counts h > 0 as safe, the info of an env h >= 0: here h = 0 below 1.2.
    problem = scalar(0, 0, barriers=sp.Max(x - 1.2, 0), horizon=0.2, start=(1.5,))
    ahead = LookAhead(solved(problem, 30), problem)
    low, high = ahead.start_bounds((np.array([1.5, 0.5]),))
    np.testing.assert_array_equal(low, [1, 0])
    np.testing.assert_array_equal(high, [1, 1])


def test_what_no_table_can_hold_is_refused():
    with pytest.raises(ConfigurationError, match="workspace"):
        solved(scalar(workspace={}), 10)
    with pytest.raises(ConfigurationError, match="has the coordinates x"):
        solved(scalar(), 10, 10)
    with pytest.raises(ConfigurationError, match="memory"):
        solved(scalar(), 10**7, memory=1e6)
    with pytest.raises(ConfigurationError, match="memory"):
        # The tables alone would fit, but not where all the cells lead under all the inputs.
        solved(deterministic(), 20_000, inputs=2000, memory=1e9)
    with pytest.raises(ConfigurationError, match="at most 100000"):
        solved(plane(), 10, 10, inputs=1000)
    with pytest.raises(SystemDefinitionError, match="Piecewise"):
        solved(scalar(barriers=sp.Piecewise((x, x > 1), (x / 2, True))), 10)


def test_several_sub_steps_are_refused():
    with pytest.raises(ConfigurationError, match="substeps = 1"):
        solved(scalar(substeps=2), 10)


def test_progress_is_told():
    done = []
    solve(scalar(), ValueSettings(cells=(10,)), done.append)
    assert done == sorted(done)
    assert done[-1] == 1
