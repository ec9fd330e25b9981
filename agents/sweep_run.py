"""Where the cells of a sweep are computed: by joblib in processes of this machine, on a Dask scheduler or on a Ray cluster."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, cast

from agents.sweep_cell import Cell, Outcome, compute
from safe_envs.errors import ConfigurationError, SafeEnvsError, nearest, require_whole

BACKENDS = ("local", "dask", "ray")

_MOST_LOSSES = 3
"""How often workers may end before cells are computed one by one, and how many cells may be lost by then with none computed."""

_IDLE = 30
"""Seconds after which a process of this machine ends that has nothing to do, as when the one that started it was killed."""


class WorkersLostError(SafeEnvsError, RuntimeError):
    """Processes that are to compute cells end before they have computed any."""


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
        package = {"local": "joblib", "dask": "distributed", "ray": "ray"}[self.backend]
        if find_spec(package) is None:
            raise ConfigurationError(f'{package} is not installed; install it with pip install "safe-envs[{self.backend}]"')


def run(cells: Iterable[Cell], place: Place, keep: Callable[[Outcome], None]) -> None:
    """Compute cells, each once.

    When a worker ends, what was under way is computed again. After several such losses cells are computed one by one, until one that
    ends its worker (as for want of memory) is found, which counts as failed; then the others go on side by side.

    Args:
        cells: what to compute. What comes out does not depend on their order.
        place: where.
        keep: told each outcome as soon as it is there, in the order of completion.

    Raises:
        ConfigurationError: a cluster cannot be reached, or has no workers.
        WorkersLostError: workers end before they have computed anything.
    """
    missing = {cell.key: cell for cell in cells}
    any_computed = False

    def take(some: Sequence[Cell]) -> None:
        nonlocal any_computed
        with closing(_outcomes(some, place)) as outcomes:
            for outcome in outcomes:
                keep(outcome)
                del missing[outcome.key]
                any_computed = True

    lost = 0
    while missing:
        try:
            _persistently(lambda: take(list(missing.values())))
        except _LossError:
            cell, error = _first_lost(list(missing.values()), take)
            lost += cell is not None
            if lost == _MOST_LOSSES and not any_computed:
                raise WorkersLostError(
                    f"no cell could be computed, since the processes for it end; the last: {error}. Look for the reason, such as too "
                    "little memory or another installation on the workers, and start again"
                ) from error
            if cell is not None:
                keep(Outcome(cell.key, None, None, f"the process that computed it ended: {error}", 0.0))
                del missing[cell.key]


def _persistently(take: Callable[[], None]) -> None:
    """Do it again as long as a worker ends on the way; raise _LossError at the last loss."""
    for attempt in range(1, _MOST_LOSSES + 1):
        try:
            return take()
        except _LossError:
            if attempt == _MOST_LOSSES:
                raise
    return None


def _first_lost(cells: Sequence[Cell], take: Callable[[Sequence[Cell]], None]) -> tuple[Cell | None, _LossError | None]:
    """Compute cells one by one up to the first whose worker ends: that, and how; nothing if none does."""
    for cell in cells:
        try:
            take([cell])
        except _LossError as error:
            return cell, error
    return None, None


def _outcomes(cells: Sequence[Cell], place: Place) -> Generator[Outcome, None, None]:
    """Outcomes as they come.

    Raises:
        _LossError: a worker ended.
    """
    from joblib import Parallel, delayed

    with _settings(place, len(cells)) as settings:
        # One cell is one task, so that each is kept as soon as it is done.
        parallel = Parallel(return_as="generator_unordered", batch_size=1, **settings)  # pyright: ignore[reportArgumentType]
        tasks = (delayed(compute)(cell) for cell in cells)
        with closing(cast("Generator[Outcome, None, None]", parallel(tasks))) as outcomes, warnings.catch_warnings():
            # joblib warns of what is not waited for, which is meant when this is closed early.
            warnings.simplefilter("ignore", UserWarning)
            try:
                yield from outcomes
            except Exception as error:  # Those of cells are in their outcomes.
                raise _LossError(f"{type(error).__name__}: {error}".splitlines()[0].rstrip(".")) from error


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
