"""Sweeps over real processes, some of which end in the middle: on this machine, on a Dask
scheduler, and on a Ray cluster."""

from __future__ import annotations

import json
import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from safe_envs.agents.jobs import clusters, executor
from safe_envs.agents.jobs.executor import Backend, end_with_parent, run
from safe_envs.agents.sweeps.spec import sweep_of
from safe_envs.agents.sweeps.store import Store, read
from safe_envs.errors import ConfigurationError

pytestmark = pytest.mark.slow

# With "ends", the first process that simulates it is killed, in the middle of the cell; with
# "kills", every one but that of the tests.
SYSTEM = """
import os, signal
from pathlib import Path
from safe_envs.registry import make_problem

def problem(kind="plain"):
    marker = Path(__file__).with_suffix(".ended")
    if kind == "fails":
        raise OSError("no such thing")
    if kind == "kills" or (kind == "ends" and not marker.exists()):
        marker.touch()
        assert os.getpid() != SPARED
        os.kill(os.getpid(), signal.SIGKILL)
    return make_problem("Scalar-v0", horizon=0.2)
"""

# The sweep of a file, told where: in a process of its own, which may be made to end after some
# cells.
DRIVER = """
import json, os, signal, sys
from pathlib import Path
from safe_envs.agents.jobs import clusters
from safe_envs.agents.sweeps.spec import sweep_of
from safe_envs.agents.jobs.executor import Backend, run
from safe_envs.agents.sweeps.store import Store

clusters._RETRIES = 1
spec, out, backend, address, jobs, last = sys.argv[1:]
store = Store(Path(out), sweep_of(json.loads(Path(spec).read_text())))
left = int(last)

def keep(outcome):
    global left
    store.keep(outcome)
    left -= 1
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)

run(store.missing, Backend(backend, address or None, int(jobs)), keep)
"""

LONG = 240
"""Seconds that nothing here takes, on whatever machine."""

Document = dict[str, Any]


@pytest.fixture
def document(tmp_path: Path) -> Document:
    # In the file, not in the environment: workers that another test has started have that one's.
    (tmp_path / "system.py").write_text(f"SPARED = {os.getpid()}\n{SYSTEM}")
    fixed = {"system": f"{tmp_path / 'system.py'}:problem", "filter": "scbf", "episodes": 20}
    return {
        "fixed": fixed,
        "grid": {"noise": [0.1, 0.3], "seed": [0, 1, 2]},
        "cells": [{"barrier.kind": "fails"}],
    }


def killing(document: Document) -> Document:
    """A cell that ends every process that computes it."""
    return {"fixed": {**document["fixed"], "barrier.kind": "kills"}}


def with_end(document: Document) -> Document:
    """The same, and a cell in front that ends the first process that computes it."""
    return {**document, "grid": {"barrier.kind": ["ends", "plain"], **document["grid"]}}


def computed(document: Document, folder: Path, place: Backend) -> list[dict[str, Any]]:
    store = Store(folder, sweep_of(document))
    run(store.missing, place, store.keep)
    return rows(folder)


def rows(folder: Path) -> list[dict[str, Any]]:
    """What must be the same wherever it is computed."""
    return read(folder).drop_columns(["seconds"]).to_pylist()


def driver(
    document: Document, folder: Path, place: Backend, last: int = -1
) -> subprocess.CompletedProcess[str]:
    spec = folder.with_suffix(".json")
    spec.write_text(json.dumps(document))
    words = [str(spec), str(folder), place.backend, place.address or "", str(place.jobs), str(last)]
    return subprocess.run(
        [sys.executable, "-c", DRIVER, *words],
        capture_output=True,
        text=True,
        timeout=LONG,
        check=False,
    )


def local_answer(document: Document, folder: Path) -> list[dict[str, Any]]:
    """In this process; what ends a process once has done so already."""
    Path(document["fixed"]["system"].rpartition(":")[0]).with_suffix(".ended").touch()
    return computed(document, folder, Backend(jobs=1))


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
    """What would wait for an answer that never comes ends, by what is no error that a sweep could
    take for one of its workers."""

    def stop(*_: Any) -> None:
        pytest.fail(f"no answer in {LONG} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(LONG)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def free_port() -> int:
    """A port that the system chooses, for what does not ask it itself."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def test_a_killed_worker_and_a_failing_cell_cost_no_other(tmp_path: Path, document: Document):
    document = with_end(document)
    # By itself, too, it has a process of its own; in a file of its own, as a process may remember
    # the system that it has read.
    (tmp_path / "alone.py").write_text((tmp_path / "system.py").read_text())
    alone = {"system": f"{tmp_path / 'alone.py'}:problem", "barrier.kind": "ends"}
    single = {"fixed": {**document["fixed"], **alone}}
    assert [row["error"] for row in computed(single, tmp_path / "single", Backend(jobs=2))] == [
        None
    ]
    assert (tmp_path / "alone.ended").exists()
    found = computed(document, tmp_path / "two", Backend(jobs=2))
    assert (tmp_path / "system.ended").exists()
    *errors, last = [row["error"] for row in found]
    assert errors == [None] * 12
    assert "no such thing" in last
    assert found == local_answer(document, tmp_path / "one")


def test_a_killed_run_goes_on_where_it_was(tmp_path: Path, document: Document):
    folder = tmp_path / "out"
    assert driver(document, folder, Backend(jobs=1), last=3).returncode == -signal.SIGKILL
    before = {path: path.stat().st_mtime_ns for path in (folder / "cells").iterdir()}
    assert len(before) == 3
    seen: list[str] = []
    store = Store(folder, sweep_of(document))
    run(
        store.missing,
        Backend(jobs=1),
        lambda outcome: (seen.append(outcome.key), store.keep(outcome))[0],
    )
    assert len(seen) == 4
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert rows(folder) == local_answer(document, tmp_path / "one")


def test_the_processes_of_a_sweep_watch_their_parent():
    with executor._settings(Backend(jobs=2), 3, print) as settings:
        assert settings["n_jobs"] == 2
        assert settings["backend"].backend_kwargs["initializer"] is end_with_parent
        assert settings["backend"].backend_kwargs["initargs"] == (os.getpid(),)


@pytest.mark.cluster
def test_dask_with_a_killed_worker_and_with_none(
    tmp_path: Path, document: Document, monkeypatch: pytest.MonkeyPatch
):
    document = with_end(document)
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "0")
    file, log = tmp_path / "scheduler.json", tmp_path / "log"
    common = ["--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(file)]
    scheduler = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", *common]
    worker = [
        sys.executable,
        "-m",
        "distributed.cli.dask_worker",
        "--nthreads",
        "1",
        "--no-nanny",
        *common,
    ]
    with started(scheduler, log=log) as (process,):
        place = Backend("dask", json.loads(wait_for(process, log, file, "\n}"))["address"])
        with started(worker, worker, worker, log=tmp_path / "log-of-workers") as workers, limited():
            found = computed(document, tmp_path / "dask", place)
            assert sorted(process.poll() is None for process in workers) == [False, True, True]
            # Among others, and by itself.
            (killed,) = computed(killing(document), tmp_path / "killed", place)
            assert killed["error"].startswith("the process that computed it ended: KilledWorker")
        monkeypatch.setattr(clusters, "_PATIENCE", 1)
        with pytest.raises(ConfigurationError, match="has no workers"):
            computed(killing(document), tmp_path / "killed", place)
    assert found == local_answer(document, tmp_path / "one")


@pytest.fixture
def ray_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where a Ray cluster of this test alone keeps what it has: a short name, since those of
    sockets are."""
    with tempfile.TemporaryDirectory(prefix="ray-", ignore_cleanup_errors=True) as folder:
        for name, value in (
            ("RAY_TMPDIR", folder),
            ("RAY_AUTH_MODE", "token"),
            ("RAY_AUTH_TOKEN", secrets.token_hex(32)),
            ("RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S", "0"),
            # Ray takes 127.0.0.1 for the address of a node only where it takes itself to be
            # confined to one machine.
            ("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0"),
        ):
            monkeypatch.setenv(name, value)
        yield Path(folder)


@pytest.mark.cluster
def test_ray_with_a_killed_worker(tmp_path: Path, document: Document, ray_folder: Path):
    document = with_end(document)
    log = tmp_path / "log"
    where = [
        "--head",
        "--block",
        "--node-ip-address=127.0.0.1",
        "--port=0",
        f"--ray-client-server-port={free_port()}",
    ]
    size = [
        "--num-cpus=2",
        "--object-store-memory=100000000",
        "--include-dashboard=false",
        "--disable-usage-stats",
    ]
    with started(
        [sys.executable, "-m", "ray.scripts.scripts", "start", *where, *size], log=log
    ) as (process,):
        wait_for(process, log, log, "Ray runtime started")
        address = wait_for(process, log, ray_folder / "ray" / "ray_current_cluster", ":").strip()
        both = {**document, "cells": [*document["cells"], {"barrier.kind": "kills"}]}
        ended = driver(both, tmp_path / "ray", Backend("ray", address))
        assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "system.ended").exists()
    *others, killed = rows(tmp_path / "ray")
    assert killed["error"].startswith("the process that computed it ended: ")
    assert others == local_answer(document, tmp_path / "one")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("rai", "127.0.0.1:1"), "did you mean 'ray'"),
        (("dask",), "needs the address"),
        (("local", "127.0.0.1:1"), "takes no address"),
        (("local", None, 0), "give a whole number from 1"),
    ],
)
def test_places_that_are_none(arguments: tuple[Any, ...], message: str):
    with pytest.raises(ConfigurationError, match=message):
        Backend(*arguments)


def test_without_the_package_its_extra_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(executor, "find_spec", lambda name: None if name == "distributed" else name)
    with pytest.raises(ConfigurationError, match=r"distributed is not installed.*\.\[dask\]"):
        Backend("dask", "tcp://127.0.0.1:1")


def test_an_address_where_nobody_listens(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(clusters, "_PATIENCE", 1)
    dask, ray = "tcp://127.0.0.1:9", "127.0.0.1:9"
    with (
        pytest.raises(ConfigurationError, match=f"answers at {dask}"),
        clusters.dask_settings(dask, print),
    ):
        pass
    with pytest.raises(ConfigurationError, match=f"answers at {ray}"), clusters.ray_settings(ray):
        pass
