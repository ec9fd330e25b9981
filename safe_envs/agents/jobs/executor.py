"""Where the cells of a sweep are computed: by joblib in processes of this machine, on a Dask
scheduler or on a Ray cluster."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, cast

from safe_envs.agents.jobs.clusters import TaskLostError, dask_settings, ray_settings
from safe_envs.agents.jobs.processes import local_processes
from safe_envs.agents.sweeps.cell import Cell, Outcome, compute
from safe_envs.errors import (
    ConfigurationError,
    SafeEnvsError,
    WorkersLostError,
    nearest,
    require_whole,
)

BACKENDS = ("local", "dask", "ray")

_MOST_LOSSES = 3
"""How often processes of this machine may end before cells are computed one by one; clusters have a
number of their own."""

_MOST_TRIED = 5
"""How many cells are tried, one by one, before it is said that none can be computed."""

_IDLE = 30
"""Seconds after which a process of this machine ends that has nothing to do."""


class _LossError(Exception):
    """A worker ended.

    Attributes:
        cells: those that may have been under way with it.
    """

    def __init__(self, reason: str, cells: Sequence[Cell]) -> None:
        super().__init__(reason)
        self.cells = cells


@dataclass(frozen=True)
class Backend:
    """Where to compute.

    Attributes:
        backend: one of `BACKENDS`.
        address: of a Dask scheduler (tcp://HOST:PORT) or of a Ray cluster (HOST:PORT).
        jobs: processes of this machine, for "local"; a cluster's workers are all used.

    Raises:
        ConfigurationError: the backend is unknown, an address is missing or out of place, or a
            package is not installed.
    """

    backend: str = "local"
    address: str | None = None
    jobs: int = 2

    def __post_init__(self) -> None:
        require_whole("jobs", self.jobs, 1)
        if self.backend not in BACKENDS:
            raise ConfigurationError(
                f"backend = {self.backend!r}; {nearest(self.backend, BACKENDS)}"
            )
        if (self.address is None) != (self.backend == "local"):
            wrong = (
                "needs the address of its cluster"
                if self.address is None
                else "takes no address; name dask or ray as the backend"
            )
            raise ConfigurationError(f"backend {self.backend} {wrong}")
        package = {"dask": "distributed", "ray": "ray"}.get(self.backend)
        if package is not None and find_spec(package) is None:
            raise ConfigurationError(
                f"{package} is not installed; install it with pip install"
                f' "safe-envs[{self.backend}]"'
            )


def run(
    cells: Iterable[Cell],
    place: Backend,
    keep: Callable[[Outcome], None],
    tell: Callable[[str], None] = lambda _: None,
) -> None:
    """Compute cells, each once.

    When a worker ends, what was under way is computed again. After several such losses those that
    were under way are computed one by one, up to the first that ends its worker by itself (as for
    want of memory), which counts as failed; then the others go on side by side. As long as nothing
    was computed at all, some cells from the whole of the list are tried one by one in place of
    those.

    Args:
        cells: what to compute. What comes out does not depend on their order.
        place: where.
        keep: told each outcome as soon as it is there, in the order of completion.
        tell: told what the user should know while the others wait, such as that a cluster has no
            workers any more; by any thread.

    Raises:
        ConfigurationError: a cluster cannot be reached, or has no workers.
        WorkersLostError: workers end before they have computed anything.
    """
    missing = {cell.key: cell for cell in cells}
    any_computed = False

    def take(some: Sequence[Cell]) -> None:
        nonlocal any_computed
        with closing(_outcomes(some, place, tell)) as outcomes:
            for outcome in outcomes:
                keep(outcome)
                del missing[outcome.key]
                any_computed = True

    # Every pass through this loop makes them fewer: each cell that is tried alone is computed, or
    # counts as failed.
    while missing:
        try:
            _persistently(
                lambda: take(list(missing.values())),
                _MOST_LOSSES if place.backend == "local" else 1,
            )
        except _LossError as loss:
            under_way = [cell for cell in loss.cells if cell.key in missing] if any_computed else []
            # One that was by itself need not be tried again; Dask names one of several.
            was_alone = len(under_way) == 1 and place.backend != "dask"
            error: _LossError | None = loss
            for cell in under_way or _spread(list(missing.values())):
                error = loss if was_alone else _alone(cell, take)
                if error is not None:
                    keep(
                        Outcome(
                            cell.key,
                            None,
                            None,
                            f"the process that computed it ended: {error}",
                            0.0,
                        )
                    )
                    del missing[cell.key]
                if any_computed and (error is not None or not under_way):
                    break
            if missing and not any_computed:
                raise WorkersLostError(
                    f"no cell could be computed, since the processes for it end; the last: {error}."
                    " Look for the reason, such as too little memory or another installation on"
                    " the workers, and start again"
                ) from error


def _persistently(take: Callable[[], None], times: int) -> None:
    """Do it again as long as a worker ends on the way; raise _LossError at the last loss."""
    for attempt in range(1, times + 1):
        try:
            return take()
        except _LossError:
            if attempt == times:
                raise
    return None


def _alone(cell: Cell, take: Callable[[Sequence[Cell]], None]) -> _LossError | None:
    """Compute a cell with no other beside it; how its worker ended, if it did."""
    try:
        take([cell])
    except _LossError as error:
        return error
    return None


def _spread(cells: Sequence[Cell]) -> Sequence[Cell]:
    """Some cells from the whole of a list, its ends first."""
    last = len(cells) - 1
    places = [0, last, *(last * k // (_MOST_TRIED - 1) for k in range(1, _MOST_TRIED - 1))]
    return [cells[k] for k in dict.fromkeys(places)]


def _outcomes(
    cells: Sequence[Cell], place: Backend, tell: Callable[[str], None]
) -> Generator[Outcome, None, None]:
    """Outcomes as they come.

    Raises:
        _LossError: a worker ended.
    """
    from joblib import Parallel, delayed

    begun: list[Cell] = []

    def tasks() -> Iterator[Any]:
        for cell in cells:
            begun.append(cell)
            yield delayed(compute)(cell)

    with _settings(place, len(cells), tell) as settings:
        # One cell is one task, so that each is kept as soon as it is done.
        parallel = Parallel(return_as="generator_unordered", batch_size=1, **settings)  # pyright: ignore[reportArgumentType]
        with (
            closing(cast("Generator[Outcome, None, None]", parallel(tasks()))) as outcomes,
            warnings.catch_warnings(),
        ):
            # joblib warns of what is not waited for, which is meant when this is closed early.
            warnings.simplefilter("ignore", UserWarning)
            try:
                yield from outcomes
            except SafeEnvsError:
                raise
            except TaskLostError as error:
                raise _LossError(_told(error.reason), error.cells) from error
            except Exception as error:  # Those of cells are in their outcomes.
                raise _LossError(_told(error), begun) from error


def _told(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0].rstrip(".")


@contextmanager
def _settings(place: Backend, count: int, tell: Callable[[str], None]) -> Iterator[dict[str, Any]]:
    """The arguments of joblib for a place, connected as long as the context lasts."""
    if place.backend == "local":
        # A single cell of several jobs is to have a process of its own too.
        jobs = 1 if place.jobs == 1 else max(2, min(place.jobs, count))
        yield {"backend": local_processes(_IDLE), "n_jobs": jobs}
    elif place.backend == "dask":
        with dask_settings(str(place.address), tell) as settings:
            yield settings
    else:
        with ray_settings(str(place.address)) as settings:
            yield settings
