"""Filters by other solvers of QPs, beside ours."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.errors import ConfigurationError
from safe_envs.filters import other_solvers
from safe_envs.registry import make_problem
from safe_envs.wrappers import SafetyFilter
from tests.oracles.qps import QPs, filter_of, random_qps, state_of, system_of


def by(solver: str, qps: QPs, i: int) -> SafetyFilter:
    """The filter of a QP, by another solver."""
    system, pairs = system_of(*qps.a.shape[1:])
    bounds = np.stack([qps.low[i], qps.high[i]], axis=1)
    given = {"weights": qps.w[i], "priorities": qps.priority, "solver": solver}
    return SafetyFilter(system, pairs, input_bounds=bounds, **given)


@pytest.mark.parametrize("solver", ["proxqp", "daqp"])
@pytest.mark.parametrize(("k", "m"), [(1, 1), (2, 2), (3, 4)])
def test_they_are_of_the_same_opinion(solver, k, m):
    feasible = 0
    for shift in (0.0, 1.8):
        qps = random_qps(np.random.default_rng([k, m]), 12, k, m, "plain", shift)
        for i in range(len(qps.b)):
            given = state_of(qps, i), qps.v[i]
            ours, found = filter_of(qps, i).filter(*given), by(solver, qps, i).filter(*given)
            np.testing.assert_allclose(found.action, ours.action, atol=2e-4)
            assert found.feasible == ours.feasible
            assert found.active.any() == ours.active.any()
            np.testing.assert_allclose(found.slack, ours.slack, atol=1e-4)
            batch = by(solver, qps, i).filter(*[part[None] for part in given])
            assert (batch.action[0] == found.action).all()
            feasible += ours.feasible
    assert 0 < feasible < 24


def test_what_they_cannot_solve_is_refused():
    problem = make_problem("safe_envs/Scalar-v0")
    given = (problem.model, problem.barriers, "srcbf", problem.input_bounds)
    with pytest.raises(ConfigurationError, match="proxqp"):
        SafetyFilter(*given, solver="proxqp")
    with pytest.raises(ConfigurationError, match="prxqp"):
        SafetyFilter(*given[:2], "scbf", given[3], solver="prxqp")


def test_a_solver_that_gives_up_at_first_does_not_make_constraints_infeasible(monkeypatch):
    solve, calls = other_solvers._solve, []

    def gives_up(*given):
        calls.append(given)
        return None if len(calls) == 1 else solve(*given)

    monkeypatch.setattr(other_solvers, "_solve", gives_up)
    rows = np.array([[1.0, 0.0, 0.5], [0.0, -1.0, 0.2]])
    ones = [1.0] * 4
    action, feasible = other_solvers.solve_with("daqp", rows, [-1, 1], [-1, -1, 1, 1], ones)
    np.testing.assert_allclose(action, [-0.5, 0.2], atol=1e-6)
    assert feasible
    assert len(calls) == 3
