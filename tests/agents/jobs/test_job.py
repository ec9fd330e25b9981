"""One job in one process: its threads, and its end."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import pytest
import scipy.linalg  # noqa: F401  (brings a BLAS)
from threadpoolctl import threadpool_info, threadpool_limits

from safe_envs.agents.jobs.job import available_threads, limited, outcome_of
from safe_envs.errors import ConfigurationError


def threads() -> set[int]:
    return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}


@dataclass(frozen=True)
class Called:
    """A job that calls a function."""

    compute: Callable[[], Any]
    key: str = "one"


@pytest.mark.parametrize("limit", [1, 2])
def test_every_blas_is_limited_and_let_go(limit: int):
    with threadpool_limits(3, "blas"):
        with limited(limit):
            assert threads() == {limit}
        assert threads() == {3}


def test_a_job_has_one_thread():
    with threadpool_limits(2):
        found = outcome_of(Called(lambda: (threads(), available_threads())))
    assert found.result == ({1}, 1)


def test_threads_of_a_worker_compute_one_job_at_a_time():
    both = threading.Barrier(2)
    jobs = [Called(lambda: both.wait(0.3))] * 2
    with ThreadPoolExecutor(2) as pool:
        outcomes = list(pool.map(outcome_of, jobs))
    # Neither met the other.
    assert all(str(outcome.error).startswith("BrokenBarrierError") for outcome in outcomes)


def test_an_error_of_any_kind_is_the_outcome_of_its_job():
    def refuse():
        raise ConfigurationError("seed = -1")

    assert outcome_of(Called(refuse)).error == "seed = -1"
    found = outcome_of(Called(lambda: {}["filter"]))
    assert found.result is None
    # Without what differs between machines.
    place = r"KeyError: 'filter' \(at jobs/test_job\.py:\d+ in .*, from jobs/job\.py:\d+ in .*\)"
    assert re.fullmatch(place, str(found.error))
