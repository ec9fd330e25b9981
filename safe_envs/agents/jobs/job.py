"""A job, which is computed anywhere independently of all others, and its outcome."""

from __future__ import annotations

import threading
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from safe_envs.agents.jobs.threads import one_thread
from safe_envs.errors import SafeEnvsError

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
