"""A job, which is computed anywhere independently of all others, and its outcome."""

from __future__ import annotations

import os
import sys
import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

from threadpoolctl import ThreadpoolController

from safe_envs.errors import SafeEnvsError

_SIDE_BY_SIDE: ContextVar[bool] = ContextVar("computations run side by side", default=False)


def available_threads() -> int:
    """Return the processors that this process may use; 1 within `one_thread`."""
    if _SIDE_BY_SIDE.get():
        return 1
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def one_thread() -> Iterator[None]:
    """Let computations take one thread, where others like them run side by side."""
    token = _SIDE_BY_SIDE.set(True)
    try:
        yield
    finally:
        _SIDE_BY_SIDE.reset(token)


_FRAMES = 3
"""Lines of code with which an unexpected error is reported."""

_ONE_AT_A_TIME = threading.Lock()
"""A Dask worker may have several threads, for which neither SymPy nor threadpoolctl are made."""


class Job(Protocol):
    """A computation that can be sent to another process."""

    @property
    def key(self) -> str:
        """Return the text that identifies the job."""
        ...

    def compute(self) -> Any:
        """Return the result, whatever process this is."""
        ...


@dataclass(frozen=True)
class JobOutcome:
    """The end of a job.

    Attributes:
        key: of the job.
        result: what it returned; None if it failed.
        error: why it failed, or None.
        seconds: how long it took, the only part that depends on the machine.
    """

    key: str
    result: Any
    error: str | None
    seconds: float


class LossError(Exception):
    """A worker ended, which may have been computing `jobs`.

    Args:
        error: by which it is known.
        jobs: of the worker.
    """

    def __init__(self, error: BaseException, jobs: Sequence[Job]) -> None:
        super().__init__(f"{type(error).__name__}: {error}".splitlines()[0].rstrip("."))
        self.jobs = jobs


def outcome_of(job: Job) -> JobOutcome:
    """Compute a job on one thread; an exception becomes the error of the outcome."""
    from threadpoolctl import threadpool_limits

    began = time.perf_counter()
    result = error = None
    try:
        # Jobs run side by side already.
        with _ONE_AT_A_TIME, threadpool_limits(1), one_thread():
            result = job.compute()
    except SafeEnvsError as raised:
        error = str(raised)
    except Exception as raised:
        error = f"{type(raised).__name__}: {raised}{_where(raised)}"
    return JobOutcome(job.key, result, error, time.perf_counter() - began)


def _where(error: Exception) -> str:
    """Return the last lines of code that led to an error, without what differs between machines."""
    frames = traceback.extract_tb(error.__traceback__)[-_FRAMES:]
    places = [
        f"{'/'.join(Path(frame.filename).parts[-2:])}:{frame.lineno} in {frame.name}"
        for frame in frames
    ]
    return f" (at {', from '.join(reversed(places))})"


_BRING_A_BLAS = ("numpy", "scipy.linalg", "torch")


def limited(threads: int = 1) -> AbstractContextManager[Any]:
    """Limit the number of threads of every BLAS that is loaded by now."""
    return _controller(tuple(name in sys.modules for name in _BRING_A_BLAS)).limit(
        limits=threads, user_api="blas"
    )


@lru_cache
def _controller(loaded: tuple[bool, ...]) -> ThreadpoolController:
    """Find the libraries of this process once per set, since that outlasts many simulations."""
    return ThreadpoolController()
