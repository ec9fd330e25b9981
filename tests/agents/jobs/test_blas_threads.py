from __future__ import annotations

import pytest
import scipy.linalg  # noqa: F401  (brings a BLAS)
from threadpoolctl import threadpool_info, threadpool_limits

from safe_envs.agents.jobs import job


def threads() -> set[int]:
    return {
        library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"
    }


@pytest.mark.parametrize("limit", [1, 2])
def test_every_blas_is_limited_and_let_go(limit: int):
    with threadpool_limits(3, "blas"):
        with job.limited(limit):
            assert threads() == {limit}
        assert threads() == {3}
