"""The kernel of several constraints on two inputs against the dispatcher."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.wrappers.qp import rounding
from safe_envs.wrappers.qp.kernels import plane as kernel
from safe_envs.wrappers.qp.kernels import plane_edges, plane_nearest, plane_slack
from tests.oracles.kernel_problems import KINDS, random_problems, reference, solve


def length(k):
    return kernel.work_of_plane(k, 2)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("k", [2, 3, 5])
def test_says_what_the_dispatcher_does(k, kind):
    problems = random_problems(np.random.default_rng([k, KINDS.index(kind)]), 150, k, 2, kind)
    found, expected = solve(kernel.project_plane, length(k), problems), reference(problems)
    assert (expected.active.any(axis=1) & expected.feasible).sum() > 10 or kind == "unmet"
    assert (~expected.feasible).sum() > 10 or kind == "touching"
    same = (found.u == expected.u).all(axis=1)
    for part, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(part[same], other[same])
    # The rest are those of the least-squares fallback, whose linear algebra is LAPACK's there.
    assert (~same).sum() <= 3
    assert expected.feasible[same].sum() == expected.feasible.sum()
    reach = 1e-9 * np.maximum(np.abs(expected.u), 1e-3)
    near = (np.abs(found.u - expected.u) <= reach).all(axis=1)
    # Sixteen decades between two slopes are more than the sum of their squares can hold.
    assert near.all() or (kind == "sizes" and (~near).sum() <= 2)
    np.testing.assert_array_equal(found.active[near], expected.active[near])


@pytest.mark.parametrize("kind", ["plain", "unmet", "integers", "parallel", "flat", "touching"])
def test_fallback_finds_the_same_minimisers(kind, monkeypatch):
    monkeypatch.setattr(plane_slack, "NEWTON_STEPS", 0)
    problems = random_problems(np.random.default_rng(8), 100, 3, 2, kind)
    found, expected = solve(kernel.project_plane, length(3), problems), reference(problems)
    np.testing.assert_array_equal(found.feasible, expected.feasible)
    np.testing.assert_allclose(found.u, expected.u, atol=1e-9)
    assert (~expected.feasible).sum() > 20 or kind == "touching"


@np.errstate(all="ignore")
def test_data_that_are_not_finite_end_in_numbers_that_are_not():
    for bad in (np.nan, np.inf, -np.inf):
        for part in (0, 1):
            problems = random_problems(np.random.default_rng(0), 20, 3, 2, "unmet")
            problems[part][:, 1] = bad
            found = solve(kernel.project_plane, length(3), problems)
            assert not np.isfinite(np.column_stack((found.u, found.margin))).all(axis=1).any()


def test_tolerance_is_that_of_all_solvers():
    for module in (kernel, plane_nearest, plane_slack, plane_edges):
        assert module.ROUNDING == rounding.ROUNDING
