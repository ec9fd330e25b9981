"""The kernel of several constraints on one input against the dispatcher."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.engine.qp import rounding
from safe_envs.engine.qp.kernels import interval as kernel
from tests.oracles.kernel_problems import KINDS, random_problems, reference, solve


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("k", [1, 2, 3, 6])
def test_says_what_the_dispatcher_does_to_the_last_bit(k, kind):
    problems = random_problems(np.random.default_rng([k, KINDS.index(kind)]), 150, k, 1, kind)
    found = solve(kernel.project_interval, kernel.work_of_interval(k, 1), problems)
    expected = reference(problems)
    assert 5 < expected.active.any(axis=1).sum() <= 150
    for part, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(part, other)


@np.errstate(all="ignore")
def test_data_that_are_not_finite_end_in_numbers_that_are_not():
    for bad in (np.nan, np.inf, -np.inf):
        for part in (0, 1):
            problems = random_problems(np.random.default_rng(0), 20, 3, 1, "unmet")
            problems[part][:, 1] = bad
            found = solve(kernel.project_interval, kernel.work_of_interval(3, 1), problems)
            assert not np.isfinite(np.column_stack((found.u, found.margin))).all(axis=1).any()


def test_tolerance_is_that_of_all_solvers():
    assert kernel.ROUNDING == rounding.ROUNDING
