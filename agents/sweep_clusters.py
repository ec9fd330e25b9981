"""joblib's own backends for Dask and Ray, with the loss of a worker told to joblib in place of waited for without end."""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from safe_envs.errors import ConfigurationError

_PATIENCE = 15
"""Seconds to wait for a scheduler, and for its first worker."""

_RETRIES = 2
"""How often Ray starts a cell again whose worker has ended; Dask's own setting says it for Dask."""


@contextmanager
def dask_settings(address: str) -> Iterator[dict[str, Any]]:
    """The arguments of `joblib.Parallel` for a Dask scheduler.

    Raises:
        ConfigurationError: there is none, or it has no workers.
    """
    from distributed import Client
    from joblib._dask import DaskDistributedBackend

    class Dask(DaskDistributedBackend):
        def effective_n_jobs(self, n_jobs: int) -> int:
            # joblib computes in this process where there is one worker.
            return max(super().effective_n_jobs(n_jobs), 2)

        def submit(self, func: Any, callback: Callable[[Any], None] | None = None) -> Any:
            future = super().submit(func, callback)
            if callback is not None:
                # Of a task that ended with an error outside of its function, joblib would never hear.
                future.add_done_callback(lambda done: callback(done.exception()) if done.exception() else None)
            return future

        def retrieve_result_callback(self, out: Any) -> Any:
            return super().retrieve_result_callback(_require_result(out))

    try:
        client = Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"no Dask scheduler answers at {address} ({error}); start one by: dask scheduler") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
        except TimeoutError as error:
            raise ConfigurationError(f"the Dask scheduler at {address} has no workers; start some by: dask worker {address}") from error
        # All at once: workers that come later get some, too.
        yield {"backend": Dask(client=client), "n_jobs": -1, "pre_dispatch": "all"}


@contextmanager
def ray_settings(address: str) -> Iterator[dict[str, Any]]:
    """The arguments of `joblib.Parallel` for a Ray cluster.

    Raises:
        ConfigurationError: it cannot be reached.
    """
    import ray
    from ray.util.joblib.ray_backend import RayBackend

    class Ray(RayBackend):
        supports_return_generator = True

        def retrieve_result_callback(self, result: Any) -> Any:
            return super().retrieve_result_callback(_require_result(result))

    try:
        _require_listener(address)
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigurationError(f"no Ray cluster answers at {address} ({reason}); start one by: ray start --head") from error
    try:
        remote = {"max_restarts": -1, "max_task_retries": _RETRIES}
        yield {"backend": Ray(ray_remote_args=remote), "n_jobs": -1}
    finally:
        ray.shutdown()


def _require_listener(address: str) -> None:
    """Raise OSError unless something listens at HOST:PORT; Ray itself would try for minutes."""
    host, _, port = address.rpartition(":")
    if host and port.isdecimal() and "/" not in host:
        socket.create_connection((host, int(port)), timeout=_PATIENCE).close()


def _require_result(out: Any) -> Any:
    """What came back of a task; raises it if it is an error."""
    if isinstance(out, BaseException):
        raise out
    return out
