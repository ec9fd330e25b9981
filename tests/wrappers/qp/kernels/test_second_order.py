"""The kernel of uncertain constraints on one input against the batch."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.engine.qp import rounding
from safe_envs.engine.qp.kernels import second_order as kernel
from safe_envs.engine.qp.second_order import project_arrays
from tests.wrappers.qp.test_second_order_constraint import HIGH, KINDS, LOW, random_rows


def solve(a, b, q, v, priority):
    """Solve states one by one: inputs, margins, binding constraints (N, k) and feasibility."""
    (k, size), found = a.shape, []
    u, margin, active, work = np.empty(1), np.empty(k), np.empty(k), np.full(2 * k, np.nan)
    assert kernel.work_of_second_order(k, 1) == len(work)
    ends = np.array([LOW]), np.array([HIGH])
    for i in range(size):
        row = a[:, [i]], b[:, i], q[:, :, i].T, v[[i]]
        met = kernel.project_second_order(
            *row, *ends, np.ones(1), priority, u, margin, active, work
        )
        found.append((u[0], margin.copy(), active.copy(), met))
    return [np.array(part) for part in zip(*found, strict=True)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("k", [1, 2, 3])
def test_says_what_the_batch_does_to_the_last_bit(k, kind):
    rng = np.random.default_rng([k, KINDS.index(kind)])
    problem, priority = random_rows(rng, k, 120, kind), 10.0 ** rng.uniform(-1, 1, k)
    u, margin, active, feasible = solve(*problem, priority)
    a, b, q, v = problem
    expected = project_arrays(
        list(a), list(b), [tuple(q[:, i]) for i in range(k)], v, LOW, HIGH, priority.tolist()
    )
    assert 5 < expected[3].sum() < 119
    np.testing.assert_array_equal(u, expected[0])
    np.testing.assert_array_equal(margin.T, expected[1])
    np.testing.assert_array_equal(active.T, expected[2])
    np.testing.assert_array_equal(feasible, expected[3])


@np.errstate(all="ignore")
def test_data_that_are_not_finite_end_in_numbers_that_are_not():
    for k in (1, 3):
        for bad in (np.nan, np.inf, -np.inf):
            for part in range(3):
                problem = random_rows(np.random.default_rng(0), k, 20, "plain")
                problem[part][..., 0, :] = bad
                u, margin, *_ = solve(*problem, np.ones(k))
                # A form of minus infinity has the root 0: the caller looks at the form.
                finite = np.isfinite(np.column_stack((u, margin))).all(axis=1)
                assert not finite.any() or (part == 2 and bad == -np.inf)


def test_tolerance_is_that_of_all_solvers():
    assert kernel.ROUNDING == rounding.ROUNDING
