"""The look-ahead at a state never falls below its cell's value, and follows a good policy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy as sp
from scipy.special import ndtr

from safe_envs import ConfigurationError, ControlAffineSDE, state_problem
from safe_envs.agents.evaluation.statistics import wilson_interval
from safe_envs.dynamics.integrators import Integrator
from safe_envs.values.look_ahead import LookAhead
from safe_envs.values.promise_filter import PromiseFilter, PromiseMemory, PromiseSettings
from safe_envs.values.reduction import reduced
from tests.values.systems import (
    pursued,
    random_states,
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


def timed(**options):
    """Return a system whose drift changes with a known state."""
    system = ControlAffineSDE(
        states=[x, y],
        inputs=[u],
        drift=[sp.sin(3 * y), 1],
        input_matrix=[[1], [0]],
        diffusion=[[s], [0]],
        parameters={s: 0.3},
    )
    return state_problem(
        system,
        x,
        box=(-0.5, 0.5),
        start=(0.6, 0.0),
        dt=0.1,
        horizon=1.5,
        workspace={x: (-1.0, 1.5)},
        name="timed",
        filter="scbf",
        **options,
    )


PROBLEMS = {
    "scalar": scalar(),
    "goal": replace(scalar(-1), goal=sp.Rational(1, 5) - x),
    "pursued": pursued(),
    "timed": timed(),
    "state-dependent": scalar(-x, 0.2 + 0.3 * x),
}


@pytest.fixture(scope="module", params=PROBLEMS)
def case(request):
    problem = PROBLEMS[request.param]
    table = solved(problem, 100, inputs=7)
    return problem, table, LookAhead(table, problem)


def states_of(problem, q, k=None):
    """Return states with these coordinates, and known states as they are at instants k."""
    known = reduced(problem).assumed
    k = np.zeros(len(q[0]), dtype=int) if k is None else k
    rest = iter(q)
    return tuple(known[i][k] if i in known else next(rest) for i in range(problem.plant.n))


def test_the_look_ahead_is_not_below_the_table(case):
    problem, table, ahead = case
    q = random_states(table, 400)
    q[0][:100] = table.grid.axes[0].edges[:-1][:100]
    k = np.arange(400) % table.steps
    at = states_of(problem, q, k)
    lower, scanned = ahead.values(k, at), ahead.scanned(k, at)
    _, ends = ahead.sets_at(k, at)
    assert (lower <= np.where(ends, 1.0, scanned.max(axis=1)) + 1e-7).all()
    assert (ahead.largest(k, at) >= scanned.max(axis=1) - 1e-7).all()
    assert (lower > 0).any()
    chosen, value = ahead.best_input(k, at)
    np.testing.assert_allclose(value, scanned.max(axis=1), atol=1e-8)
    np.testing.assert_allclose(ahead.expected(k, at, chosen[:, None])[:, 0], value, atol=1e-7)


def test_mixed_instants_equal_single_ones(case):
    problem, table, ahead = case
    q = random_states(table, 12, seed=1)
    k = np.arange(12) % table.steps
    at = states_of(problem, q, k)
    together = ahead.scanned(k, at)
    fresh = LookAhead(table, problem)
    for i in reversed(range(12)):
        one = fresh.scanned(k[i : i + 1], tuple(c[i : i + 1] for c in at))[0]
        np.testing.assert_array_equal(one, together[i])
    given = np.broadcast_to(ahead.inputs, (12, *ahead.inputs.shape))
    np.testing.assert_array_equal(ahead.expected(k, at, given), together)


def test_nothing_outside_has_a_value(case):
    problem, table, ahead = case
    for far in (-50.0, 50.0, np.nan, np.inf):
        q = [np.full(2, far)]
        at = states_of(problem, q)
        np.testing.assert_array_equal(ahead.values(np.array([0, table.steps]), at), 0)


def test_the_greedy_policy_keeps_what_the_table_says(case):
    problem, _, ahead = case
    episodes, rng = 3000, np.random.default_rng(5)
    start = np.array([float(e) for e in problem.starts[problem.start].state])
    at = tuple(np.full(episodes, c) for c in start)
    low, high = (float(each[0]) for each in ahead.start_bounds(tuple(c[:1] for c in at)))
    stepper = Integrator(problem.plant, problem.dt, problem.substeps, "arrays")
    safe, ended = np.full(episodes, True), np.full(episodes, False)
    for k in range(problem.steps):
        now = np.full(episodes, k)
        chosen, _ = ahead.best_input(now, at)
        inside, ends = ahead.sets_at(now, at)
        ended |= ends
        moved = stepper.step(at, tuple(chosen.T), rng.normal(size=(stepper.channels, episodes)))
        at = tuple(np.broadcast_to(c, episodes) for c in moved)
        inside, _ = ahead.sets_at(np.full(episodes, k + 1), at)
        safe &= ended | inside
    below, above = wilson_interval(int(safe.sum()), episodes, 0.9999)
    assert above >= low
    assert below <= high
    assert high - low + 0.02 > 0.01


def test_a_table_of_another_problem_is_refused():
    with pytest.raises(ConfigurationError, match="another problem"):
        LookAhead(solved(scalar(), 10), scalar(horizon=0.5))


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
    require_promised(problem, table)


def test_nothing_is_said_of_other_known_states_than_the_table_assumes():
    problem = pursued()
    ahead = LookAhead(solved(problem, 100), problem)
    # The pursuer does not begin where the table has it, but next to the start.
    k, at = np.array([0, 0, 3]), (np.full(3, 0.6), np.array([-0.8, 0.3, -0.8]))
    assert (ahead.values(k, at) > 0.0).tolist() == [True, False, False]
    assert (ahead.scanned(k, at).max(axis=1) > 0.0).tolist() == [True, False, False]
    assert (ahead.expected(k, at, np.zeros((3, 1, 1)))[:, 0] > 0.0).tolist() == [True, False, False]
    assert ahead.largest(k, at)[1:].tolist() == [1.0, 1.0]
    memory = PromiseMemory(PromiseFilter(ahead, PromiseSettings(0.5), problem), 3)
    memory.begin(at)
    assert (memory.levels > 0.0).tolist() == [True, False, True]
    assert memory.decide_arrays(at, (np.zeros(3),)).feasible.tolist() == [True, False, True]
    # Nor is the pursuer where the table has it after a step.
    memory.advance(at, False)
    assert memory.levels.tolist() == [0.0, 0.0, 0.0]


def test_known_states_count_through_others_too():
    system = ControlAffineSDE(
        states=[x, y, v],
        inputs=[u],
        drift=[0, v, 0],
        input_matrix=[[1], [0], [0]],
        diffusion=[[s], [0], [0]],
        parameters={s: 0.3},
    )
    problem = state_problem(
        system,
        (x - y) ** 2 - sp.Rational(1, 25),
        box=(-1.0, 1.0),
        start=(0.6, -0.8, 0.1),
        dt=0.1,
        horizon=0.5,
        workspace={x: (-1.0, 1.5)},
        name="slow",
        filter="scbf",
    )
    found = reduced(problem)
    at = (np.full(2, 0.6), np.full(2, -0.8), np.array([0.1, 2.0]))
    assert found.is_assumed(np.zeros(2, dtype=int), at).tolist() == [True, False]


def test_a_start_in_the_goal_is_left_by_a_step_as_in_the_env():
    problem = replace(scalar(start=(0.05,), s=1.0), goal=x + 1)
    ahead = LookAhead(solved(problem, 100), problem)
    low, high = (float(each[0]) for each in ahead.start_bounds((np.array([0.05]),)))
    # The env tells of the goal after a step, which noise takes out of the safe set.
    best = ndtr((0.05 + 0.1) / (1.0 * np.sqrt(0.1)))
    assert low <= best <= high
    assert high - low < 0.03


def test_a_table_of_other_inputs_is_refused():
    problem = scalar()
    table = solved(problem, 10)
    with pytest.raises(ConfigurationError, match="other inputs"):
        LookAhead(replace(table, inputs=table.inputs[:-1]), problem)
