"""joblib's backend for Dask, which reports the loss of a worker to joblib."""

from __future__ import annotations

import re
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from safe_envs.agents.jobs.job import Job
from safe_envs.errors import ConfigurationError

if TYPE_CHECKING:
    from distributed import Client

_PATIENCE = 15
"""Seconds to wait for a scheduler, and for its first worker."""

_LOOK = 5.0
"""Seconds between two looks at whether a scheduler still has workers."""

_MOST_LOOKS = 60
"""Looks in a row without workers after which to give up."""


class TaskLostError(Exception):
    """A task ended outside of its function, as with its worker.

    Attributes:
        reason: what the cluster reports.
        jobs: those of the task.
    """

    def __init__(self, reason: BaseException, jobs: Sequence[Job]) -> None:
        super().__init__(str(reason))
        self.reason, self.jobs = reason, jobs


@contextmanager
def dask_settings(address: str, report: Callable[[str], None]) -> Iterator[dict[str, Any]]:
    """Yield the arguments of `joblib.Parallel` for a Dask scheduler.

    Args:
        address: of the scheduler.
        report: receives a message when it has lost all its workers. If none come for minutes,
            joblib raises ConfigurationError.

    Raises:
        ConfigurationError: there is no scheduler, or it has no workers.
    """
    from distributed import Client
    from joblib._dask import DaskDistributedBackend

    class Dask(DaskDistributedBackend):
        def __init__(self, client: Client) -> None:
            super().__init__(client=client)
            self._waiting: dict[Any, Callable[[Any], None]] = {}

        def effective_n_jobs(self, n_jobs: int) -> int:
            # joblib computes in this process where there is one worker.
            return max(super().effective_n_jobs(n_jobs), 2)

        def submit(self, func: Any, callback: Callable[[Any], None] | None = None) -> Any:
            future = super().submit(func, callback)
            if callback is not None:
                self._waiting[future] = callback
                future.add_done_callback(
                    lambda done: self._end(done, [args[0] for _, args, _ in func.items])
                )
            return future

        def _end(self, done: Any, jobs: Sequence[Job]) -> None:
            callback, error = self._waiting.pop(done), done.exception()
            if error is not None:
                # joblib would never hear of a task that ended outside of its function.
                callback(TaskLostError(error, jobs))

        def give_up(self, error: Exception) -> None:
            for callback in list(self._waiting.values())[:1]:
                callback(error)

    try:
        _require_listener(re.sub("^(tcp|tls|ucx)://", "", address))
        client = Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"no Dask scheduler answers at {address} ({error}); start one by: dask scheduler"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
        except TimeoutError as error:
            raise ConfigurationError(
                f"the Dask scheduler at {address} has no workers; start some by: dask worker"
                f" {address}"
            ) from error
        backend, ended = Dask(client), threading.Event()
        watch = threading.Thread(
            target=_watch, args=(client, address, report, backend.give_up, ended), daemon=True
        )
        watch.start()
        try:
            # All at once: workers that come later get some, too.
            yield {"backend": backend, "n_jobs": -1, "pre_dispatch": "all"}
        finally:
            ended.set()


def _watch(
    client: Client,
    address: str,
    report: Callable[[str], None],
    give_up: Callable[[Exception], None],
    ended: threading.Event,
) -> None:
    """Report once that a scheduler has no workers, and give up when none come."""
    looks = 0
    while not ended.wait(_LOOK):
        try:
            looks = 0 if client.nthreads() else looks + 1
        except Exception:  # the end of the scheduler itself is reported with the tasks
            continue
        if ended.is_set():
            return
        if looks == 1:
            report(
                f"The Dask scheduler at {address} has no workers any more; waiting for some. Start"
                f" them by: dask worker {address}"
            )
        if looks == _MOST_LOOKS:
            minutes = _LOOK * _MOST_LOOKS / 60
            message = (
                f"the Dask scheduler at {address} has had no workers for {minutes:g} minutes; start"
                f" some by: dask worker {address}"
            )
            give_up(ConfigurationError(f"{message}, and start again: what was computed is kept"))


def _require_listener(address: str) -> None:
    """Raise OSError unless something listens at HOST:PORT, and ValueError for another form."""
    # Dask's client would try for minutes.
    host, _, port = address.rpartition(":")
    if not (host and port.isdecimal() and "/" not in host):
        raise ValueError("this is not of the form HOST:PORT")
    socket.create_connection((host, int(port)), timeout=_PATIENCE).close()
