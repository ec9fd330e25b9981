"""Where the cells of a sweep are computed: by joblib in processes of this machine, on a Dask scheduler or on a Ray cluster."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from agents.sweep_cell import Cell, Outcome, compute
from safe_envs.errors import ConfigurationError, SafeEnvsError, nearest, require_whole

BACKENDS = ("local", "dask", "ray")

_MOST_LOSSES = 3
"""How often all workers may be started again, and how many single cells in a row may lose theirs, before something must be wrong."""

_IDLE = 30
"""Seconds after which a process of this machine ends that has nothing to do, as when the one that started it was killed."""


class WorkersLostError(SafeEnvsError, RuntimeError):
    """Processes that compute cells end, again and again."""


class _LossError(Exception):
    """A worker ended, and the cells that were under way with it."""


@dataclass(frozen=True)
class Place:
    """Where to compute.

    Attributes:
        backend: one of `BACKENDS`.
        address: of a Dask scheduler (tcp://HOST:PORT) or of a Ray cluster (HOST:PORT).
        jobs: processes of this machine, for "local"; a cluster's workers are all used.

    Raises:
        ConfigurationError: the backend is unknown, an address is missing or out of place, or a package is not installed.
    """

    backend: str = "local"
    address: str | None = None
    jobs: int = 2

    def __post_init__(self) -> None:
        require_whole("jobs", self.jobs, 1)
        if self.backend not in BACKENDS:
            raise ConfigurationError(f"backend = {self.backend!r}; {nearest(self.backend, BACKENDS)}")
        if (self.address is None) != (self.backend == "local"):
            wrong = "needs the address of its cluster" if self.address is None else "takes no address; name dask or ray as the backend"
            raise ConfigurationError(f"backend {self.backend} {wrong}")
        for package, extra in (("joblib", "sweep"), ({"dask": "distributed"}.get(self.backend, self.backend), self.backend)):
            if extra != "local" and find_spec(package) is None:
                raise ConfigurationError(f'{package} is not installed; install it with pip install "safe-envs[{extra}]"')


def run(cells: Iterable[Cell], place: Place, keep: Callable[[Outcome], None]) -> None:
    """Compute cells, each once.

    When a worker ends, what was under way is computed again. After several such losses the cells that are left are computed one
    by one, so that one which ends its worker (as for want of memory) is found, and counted as failed.

    Args:
        cells: what to compute. What comes out does not depend on their order.
        place: where.
        keep: told each outcome as soon as it is there, in the order of completion.

    Raises:
        ConfigurationError: a cluster cannot be reached, or has no workers.
        WorkersLostError: workers end, whatever they compute.
    """
    missing = {cell.key: cell for cell in cells}

    def take(some: Sequence[Cell]) -> None:
        with closing(_outcomes(some, place)) as outcomes:
            for outcome in outcomes:
                keep(outcome)
                del missing[outcome.key]

    for _ in range(_MOST_LOSSES):
        try:
            return take(list(missing.values()))
        except _LossError:
            continue
    in_a_row = 0
    for cell in list(missing.values()):
        try:
            take([cell])
            in_a_row = 0
        except _LossError as error:
            in_a_row += 1
            if in_a_row == _MOST_LOSSES:
                raise WorkersLostError(
                    f"{in_a_row} cells one after the other lost the process that computed them; the last: {error}. Look for its reason, such "
                    "as too little memory or another installation on the workers, and start again: what is finished is not done again"
                ) from error
            keep(Outcome(cell.key, None, None, f"the process that computed it ended: {error}", 0.0))
    return None


def _outcomes(cells: Sequence[Cell], place: Place) -> Iterator[Outcome]:
    """Outcomes as they come.

    Raises:
        _LossError: a worker ended.
    """
    from joblib import Parallel, delayed

    with _settings(place, len(cells)) as settings:
        # One cell is one task, so that each is kept as soon as it is done.
        parallel = Parallel(return_as="generator_unordered", batch_size=1, **settings)
        with closing(parallel(delayed(compute)(cell) for cell in cells)) as outcomes, warnings.catch_warnings():
            # joblib warns of what is not waited for, which is meant when this is closed early.
            warnings.simplefilter("ignore", UserWarning)
            try:
                yield from outcomes
            except Exception as error:  # Those of cells are in their outcomes.
                raise _LossError(f"{type(error).__name__}: {error}".splitlines()[0]) from error


@contextmanager
def _settings(place: Place, count: int) -> Iterator[dict[str, Any]]:
    """The arguments of joblib for a place, connected as long as the context lasts."""
    if place.backend == "local":
        from joblib._parallel_backends import LokyBackend

        # A single cell of several jobs is to have a process of its own too.
        jobs = 1 if place.jobs == 1 else max(2, min(place.jobs, count))
        yield {"backend": LokyBackend(idle_worker_timeout=_IDLE), "n_jobs": jobs}
    else:
        from agents.sweep_clusters import dask_settings, ray_settings

        with (dask_settings if place.backend == "dask" else ray_settings)(str(place.address)) as settings:
            yield settings
