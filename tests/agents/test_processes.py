"""The episodes of an evaluation in several processes."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from agents import evaluate
from agents.policy import Policy
from safe_envs.errors import ConfigurationError, WorkersLostError


def test_the_answer_does_not_depend_on_the_number_of_processes():
    told = []
    arguments = {"filters": ["none", "scbf"], "episodes": 30, "num_envs": 3, "monitoring": "continuous"}
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
    place.write_text((Path(__file__).parents[2] / "examples" / "pendulum_v1.py").read_text())
    arguments = {"filters": ["hocbf"], "episodes": 4, "bounds": False, "spec": f"{place}:spec"}
    assert evaluate("Pendulum-v1", jobs=2, **arguments).rows == evaluate("Pendulum-v1", **arguments).rows


class _Failing(Policy):
    """Fails in its own code, which is no question of processes."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        raise TypeError("of the policy's own")


def test_an_error_of_a_policy_stays_what_it_is():
    with pytest.raises(TypeError, match="of the policy's own"):
        evaluate("Scalar-v0", _Failing(), filters=["none"], episodes=4, jobs=2)


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
