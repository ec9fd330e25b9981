"""Look-ahead from exact states: starts, means over starts, known states, and a greedy policy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy as sp
from scipy.special import ndtr

from safe_envs import ConfigurationError, ControlAffineSDE, define_problem
from safe_envs.agents.evaluation.statistics import wilson_interval
from safe_envs.dynamics.integrators import Integrator
from safe_envs.values.look_ahead import LookAhead, draw_starts, start_values
from safe_envs.values.promise_filter import PromiseFilter, PromiseSettings
from safe_envs.values.smoothing import normal_above, normal_below
from tests.values.systems import pursued, quadrature, row, scalar, solved, u, v, x, y


def timed():
    """Return a system whose drift changes with a known state."""
    system = ControlAffineSDE((x, y), (u,), [sp.sin(3 * y), 1], [[1], [0]], [[0.3], [0]])
    numbers = {"input_bounds": (-0.5, 0.5), "start": (0.6, 0.0), "dt": 0.1, "horizon": 1.5}
    return define_problem(system, x, workspace={x: (-1.0, 1.5)}, name="timed", **numbers)


PROBLEMS = {
    "goal": lambda: replace(scalar(-1), goal=sp.Rational(1, 5) - x),
    "pursued": pursued,
    "timed": timed,
    "state-dependent": lambda: scalar(-x, 0.2 + 0.3 * x),
}


@pytest.fixture(scope="module", params=PROBLEMS)
def case(request):
    problem = PROBLEMS[request.param]()
    table = solved(problem, 80, inputs=7)
    return problem, table, LookAhead(table, problem)


def played(problem, ahead, episodes):
    """Return which episodes of the greedy policy are safe, and the states at each instant."""
    rng = np.random.default_rng(5)
    at = tuple(np.full(episodes, float(e)) for e in problem.starts[problem.start].state)
    stepper = Integrator(problem.plant, problem.dt, problem.substeps, "arrays")
    safe, ended, seen = np.full(episodes, True), np.full(episodes, False), [at]
    for k in range(problem.steps):
        now = np.full(episodes, k)
        chosen, _ = ahead.best_input(now, at)
        ended |= ahead.sets_at(now, at)[1]
        moved = stepper.step(at, tuple(chosen.T), rng.normal(size=(stepper.channels, episodes)))
        at = tuple(np.broadcast_to(c, episodes) for c in moved)
        safe &= ended | ahead.sets_at(now + 1, at)[0]
        seen.append(at)
    return safe, seen


def test_the_greedy_policy_keeps_what_the_table_says(case):
    problem, table, ahead = case
    episodes = 2000
    safe, seen = played(problem, ahead, episodes)
    low, high = (float(each[0]) for each in ahead.start_bounds(tuple(c[:1] for c in seen[0])))
    below, above = wilson_interval(int(safe.sum()), episodes, 0.9999)
    assert 0.0 < low <= above
    assert below <= high
    # At the states of episodes a step of look-ahead does not fall below the table.
    for k in (0, 3, problem.steps - 1):
        now, at = np.full(300, k), tuple(c[:300] for c in seen[k])
        most = ahead.scanned(now, at).max(axis=1)
        ends = ahead.sets_at(now, at)[1]
        assert (ahead.values(now, at) <= np.where(ends, 1.0, most) + 1e-7).all()
        assert (ahead.largest(now, at) >= most - 1e-7).all()
    # Nothing far outside has a value.
    for far in (-50.0, 50.0, np.nan, np.inf):
        at = (np.full(2, far), *(c[:2] for c in seen[0][1:]))
        np.testing.assert_array_equal(ahead.values(np.array([0, table.steps]), at), 0)


def test_mixed_instants_equal_single_ones(case):
    problem, table, ahead = case
    _, seen = played(problem, ahead, 2)
    k = np.array([5, 0, 2, 5, 1, 2])
    at = tuple(np.array([seen[i][j][0] for i in k]) for j in range(len(seen[0])))
    together, fresh = ahead.scanned(k, at), LookAhead(table, problem)
    for i in range(len(k)):
        one = fresh.scanned(k[i : i + 1], tuple(c[i : i + 1] for c in at))[0]
        np.testing.assert_array_equal(one, together[i])
    given = np.broadcast_to(ahead.inputs, (len(k), *ahead.inputs.shape))
    np.testing.assert_array_equal(ahead.expected(k, at, given), together)


def test_starts_at_the_ends_of_cells_and_of_the_safe_set():
    problem = scalar()
    table = solved(problem, 30)
    ahead = LookAhead(table, problem)
    edges = table.grid.axes[0].edges
    around = np.concatenate([np.nextafter(edges, -9), edges, np.nextafter(edges, 9)])
    low, high = ahead.start_bounds((around,))
    assert (low <= high).all()
    cells = table.grid.cell_of([around])
    upper = np.where(cells >= 0, row(table, 0)[1][cells], 0.0)
    safe = (around >= 0) & (around <= 2)
    assert (high[safe] <= upper[safe] + 1e-6).all()
    assert (high[around == 0] > 0).all()
    assert not low[~safe].any()


def test_nothing_is_said_of_other_known_states_than_the_table_assumes():
    problem = pursued()
    ahead = LookAhead(solved(problem, 100), problem)
    # The pursuer does not begin where the table has it, but next to the start.
    at = (np.full(2, 0.6), np.array([-0.8, 0.3]))
    low, high = ahead.start_bounds(at)
    assert (low > 0.0).tolist() == [True, False]
    assert high[1] == 1.0
    k = np.zeros(2, dtype=int)
    for values in (
        ahead.values(k, at),
        ahead.scanned(k, at).max(axis=1),
        ahead.expected(k, at, np.zeros((2, 1, 1)))[:, 0],
        PromiseFilter(ahead, PromiseSettings(0.5), problem).start(at),
    ):
        assert (values > 0.0).tolist() == [True, False]


def test_known_states_count_through_others_too():
    system = ControlAffineSDE((x, y, v), (u,), [0, v, 0], [[1], [0], [0]], [[0.3], [0], [0]])
    problem = define_problem(
        system,
        (x - y) ** 2 - sp.Rational(1, 25),
        input_bounds=(-1.0, 1.0),
        start=(0.6, -0.8, 0.1),
        dt=0.1,
        horizon=0.5,
        workspace={x: (-1.0, 1.5)},
    )
    ahead = LookAhead(solved(problem, 60, inputs=3), problem)
    low, high = ahead.start_bounds((np.full(2, 0.6), np.full(2, -0.8), np.array([0.1, 2.0])))
    assert low[0] > 0.0 == low[1]
    assert high[1] == 1.0


def test_a_start_in_the_goal_is_left_by_a_step_as_in_the_env():
    problem = replace(scalar(start=(0.05,), s=1.0), goal=x + 1)
    ahead = LookAhead(solved(problem, 100), problem)
    low, high = (float(each[0]) for each in ahead.start_bounds((np.array([0.05]),)))
    # The env tells of the goal after a step, which noise takes out of the safe set.
    best = ndtr((0.05 + 0.1) / (1.0 * np.sqrt(0.1)))
    assert low <= best <= high
    assert high - low < 0.03


@pytest.mark.parametrize("start", [0.5, (0.1, 0.8)])
def test_the_mean_over_starts(start):
    problem = scalar(start=(start,))
    ahead = LookAhead(solved(problem, 120, inputs=5), problem)
    values = start_values(ahead, problem)
    q, exact = quadrature(problem, np.linspace(-1, 1, 5), (0.0, 2.0))
    mean = np.interp(np.linspace(*np.broadcast_to(start, 2), 5000), q, exact[0]).mean()
    assert values.lower <= mean + 1e-6
    assert values.upper >= mean - 1e-6
    assert start_values(ahead, problem) == values
    if start == 0.5:
        assert (values.starts, values.margin) == (1, (0, 0))
        assert values.upper - values.lower < 0.04
        return
    assert values.starts > 1000
    assert 0 < max(values.margin) < 0.02
    lower, upper = ahead.start_bounds(draw_starts(problem, values.starts, 0))
    assert values.lower == pytest.approx(lower.mean() - values.margin[0], abs=1e-12)
    assert values.upper == pytest.approx(min(1.0, upper.mean() + values.margin[1]), abs=1e-12)


def test_starts_meet_their_condition():
    problem = scalar(start=((-0.5, 0.5),))
    (states,) = draw_starts(problem, 500, 0)
    assert states.shape == (500,)
    assert states.min() > 0
    hard = replace(problem.starts[problem.start], condition=x - 0.4999999)
    with pytest.raises(ConfigurationError, match="hardly ever"):
        draw_starts(replace(problem, starts={problem.start: hard}), 50_000, 0)


# Bounds of the normal distribution function hold it, and are next to it.


def exact(z: float) -> Any:
    with mpmath.workdps(40):
        return mpmath.ncdf(mpmath.mpf(z))


def test_they_hold_the_function():
    rng = np.random.default_rng(0)
    nodes = np.arange(-72, 73) / 8
    # The polynomial is worst halfway between two nodes.
    z = np.concatenate([rng.normal(scale=4, size=1500), nodes, nodes + 1 / 16, nodes - 1 / 16])
    z = np.append(z, [0.0, -0.0, 9.0, -9.0, np.nextafter(9, 10), np.nextafter(-9, -10), 30, -30])
    low, high = normal_below(z), normal_above(z)
    for a, b, value in zip(low, high, map(exact, z), strict=True):
        assert 0 <= a <= value <= b <= 1
    assert (high - low <= 9.1e-16).all()


def test_infinite_arguments():
    assert normal_below([-np.inf, np.inf])[0] == 0
    assert normal_above([-np.inf, np.inf])[1] == 1
