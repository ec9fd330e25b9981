"""The runner of independent jobs: in processes of this machine, or on a Dask cluster."""

from __future__ import annotations

import os
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, cast

import cloudpickle

from safe_envs.agents.jobs.clusters import dask_outcomes
from safe_envs.agents.jobs.job import Job, JobOutcome, LossError, outcome_of
from safe_envs.errors import (
    ConfigurationError,
    WorkersLostError,
    install_extra,
    nearest,
    require_whole,
)

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


BACKENDS = ("local", "dask")

_MOST_LOSSES = 3
"""How often processes of this machine may end before jobs are computed one by one; Dask retries by
itself."""

_MOST_TRIED = 5
"""How many jobs are tried, one by one, before none is taken to be computable."""

_IDLE = 30
"""Seconds after which a process of this machine ends that has nothing to do."""


@dataclass(frozen=True)
class Backend:
    """Where to compute.

    Attributes:
        backend: one of `BACKENDS`.
        address: of a Dask scheduler, tcp://HOST:PORT.
        jobs: number of processes of this machine, for "local"; a cluster uses all its workers.

    Raises:
        ConfigurationError: the backend is unknown, an address is missing or does not apply, or Dask
            is not installed.
    """

    backend: str = "local"
    address: str | None = None
    jobs: int = 2

    def __post_init__(self) -> None:
        require_whole("jobs", self.jobs, 1)
        if self.backend == "ray":
            raise ConfigurationError(
                "backend = 'ray' is gone; use dask, or local processes of this machine"
            )
        if self.backend not in BACKENDS:
            raise ConfigurationError(
                f"backend = {self.backend!r}; {nearest(self.backend, BACKENDS)}"
            )
        if (self.address is None) != (self.backend == "local"):
            wrong = (
                "needs the address of its scheduler"
                if self.address is None
                else "takes no address; name dask as the backend"
            )
            raise ConfigurationError(f"backend {self.backend} {wrong}")
        if self.backend == "dask" and find_spec("distributed") is None:
            raise ConfigurationError(f"distributed is not installed; {install_extra('dask')}")


def run(
    jobs: Iterable[Job],
    backend: Backend,
    keep: Callable[[JobOutcome], None],
    report: Callable[[str], None] = lambda _: None,
) -> None:
    """Compute jobs, each once.

    When a worker ends, the jobs that were under way are computed again. After several such losses
    those jobs are computed one by one, up to the first that ends its worker by itself (as for want
    of memory), which counts as failed; then the others continue in parallel. As long as no job at
    all was computed, some from the whole list are tried one by one in place of those.

    Args:
        jobs: what to compute. The results do not depend on their order.
        backend: where.
        keep: receives each outcome as soon as it exists, in the order of completion.
        report: receives what the user should know meanwhile, such as that a cluster has lost all
            its workers; called by any thread.

    Raises:
        ConfigurationError: a cluster cannot be reached, or has no workers.
        WorkersLostError: workers end before they have computed anything.
    """
    missing = {job.key: job for job in jobs}
    any_computed = False

    def take(some: Sequence[Job]) -> None:
        nonlocal any_computed
        with closing(_outcomes(some, backend, report)) as outcomes:
            for outcome in outcomes:
                keep(outcome)
                del missing[outcome.key]
                any_computed = True

    # Each pass through this loop makes them fewer: a job that is tried alone is computed, or counts
    # as failed.
    while missing:
        try:
            for left in reversed(range(_MOST_LOSSES if backend.backend == "local" else 1)):
                try:
                    take(list(missing.values()))
                    break
                except LossError:
                    if not left:
                        raise
        except LossError as loss:
            under_way = [job for job in loss.jobs if job.key in missing] if any_computed else []
            # A job that was alone need not be tried again; Dask names one of several.
            was_alone = len(under_way) == 1 and backend.backend != "dask"
            error: LossError | None = loss
            for job in under_way or _spread(list(missing.values())):
                error = loss if was_alone else _alone(job, take)
                if error is not None:
                    message = f"the process that computed it ended: {error}"
                    keep(JobOutcome(job.key, None, message, 0.0))
                    del missing[job.key]
                if any_computed and (error is not None or not under_way):
                    break
            if missing and not any_computed:
                raise WorkersLostError(
                    f"nothing could be computed, since the processes for it end; the last: {error}."
                    " Look for the reason, such as too little memory or another installation on"
                    " the workers, and start again"
                ) from error


def _alone(job: Job, take: Callable[[Sequence[Job]], None]) -> LossError | None:
    """Compute a job while no other is computed; return how its worker ended, if it did."""
    try:
        take([job])
    except LossError as error:
        return error
    return None


def _spread(jobs: Sequence[Job]) -> Sequence[Job]:
    """Return some jobs from the whole of a list, its ends first."""
    last = len(jobs) - 1
    places = [0, last, *(last * k // (_MOST_TRIED - 1) for k in range(1, _MOST_TRIED - 1))]
    return [jobs[k] for k in dict.fromkeys(places)]


def _outcomes(
    jobs: Sequence[Job], backend: Backend, report: Callable[[str], None]
) -> Generator[JobOutcome, None, None]:
    """Yield outcomes in the order of completion; raise LossError where a worker ends."""
    from joblib import Parallel, delayed

    if backend.backend == "dask":
        yield from dask_outcomes(jobs, str(backend.address), report)
        return
    begun: list[Job] = []

    def tasks() -> Iterator[Any]:
        for job in jobs:
            begun.append(job)
            yield delayed(outcome_of)(job)

    # A single job, too, has a process of its own where several are allowed.
    processes = 1 if backend.jobs == 1 else max(2, min(backend.jobs, len(jobs)))
    # One job is one task, so that each outcome is kept as soon as it exists.
    parallel = Parallel(
        processes,
        backend=local_processes(_IDLE),
        return_as="generator_unordered",
        batch_size=1,  # pyright: ignore[reportArgumentType]
    )
    with (
        closing(cast("Generator[JobOutcome, None, None]", parallel(tasks()))) as outcomes,
        warnings.catch_warnings(),
    ):
        # joblib warns of tasks that nobody waits for, which closing this early intends.
        warnings.simplefilter("ignore", UserWarning)
        try:
            yield from outcomes
        except Exception as error:  # those of jobs are in their outcomes
            raise LossError(error, begun) from error
