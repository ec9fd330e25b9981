"""Jobs whose workers end, with simulated workers."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import pytest

from safe_envs.agents.jobs import clusters, executor
from safe_envs.agents.jobs.executor import Backend, run
from safe_envs.agents.jobs.job import Job, JobOutcome
from safe_envs.errors import ConfigurationError, WorkersLostError

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Numbered:
    """A job that nobody computes."""

    key: str

    def compute(self) -> None:
        raise NotImplementedError


JOBS = [Numbered(str(k)) for k in range(8)]
ENDED = "the process that computed it ended: it went away"


class Pretended:
    """Two workers, which compute cells in pairs, and end at the pairs that are said."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, ends: Callable[[set[int]], Any]) -> None:
        self.given: list[int] = []
        self.kept: dict[int, str | None] = {}
        self._ends = ends
        monkeypatch.setattr(executor, "_outcomes", self._outcomes)

    def compute(self) -> dict[int, str | None]:
        """The errors of cells, in the order in which they were kept."""
        run(JOBS, Backend(), lambda outcome: self.kept.update({int(outcome.key): outcome.error}))
        return self.kept

    def _outcomes(self, jobs: Sequence[Job], *_: Any) -> Iterator[JobOutcome]:
        self.given.append(len(jobs))
        for k in range(0, len(jobs), 2):
            pair = jobs[k : k + 2]
            if self._ends({int(job.key) for job in pair}):
                raise executor._LossError("it went away", jobs[: k + 2])
            yield from (JobOutcome(job.key, None, None, 0.0) for job in pair)


@pytest.mark.parametrize("killing", [{0, 1, 2}, {5, 6, 7}, {0, 2, 4, 6}, {3}])
def test_cells_that_end_every_worker_are_found_wherever_they_stand(
    monkeypatch: pytest.MonkeyPatch, killing: set[int]
):
    found = Pretended(monkeypatch, killing.intersection).compute()
    assert found == {k: ENDED if k in killing else None for k in range(8)}


def test_only_what_was_under_way_is_computed_one_by_one(monkeypatch: pytest.MonkeyPatch):
    workers = Pretended(monkeypatch, lambda pair: 4 in pair)
    assert workers.compute()[4] == ENDED
    # All, what the first pairs left three times, the first of the pair that was under way by
    # itself, and the rest.
    assert workers.given == [8, 4, 4, 1, 3]


def test_cells_that_are_too_much_together_are_computed_one_by_one(monkeypatch: pytest.MonkeyPatch):
    workers = Pretended(monkeypatch, {2, 3}.issubset)
    assert set(workers.compute().values()) == {None}
    # The others go on side by side.
    assert workers.given == [8, 6, 6, 1, 1, 4]


def test_workers_that_end_whatever_they_compute(monkeypatch: pytest.MonkeyPatch):
    workers = Pretended(monkeypatch, lambda pair: True)
    with pytest.raises(
        WorkersLostError, match=r"nothing could be computed, .* the last: it went away"
    ):
        workers.compute()
    assert workers.given == [8, 8, 8, *[1] * 5]
    # They count as failed, so that the next run begins with others.
    assert workers.kept == dict.fromkeys([0, 7, 1, 3, 5], ENDED)


class Scheduler:
    """What a look at a scheduler finds, one look after the other."""

    def __init__(self, *found: int | Exception) -> None:
        self._found = list(found)

    def nthreads(self) -> dict[str, int]:
        """As of Dask's client."""
        found = self._found.pop(0)
        if isinstance(found, Exception):
            raise found
        return {"worker": 1} if found else {}


def test_a_scheduler_that_has_lost_its_workers(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(clusters, "_LOOK", 0.001)
    monkeypatch.setattr(clusters, "_MOST_LOOKS", 3)
    told, raised, ended = [], [], threading.Event()

    def give_up(error: Exception) -> None:
        raised.append(error)
        ended.set()

    scheduler: Any = Scheduler(1, 0, OSError("busy"), 0, 1, 0, 0, 0)
    clusters._watch(scheduler, "tcp://HOST:PORT", told.append, give_up, ended)
    # Once each time that they went.
    gone = (
        "The Dask scheduler at tcp://HOST:PORT has no workers any more; waiting for some. Start"
        " them by: dask worker tcp://HOST:PORT"
    )
    assert told == [gone, gone]
    (error,) = raised
    assert isinstance(error, ConfigurationError)
    assert "has had no workers for" in str(error)


@pytest.mark.parametrize("address", ["foo", "", "http://127.0.0.1:8786", "tcp://127.0.0.1"])
def test_addresses_of_dask_that_cannot_be_tried(address: str):
    with (
        pytest.raises(
            ConfigurationError, match=rf"answers at {address} \(this is not of the form HOST:PORT\)"
        ),
        clusters.dask_settings(address, print),
    ):
        pass


@pytest.mark.parametrize("address", ["auto", "ray://127.0.0.1:10001", "127.0.0.1", ":6379"])
def test_addresses_of_ray_that_cannot_be_tried(address: str):
    with (
        pytest.raises(
            ConfigurationError, match=rf"answers at {address} \(this is not of the form HOST:PORT\)"
        ),
        clusters.ray_settings(address),
    ):
        pass
