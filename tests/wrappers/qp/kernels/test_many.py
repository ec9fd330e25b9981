"""The kernel of several constraints on three and more inputs against the dispatcher."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from safe_envs.engine.qp import rounding
from safe_envs.engine.qp.kernels import many
from safe_envs.engine.qp.kernels import many as kernel
from tests.oracles.kernel_problems import KINDS, random_problems, reference, solve


def values(problems, u):
    """Values of the constraints at inputs."""
    return np.einsum("nkm,nm->nk", problems.a, u) + problems.b


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("k", "m"), [(2, 3), (3, 4)])
def test_says_what_the_dispatcher_does(k, m, kind):
    problems = random_problems(np.random.default_rng([k, m, KINDS.index(kind)]), 20, k, m, kind)
    check(problems, kind)


@pytest.mark.oracle
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("k", "m"), [(2, 3), (3, 3), (3, 4), (5, 4), (8, 6)])
def test_says_what_the_dispatcher_does_of_many(k, m, kind):
    problems = random_problems(np.random.default_rng([m, k, KINDS.index(kind)]), 500, k, m, kind)
    check(problems, kind)


def check(problems, kind):
    found = solve(kernel.project_many, kernel.work_of_many(*problems.a.shape[1:]), problems)
    expected = reference(problems)
    count = len(expected.u)
    assert expected.active.any(axis=1).sum() > count // 10
    assert np.all((found.u >= problems.low) & (found.u <= problems.high))
    # A proposal 1e8 boxes away has its own rounding.
    reach = np.maximum(np.abs(expected.u), 1e-3 * (problems.high - problems.low).clip(max=1.0))
    near = (np.abs(found.u - expected.u) <= (1e-5 if kind == "far" else 1e-9) * reach).all(axis=1)
    # Sixteen decades between two slopes are more than the sum of their squares can hold.
    assert near.all() or (kind == "sizes" and np.all(near | ~expected.feasible))
    assert near.sum() > 0.75 * count
    terms = (np.abs(problems.a) @ np.abs(found.u)[:, :, None])[:, :, 0] + np.abs(problems.b)
    # Where more constraints than inputs meet in a point, rounding decides which of them are met.
    doubtful = (np.abs(found.margin) <= 8.0 * rounding.ROUNDING * terms).any(axis=1)
    other = (found.active != expected.active).any(axis=1)
    other = (other | (found.feasible != expected.feasible)) & near
    assert not (other & ~doubtful).any()
    # So it does where slopes are sixteen decades apart.
    assert other.sum() <= (1 + count // 50 if kind in ("touching", "sizes") else 0)
    assert np.all(np.abs(found.margin - values(problems, found.u)) <= 1e-14 * terms)


def corners_of(problem, k, m):
    """All inputs where some constraints are 0, some inputs at a bound, and the rest is nearest to
    the proposal: where a minimiser is to be sought.

    Args:
        problem: a, b, v, low, high and w.
        k: number of constraints.
        m: number of inputs.
    """
    a, b, v, low, high, w = problem
    for sides in itertools.product((-1, 0, 1), repeat=m):
        at = np.array(sides)
        base = np.where(at < 0, low, np.where(at > 0, high, v))
        free = at == 0
        for count in range(min(k, free.sum()) + 1):
            for rows in map(list, itertools.combinations(range(k), count)):
                scaled = (a[rows] / np.sqrt(w))[:, free]
                gap = a[rows] @ base + b[rows]
                u = base.copy()
                u[free] -= np.linalg.pinv(scaled) @ gap / np.sqrt(w[free])
                yield u


@pytest.mark.parametrize("kind", ["plain", "integers", "parallel", "touching"])
def test_no_allowed_input_is_nearer(kind):
    problems = random_problems(np.random.default_rng(5), 12, 3, 3, kind)
    found = solve(kernel.project_many, kernel.work_of_many(3, 3), problems)
    assert found.feasible.sum() > 5
    for i in np.flatnonzero(found.feasible):
        a, b, v, low, high, w = problem = [part[i] for part in problems[:6]]
        corners = np.array(list(corners_of(problem, 3, 3)))
        met = (corners @ a.T + b >= -1e-12).all(axis=1)
        inside = ((corners >= low - 1e-12) & (corners <= high + 1e-12)).all(axis=1)
        least = (w * (corners[met & inside] - v) ** 2).sum(axis=1).min()
        np.testing.assert_allclose((w * (found.u[i] - v) ** 2).sum(), least, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", ["unmet", "parallel", "flat"])
def test_forces_of_slacks_balance_where_constraints_contradict(kind):
    problems = random_problems(np.random.default_rng(6), 60, 3, 4, kind)
    found = solve(kernel.project_many, kernel.work_of_many(3, 4), problems)
    missed = np.flatnonzero(found.feasible == 0.0)
    assert missed.size > 5
    slack = np.maximum(-values(problems, found.u), 0.0)
    force = np.einsum("nk,nkm->nm", problems.priority * slack, problems.a)[missed]
    size = np.abs(problems.a).max() * (problems.priority * slack)[missed].max(axis=1)
    u, low, high = found.u[missed], problems.low[missed], problems.high[missed]
    nothing = 1e-9 * size[:, None] + 1e-12
    assert np.all((force <= nothing) | (u >= high - 1e-12))
    assert np.all((force >= -nothing) | (u <= low + 1e-12))


def test_fallback_finds_the_same_minimisers(monkeypatch):
    monkeypatch.setattr(kernel, "find_binding", lambda *_: False)
    for kind in ("plain", "integers", "parallel", "flat"):
        problems = random_problems(np.random.default_rng(9), 30, 3, 4, kind)
        found, expected = (
            solve(kernel.project_many, kernel.work_of_many(3, 4), problems),
            reference(problems),
        )
        np.testing.assert_allclose(found.u, expected.u, atol=1e-9)
        np.testing.assert_array_equal(found.feasible, expected.feasible)


def test_a_multiplier_of_the_wrong_sign_proves_nothing():
    """One constraint may be left, so that the one that is held pulls."""
    a, b, v = np.array([[1.0, 0.0, 0.0]]), np.array([0.5]), np.zeros(3)
    low, high, roots = -np.ones(3), np.ones(3), np.ones(3)
    u, work = np.empty(3), np.full(many.work_of_proof(3), np.nan)

    def proved(offset, at):
        return many.prove_binding(
            a, offset, v, low, high, roots, a, np.ones(1), np.ones(1), at, u, work
        )

    assert not proved(b, np.zeros(3))
    assert proved(-b, np.zeros(3))
    assert u.tolist() == [0.5, 0.0, 0.0]
    assert not proved(-b, np.array([0.0, 1.0, 0.0]))
    assert not proved(np.array([-2.0]), np.zeros(3))


@np.errstate(all="ignore")
def test_data_that_are_not_finite_end_in_numbers_that_are_not():
    for bad in (np.nan, np.inf, -np.inf):
        for part in (0, 1):
            problems = random_problems(np.random.default_rng(0), 8, 3, 4, "unmet")
            problems[part][:, 1] = bad
            found = solve(kernel.project_many, kernel.work_of_many(3, 4), problems)
            assert not np.isfinite(np.column_stack((found.u, found.margin))).all(axis=1).any()


def test_tolerance_is_that_of_all_solvers():
    assert many.ROUNDING == rounding.ROUNDING
