"""Jobs on the workers of a Dask scheduler."""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Callable, Generator, Sequence
from typing import TYPE_CHECKING

from safe_envs.agents.jobs.job import Job, JobOutcome, LossError, outcome_of
from safe_envs.errors import ConfigurationError

if TYPE_CHECKING:
    from distributed import Client

_PATIENCE = 15
"""Seconds to wait for a scheduler, and for its first worker."""

_POLL = 0.05
"""Seconds between two looks at whether a job has ended."""

_LOOK = 5.0
"""Seconds between two looks at whether a scheduler still has workers."""

_MOST_LOOKS = 60
"""Looks in a row without workers after which to give up."""


def dask_outcomes(
    jobs: Sequence[Job], address: str, report: Callable[[str], None]
) -> Generator[JobOutcome, None, None]:
    """Yield outcomes in the order of completion.

    Args:
        jobs: what to compute.
        address: of the scheduler.
        report: receives a message when it has lost all its workers.

    Raises:
        ConfigurationError: there is no scheduler, it has no workers, or none come for minutes after
            it has lost them.
        LossError: a job ended outside of its function, as with its worker.
    """
    from distributed import as_completed

    with _connected(address) as client:
        # All at once: workers that come later get some, too.
        job_of = dict(zip(client.map(outcome_of, jobs, pure=False), jobs, strict=True))
        ended = as_completed(job_of, loop=client.loop)
        looks, next_look = 0, time.monotonic() + _LOOK
        while not ended.is_empty():
            if not ended.has_ready():
                time.sleep(_POLL)
                if time.monotonic() >= next_look:
                    looks = looked(client, address, looks, report)
                    next_look = time.monotonic() + _LOOK
                continue
            for future in ended.next_batch(block=False):
                job = job_of.pop(future)
                try:
                    outcome = future.result()
                except Exception as error:  # those of the job itself are in its outcome
                    raise LossError(error, [job]) from error
                yield outcome


def _connected(address: str) -> Client:
    """Return the client of a scheduler that has workers."""
    from distributed import Client

    try:
        _require_listener(re.sub("^(tcp|tls|ucx)://", "", address))
        client = Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"no Dask scheduler answers at {address} ({error}); start one by: dask scheduler"
        ) from error
    try:
        client.wait_for_workers(1, timeout=_PATIENCE)
    except TimeoutError as error:
        client.close()
        raise ConfigurationError(
            f"the Dask scheduler at {address} has no workers; start some by: dask worker {address}"
        ) from error
    return client


def looked(client: Client, address: str, looks: int, report: Callable[[str], None]) -> int:
    """Look whether a scheduler has workers; report once that it has none.

    Args:
        client: of the scheduler.
        address: of the scheduler.
        looks: how often in a row it had none.
        report: receives the message.

    Returns:
        How often in a row it has none now.

    Raises:
        ConfigurationError: it has had none for minutes.
    """
    try:
        if client.nthreads():
            return 0
    except Exception:  # the end of the scheduler itself is reported with the jobs
        return looks
    if not looks:
        report(
            f"The Dask scheduler at {address} has no workers any more; waiting for some. Start"
            f" them by: dask worker {address}"
        )
    if looks + 1 >= _MOST_LOOKS:
        raise ConfigurationError(
            f"the Dask scheduler at {address} has had no workers for"
            f" {_LOOK * _MOST_LOOKS / 60:g} minutes; start some by: dask worker {address}, and"
            " start again: what was computed is kept"
        )
    return looks + 1


def _require_listener(address: str) -> None:
    """Raise OSError unless something listens at HOST:PORT, and ValueError for another form."""
    # Dask's client would try for minutes.
    host, _, port = address.rpartition(":")
    if not (host and port.isdecimal() and "/" not in host):
        raise ValueError("this is not of the form HOST:PORT")
    socket.create_connection((host, int(port)), timeout=_PATIENCE).close()
