"""The episodes of an evaluation in several processes."""

from __future__ import annotations

import pytest

from agents import evaluate
from agents.policy import Policy
from safe_envs.errors import ConfigurationError


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


def test_what_cannot_be_sent_is_explained():
    with pytest.raises(ConfigurationError, match="use jobs=1"):
        evaluate("Scalar-v0", _Stuck(), filters=["none"], episodes=4, jobs=2)


def test_pictures_are_of_one_process():
    with pytest.raises(ConfigurationError, match="leave jobs out"):
        evaluate("Scalar-v0", episodes=4, jobs=2, record=True)
    with pytest.raises(ConfigurationError, match="jobs = 0"):
        evaluate("Scalar-v0", episodes=4, jobs=0)
