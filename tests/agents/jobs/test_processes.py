"""The episodes of an evaluation in several processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest

from safe_envs.agents import evaluate
from safe_envs.agents.policies.base import Policy
from safe_envs.errors import ConfigurationError, InvalidInputError, WorkersLostError

pytestmark = pytest.mark.slow


def test_the_answer_does_not_depend_on_the_number_of_processes():
    told = []
    arguments = {
        "filters": ["none", "scbf"],
        "episodes": 30,
        "num_envs": 3,
        "monitoring": "continuous",
    }
    one = evaluate("CubicSDEDisk-v0", "random", **arguments)
    two = evaluate("CubicSDEDisk-v0", "random", jobs=2, progress=told.append, **arguments)
    assert one.rows == two.rows
    assert one.comparisons == two.comparisons
    assert one.config == two.config
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1.0)


class _Stuck(Policy):
    """Holds what no other process can have."""

    def __init__(self) -> None:
        self.generator = (i for i in range(3))

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return observation[:, :1] * 0.0, state


def test_functions_of_a_file_go_along(tmp_path):
    place = tmp_path / "mine.py"
    place.write_text((Path(__file__).parents[3] / "examples" / "pendulum_v1.py").read_text())
    arguments = {
        "filters": ["hocbf"],
        "episodes": 4,
        "bounds": False,
        "filter_spec": f"{place}:spec",
    }
    assert (
        evaluate("Pendulum-v1", jobs=2, **arguments).rows
        == evaluate("Pendulum-v1", **arguments).rows
    )


class _Failing(Policy):
    """Fails in its own code, which is no question of processes."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        raise TypeError("of the policy's own")


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_error_of_a_policy_is_told_as_its_own(jobs):
    with pytest.raises(
        InvalidInputError, match=r"_Failing failed .*TypeError: of the policy's own"
    ):
        evaluate("Scalar-v0", _Failing(), filters=["none"], episodes=4, jobs=jobs)


class _Watched(Policy):
    """Fails in a process that would outlive the one that started it."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert "end_with_parent" in {thread.name for thread in threading.enumerate()}
        return observation[:, :1] * 0.0, state


def test_the_processes_of_an_evaluation_watch_their_parent():
    assert evaluate(
        "Scalar-v0", _Watched(), filters=["none"], episodes=4, bounds=False, jobs=2
    ).rows
    with pytest.raises(InvalidInputError, match="AssertionError"):
        evaluate("Scalar-v0", _Watched(), filters=["none"], episodes=4, bounds=False, jobs=1)


class _Ending(Policy):
    """Ends its process, as the operating system does when memory runs out."""

    def __init__(self) -> None:
        self.parent = os.getpid()

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        if os.getpid() != self.parent:
            os.kill(os.getpid(), signal.SIGKILL)
        return observation[:, :1] * 0.0, state


def test_a_lost_process_is_told():
    with pytest.raises(WorkersLostError, match="ended from outside"):
        evaluate("Scalar-v0", _Ending(), filters=["none"], episodes=4, jobs=2)


def test_what_cannot_be_sent_is_explained():
    with pytest.raises(ConfigurationError, match="use jobs=1"):
        evaluate("Scalar-v0", _Stuck(), filters=["none"], episodes=4, jobs=2)


def test_pictures_are_of_one_process():
    with pytest.raises(ConfigurationError, match="leave jobs out"):
        evaluate("Scalar-v0", episodes=4, jobs=2, record=True)
    with pytest.raises(ConfigurationError, match="jobs = 0"):
        evaluate("Scalar-v0", episodes=4, jobs=0)


PARENT = """
import os, sys, time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

def work(folder):
    Path(folder, str(os.getpid())).touch()
    # As long as nobody ends it, and it does not wait for anything.
    while True:
        sum(range(10**6))

if __name__ == "__main__":
    from joblib import Parallel, delayed
    from safe_envs.agents.jobs.executor import end_with_parent, local_processes

    pool = ProcessPoolExecutor(
        1, mp_context=get_context("spawn"), initializer=end_with_parent, initargs=(os.getpid(),)
    )
    pool.submit(work, sys.argv[1])
    Parallel(2, backend=local_processes())(delayed(work)(sys.argv[1]) for _ in range(2))
"""


def test_workers_of_a_parent_that_was_killed_end(tmp_path):
    script, folder = tmp_path / "parent.py", tmp_path / "workers"
    script.write_text(PARENT)
    folder.mkdir()
    root = Path(__file__).parents[3]
    parent = subprocess.Popen(
        [sys.executable, str(script), str(folder)],
        env={**os.environ, "PYTHONPATH": str(root)},
        start_new_session=True,
    )
    try:
        wait_until(lambda: len(list(folder.iterdir())) == 3)
        workers = [int(path.name) for path in folder.iterdir()]
        parent.kill()
        parent.wait()
        wait_until(lambda: not any(map(is_running, workers)))
    finally:
        with suppress(ProcessLookupError):
            os.killpg(parent.pid, signal.SIGKILL)


def wait_until(condition, seconds=240):
    """Fail if it takes longer, on a busy machine too; a worker looks once a second."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def is_running(process):
    """Return whether there is such a process, but for one that has ended unnoticed."""
    status = Path(f"/proc/{process}/stat")
    if status.parent.parent.joinpath("self").exists():
        return status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z"
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True
