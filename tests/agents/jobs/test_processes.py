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

ROOT = Path(__file__).parents[3]


def test_the_answer_does_not_depend_on_the_number_of_processes(tmp_path):
    told = []
    arguments = {"filters": ["none", "scbf"], "episodes": 30, "num_envs": 3}
    arguments["monitoring"] = "continuous"
    one = evaluate("CubicSDEDisk-v0", "random", **arguments)
    two = evaluate("CubicSDEDisk-v0", "random", jobs=2, progress=told.append, **arguments)
    assert (one.rows, one.comparisons, one.config) == (two.rows, two.comparisons, two.config)
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1.0)
    # Functions of a file go along.
    place = tmp_path / "mine.py"
    place.write_text((ROOT / "examples" / "pendulum_v1.py").read_text())
    arguments = {"filters": ["hocbf"], "episodes": 4, "bounds": False}
    arguments["filter_spec"] = f"{place}:spec"
    one, two = (evaluate("Pendulum-v1", jobs=jobs, **arguments).rows for jobs in (1, 2))
    assert one == two


class Still(Policy):
    """Does nothing, and more in another process."""

    def __init__(self) -> None:
        self.parent = os.getpid()

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        if os.getpid() != self.parent:
            self.elsewhere()
        return observation[:, :1] * 0.0, state

    def elsewhere(self):
        assert "end_with_parent" in {thread.name for thread in threading.enumerate()}


class Stuck(Still):
    """Holds what no other process can have."""

    def __init__(self) -> None:
        self.generator = (i for i in range(3))


class Failing(Still):
    """Fails in its own code, which is no question of processes."""

    def elsewhere(self):
        raise TypeError("of the policy's own")


class Ending(Still):
    """Ends its process, as the operating system does when memory runs out."""

    def elsewhere(self):
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize(
    ("policy", "arguments", "error", "fragment"),
    [
        (Failing(), {"jobs": 2}, InvalidInputError, r"Failing.*TypeError: of the policy's own"),
        (Ending(), {"jobs": 2}, WorkersLostError, "jobs = 2"),
        (Stuck(), {"jobs": 2}, ConfigurationError, "jobs=1"),
        ("zero", {"jobs": 2, "record": True}, ConfigurationError, "jobs"),
        ("zero", {"jobs": 0}, ConfigurationError, "jobs = 0"),
    ],
)
def test_what_ends_an_evaluation_is_told(policy, arguments, error, fragment):
    with pytest.raises(error, match=fragment):
        evaluate("Scalar-v0", policy, filters=["none"], episodes=4, **arguments)


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
    evaluate("Scalar-v0", Still(), filters=["none"], episodes=4, bounds=False, jobs=2)
    script, folder = tmp_path / "parent.py", tmp_path / "workers"
    script.write_text(PARENT)
    folder.mkdir()
    parent = subprocess.Popen(
        [sys.executable, str(script), str(folder)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
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
