"""The kernel of several constraints on two inputs against the dispatcher."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.engine.qp import dispatch, plane, rounding
from safe_envs.engine.qp.kernels import plane as kernel
from tests.oracles.kernel_problems import KINDS, Problems, random_problems, reference, solve


def length(k):
    return kernel.work_of_plane(k, 2)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("k", [2, 3, 5])
def test_says_what_the_dispatcher_does(k, kind):
    problems = random_problems(np.random.default_rng([k, KINDS.index(kind)]), 150, k, 2, kind)
    found, expected = solve(kernel.project_plane, length(k), problems), reference(problems)
    assert (expected.active.any(axis=1) & expected.feasible).sum() > 10 or kind == "unmet"
    assert (~expected.feasible).sum() > 10 or kind == "touching"
    a, b, v, low, high, w, _ = problems
    same = np.array(
        [
            plane.project_floats(*[part[i].tolist() for part in (a, b, v, low, high, w)])
            is not None
            for i in range(len(b))
        ]
    )
    for part, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(part[same], other[same])
    np.testing.assert_array_equal(found.feasible, expected.feasible)
    # The rest come from other equations: the same up to 1e-9 of the inputs, or of a thousandth.
    reach = 1e-9 * np.maximum(np.abs(expected.u), 1e-3)
    near = (np.abs(found.u - expected.u) <= reach).all(axis=1)
    # Sixteen decades between two slopes are more than the sum of their squares can hold.
    assert near.all() or (kind == "sizes" and (~near).sum() <= 2)
    np.testing.assert_array_equal(found.active[near], expected.active[near])


@pytest.mark.parametrize("kind", ["plain", "unmet", "integers", "parallel", "flat", "touching"])
def test_fallback_finds_the_same_minimisers(kind, monkeypatch):
    monkeypatch.setattr(kernel, "NEWTON_STEPS", 0)
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
    assert kernel.ROUNDING == rounding.ROUNDING


def test_lines_that_cross_in_a_point_are_met_there_however_far_the_proposal():
    # Rows through a point inside the box, and a proposal that both hold back.
    a = np.array(
        [[-0.004512174099505522, -0.4388414080680893], [-0.39491110755425435, 0.5863303579870851]]
    )
    b = np.array([0.0, 0.2574523271255308])
    proposals = [[4.29731531704134, -0.9034445409930839], [0.1, -0.9], [4e3, -0.9], [4e5, -9.0]]
    size = len(proposals)
    problems = Problems(
        np.tile(a, (size, 1, 1)),
        np.tile(b, (size, 1)),
        np.array(proposals),
        np.full((size, 2), -1.0),
        np.ones((size, 2)),
        np.ones((size, 2)),
        np.ones(2),
    )
    expected = np.linalg.solve(a, -b)
    for answers in (reference(problems), solve(kernel.project_plane, length(2), problems)):
        assert answers.feasible.all()
        np.testing.assert_allclose(answers.u[[0, 2, 3]], [expected] * 3, rtol=0, atol=1e-12)
    for v in proposals:
        assert dispatch.project_floats(a, b, v, [-1, -1], [1, 1], [1, 1], [1, 1])[3]
