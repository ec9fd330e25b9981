"""Jobs in processes, some of which end in the middle: of this machine, and of Dask."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from safe_envs.agents.jobs import clusters, executor
from safe_envs.agents.jobs.executor import Backend, run
from safe_envs.agents.jobs.job import Job, JobOutcome, LossError
from safe_envs.errors import ConfigurationError, WorkersLostError

pytestmark = pytest.mark.slow

LONG = 240
"""Seconds that no cluster takes, on whatever machine."""


@dataclass(frozen=True)
class Task:
    """Computes a square: "ends" with the first process that computes it, "kills" every one."""

    key: str
    folder: Path = Path()
    how: str = "plain"
    spared: int = field(default_factory=os.getpid)

    def compute(self) -> tuple[int, bool]:
        marker = self.folder / "ended"
        if self.how == "fails":
            raise OSError("no such thing")
        if self.how == "kills" or (self.how == "ends" and not marker.exists()):
            marker.touch()
            assert os.getpid() != self.spared
            os.kill(os.getpid(), signal.SIGKILL)
        watched = "end_with_parent" in {thread.name for thread in threading.enumerate()}
        return int(self.key) ** 2, watched


def computed(tasks: Sequence[Job], place: Backend) -> dict[str, JobOutcome]:
    outcomes: list[JobOutcome] = []
    run(tasks, place, outcomes.append)
    assert len(outcomes) == len(tasks)
    return {outcome.key: outcome for outcome in outcomes}


def mixed(folder: Path) -> list[Task]:
    return [
        Task(str(k), folder, {0: "ends", 4: "fails"}.get(k, "plain"), os.getpid()) for k in range(7)
    ]


def require_squares(found: dict[str, JobOutcome]) -> None:
    """Check that of `mixed` only the one that fails has no result."""
    failed = found.pop("4")
    assert "no such thing" in str(failed.error)
    for key, outcome in found.items():
        assert (outcome.error, outcome.result[0]) == (None, int(key) ** 2)


def test_a_killed_worker_and_a_failing_job_cost_no_other(tmp_path: Path):
    # A single job, too, has a process of its own, and each of these ends with this one.
    (single,) = computed([Task("3", tmp_path, "ends")], Backend(jobs=2)).values()
    assert single.result == (9, True)
    (tmp_path / "ended").unlink()
    require_squares(computed(mixed(tmp_path), Backend(jobs=2)))
    assert (tmp_path / "ended").exists()
    require_squares(computed(mixed(tmp_path), Backend(jobs=1)))


JOBS = [Task(str(k)) for k in range(8)]
ENDED = "the process that computed it ended: OSError: it went away"


class Pretended:
    """Two workers, which compute jobs in pairs, and end at the pairs that are said."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, ends: Callable[[set[int]], Any]) -> None:
        self.given: list[int] = []
        self.kept: dict[int, str | None] = {}
        self._ends = ends
        monkeypatch.setattr(executor, "_outcomes", self._outcomes)

    def compute(self) -> None:
        run(JOBS, Backend(), lambda outcome: self.kept.update({int(outcome.key): outcome.error}))

    def _outcomes(self, jobs: Sequence[Job], *_: Any) -> Iterator[JobOutcome]:
        self.given.append(len(jobs))
        for k in range(0, len(jobs), 2):
            pair = jobs[k : k + 2]
            if self._ends({int(job.key) for job in pair}):
                raise LossError(OSError("it went away"), jobs[: k + 2])
            yield from (JobOutcome(job.key, None, None, 0.0) for job in pair)


@pytest.mark.parametrize(
    ("ends", "failed", "alone"),
    [
        *(
            (killing.intersection, killing, None)
            for killing in ({0, 1, 2}, {5, 6, 7}, {0, 2, 4, 6})
        ),
        # What is too much together is computed by itself; the others go on side by side.
        ({2, 3}.issubset, set(), 2),
        ({4}.intersection, {4}, 1),
    ],
)
def test_jobs_that_end_every_worker_are_found_wherever_they_stand(
    ends, failed, alone, monkeypatch: pytest.MonkeyPatch
):
    workers = Pretended(monkeypatch, ends)
    workers.compute()
    assert workers.kept == {k: ENDED if k in failed else None for k in range(8)}
    assert alone in (None, workers.given.count(1))


def test_workers_that_end_whatever_they_compute(monkeypatch: pytest.MonkeyPatch):
    workers = Pretended(monkeypatch, lambda pair: True)
    with pytest.raises(WorkersLostError, match="it went away"):
        workers.compute()
    # Some count as failed, so that the next run begins with others.
    assert workers.kept == dict.fromkeys([0, 7, 1, 3, 5], ENDED)


@pytest.mark.parametrize(
    ("arguments", "fragment"),
    [
        (("dsk", "127.0.0.1:1"), "'dask'"),
        (("ray", "127.0.0.1:1"), "use dask"),
        (("dask",), "address"),
        (("local", "127.0.0.1:1"), "address"),
        (("local", None, 0), "jobs = 0"),
    ],
)
def test_places_that_are_none(arguments: tuple[Any, ...], fragment: str):
    with pytest.raises(ConfigurationError, match=fragment):
        Backend(*arguments)


def test_without_the_package_its_extra_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(executor, "find_spec", lambda name: None if name == "distributed" else name)
    with pytest.raises(ConfigurationError, match=r"distributed.*\.\[dask\]"):
        Backend("dask", "tcp://127.0.0.1:1")


@pytest.mark.parametrize("address", ["foo", "", "http://127.0.0.1:8786", "tcp://127.0.0.1:9"])
def test_addresses_where_nobody_answers(address: str):
    with pytest.raises(ConfigurationError, match=f"answers at {address} "):
        run(JOBS, Backend("dask", address), print)


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
    monkeypatch.setattr(clusters, "_MOST_LOOKS", 3)
    told, looks = [], 0
    scheduler: Any = Scheduler(1, 0, OSError("busy"), 0, 1, 0, 0, 0)
    for expected in (0, 1, 1, 2, 0, 1, 2):
        looks = clusters.looked(scheduler, "tcp://HOST:PORT", looks, told.append)
        assert looks == expected
    with pytest.raises(ConfigurationError, match="has had no workers"):
        clusters.looked(scheduler, "tcp://HOST:PORT", looks, told.append)
    # Once each time that they went.
    assert len(told) == 2
    assert all("tcp://HOST:PORT has no workers" in each for each in told)


@contextmanager
def started(*commands: list[str], log: Path) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Processes with sessions of their own, which end with this context, and with all that they
    started."""
    processes = []
    try:
        with log.open("wb") as file:
            processes += [
                subprocess.Popen(words, stdout=file, stderr=file, start_new_session=True)
                for words in commands
            ]
        yield processes
    finally:
        for process in reversed(processes):
            process.terminate()
        for process in processes:
            with suppress(subprocess.TimeoutExpired):
                process.wait(30)
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def wait_for(process: subprocess.Popen[bytes], log: Path, path: Path, text: str) -> str:
    """What is in a file that a process writes, once it has a text in it."""
    for _ in range(LONG * 10):
        if path.exists() and text in path.read_text():
            return path.read_text()
        if process.poll() is not None:
            break
        time.sleep(0.1)
    raise RuntimeError(f"{path} has no {text!r}: {log.read_text()}")


@contextmanager
def limited() -> Iterator[None]:
    """What would wait for an answer that never comes ends, by what is no error that the runner
    could take for one of its workers."""

    def stop(*_: Any) -> None:
        pytest.fail(f"no answer in {LONG} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(LONG)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.cluster
def test_dask_with_a_killed_worker_and_with_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "0")
    file, log = tmp_path / "scheduler.json", tmp_path / "log"
    common = ["--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(file)]
    scheduler = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", *common]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--no-nanny", *common]
    worker += ["--nthreads", "1"]
    with started(scheduler, log=log) as (process,):
        place = Backend("dask", json.loads(wait_for(process, log, file, "\n}"))["address"])
        killing = [Task("1", tmp_path, "kills")]
        with started(worker, worker, worker, log=tmp_path / "log-of-workers") as workers, limited():
            require_squares(computed(mixed(tmp_path), place))
            assert sorted(process.poll() is None for process in workers) == [False, True, True]
            # Among others, and by itself.
            error = computed(killing, place)["1"].error
            assert str(error).startswith("the process that computed it ended: KilledWorker")
        monkeypatch.setattr(clusters, "_PATIENCE", 1)
        with pytest.raises(ConfigurationError, match="has no workers"):
            computed(killing, place)
