"""Processes of this machine that compute, and end with the process that started them."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from typing import Any

import cloudpickle

from safe_envs.errors import ConfigurationError, WorkersLostError

_LOOK = 1.0
"""Seconds between two looks of a worker at whether the process that started it still exists."""


def end_with_parent(parent: int) -> None:
    """End this process soon after its parent, which may be killed without notice.

    This is an initializer of worker processes. The operating system gives a process whose parent
    has ended another parent. (Windows does not: there it stays until it is idle.)

    Args:
        parent: id of the process that started this one.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK)
        os._exit(1)

    threading.Thread(target=watch, daemon=True, name="end_with_parent").start()


def local_processes(idle: int = 300) -> Any:
    """Return joblib's backend of processes of this machine, each of which ends with this one.

    Args:
        idle: seconds after which a process ends that has nothing to do.
    """
    from joblib._parallel_backends import LokyBackend

    return LokyBackend(
        idle_worker_timeout=idle, initializer=end_with_parent, initargs=(os.getpid(),)
    )


def compute_in_order(
    function: Callable[..., Any], shared: Any, parts: Sequence[Any], jobs: int
) -> Iterator[Any]:
    """Yield `function(shared, part)` for each part, in their order, from processes that stay.

    An exception of the function is raised here as it is.

    Args:
        function: importable by its name.
        shared: what all parts have in common; it may hold functions and classes of a script.
        parts: what differs.
        jobs: number of processes, which remain for the next call.

    Raises:
        ConfigurationError: `shared` cannot be sent to another process.
        WorkersLostError: a process was ended from outside.
    """
    from joblib import Parallel, delayed

    try:
        sent = cloudpickle.dumps(shared)
    except Exception as error:  # whatever a user's object raises that is not made for this
        raise ConfigurationError(
            f"jobs = {jobs}: what is evaluated cannot be sent to another process ({error}); use"
            " jobs=1"
        ) from error
    parallel = Parallel(jobs, backend=local_processes(), return_as="generator")
    found: Any = parallel(delayed(_unpacked)(function, sent, part) for part in parts)
    try:
        yield from found
    except BrokenProcessPool as error:
        raise WorkersLostError(
            f"jobs = {jobs}: a process that simulated episodes was ended from outside, as for want"
            " of memory; use fewer jobs or a smaller num_envs"
        ) from error


def _unpacked(function: Callable[..., Any], sent: bytes, part: Any) -> Any:
    return function(cloudpickle.loads(sent), part)
