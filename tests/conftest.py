"""What all tests share."""

from __future__ import annotations

import gc
import os
import re
from pathlib import Path

# Before NumPy and torch are imported, and for processes that tests start: on small matrices,
# threads that wait for each other take most of the processors from the other tests.
os.environ["OMP_NUM_THREADS"] = "1"
# Before SymPy is imported: it would forget what one test has differentiated before the next one
# needs it.
os.environ["SYMPY_CACHE_SIZE"] = "None"
# What one run has compiled serves the next one, and not the user's own work.
os.environ["SAFE_ENVS_CACHE"] = str(Path(__file__).parents[1] / ".pytest_cache")

import gymnasium as gym
import hypothesis
import pytest

import safe_envs
from safe_envs.engine.program import Program
from safe_envs.problem.problem import SafetyProblem

# The expressions that SymPy keeps are many: to look through all of them for garbage as often as
# usual takes a tenth of the time.
gc.set_threshold(10_000, 20, 50)
# The same examples on every machine, and no deadline: a busy machine is no failure.
hypothesis.settings.register_profile(
    "project", derandomize=True, database=None, deadline=None, print_blob=False
)
hypothesis.settings.load_profile("project")


OWN_TARGETS = ("oracle", "cluster")
"""Marks of tests that `make` runs by targets of their own."""


def selection(marks: str) -> str:
    """Return what to select by -m: of the marks with targets of their own those that it names."""
    left_out = [f"not {mark}" for mark in OWN_TARGETS if not re.search(rf"\b{mark}\b", marks)]
    return " and ".join([f"({marks})"] * bool(marks) + left_out)


def pytest_configure(config: pytest.Config) -> None:
    """Leave out tests with targets of their own, whatever else -m selects.

    An -m in `addopts` would be replaced by that of the command line.
    """
    config.option.markexpr = selection(config.option.markexpr)


FOUR = tuple(
    f"safe_envs/{name}-v0"
    for name in ("Scalar", "StochasticDubins", "QuadrotorLimits", "DubinsReach")
)
"""Ids that stand for all: of degree 1; with noise and of degree 2; with several constraints and
inputs; with a goal and signals."""
EVERY_ENV = tuple(
    pytest.param(
        env_id, marks=[] if env_id in FOUR else pytest.mark.oracle, id=env_id.split("/")[1]
    )
    for env_id in safe_envs.ENV_IDS
)
"""Parameters of a test of every registered id: four in each run, the others in `make oracle`."""


@pytest.fixture(params=EVERY_ENV)
def env_id(request: pytest.FixtureRequest) -> str:
    """Every registered id in turn, in `make oracle`; else the `FOUR`."""
    return request.param


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run programs as plain Python, which need no compilation."""
    monkeypatch.setattr(Program, "compiled", Program.plain)


_PROBLEMS: dict[str, SafetyProblem] = {}


def problem_of(env_id: str, **arguments) -> SafetyProblem:
    """The problem behind a registered id, made with the arguments of `gym.make`; the same object
    for the same numbers and texts."""
    key = f"{env_id} {arguments!r}"
    if key not in _PROBLEMS:
        _PROBLEMS[key] = gym.make(env_id, **arguments).unwrapped.problem  # pyright: ignore[reportAttributeAccessIssue]
    return _PROBLEMS[key]
