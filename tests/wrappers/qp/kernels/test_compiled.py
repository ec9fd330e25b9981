"""A kernel module compiled by Numba gives the bits of plain Python."""

from __future__ import annotations

from types import FunctionType

import numpy as np
import pytest

from safe_envs.engine.qp.kernels import interval
from tests.oracles.kernel_problems import random_problems, solve


def test_compiled_gives_the_same_bits():
    numba = pytest.importorskip("numba")
    space = dict(vars(interval))
    for name, function in vars(interval).items():
        if isinstance(function, FunctionType):
            linked = FunctionType(function.__code__, space, name)
            # Without reference counts, since no kernel allocates.
            space[name] = numba.njit(nogil=True, error_model="numpy", _nrt=False)(linked)
    length, unmet = interval.work_of_interval(3, 1), 0
    for kind in ("plain", "unmet", "sizes", "flat", "integers", "touching"):
        problems = random_problems(np.random.default_rng(2), 400, 3, 1, kind)
        found = solve(space["project_interval"], length, problems)
        expected = solve(interval.project_interval, length, problems)
        for part, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(part, other)
        unmet += np.count_nonzero(expected.feasible == 0.0)
    assert unmet > 200
