"""What every method needs: checks before it learns, random streams, a report of its progress."""

from __future__ import annotations

import reprlib
from collections.abc import Callable
from enum import IntEnum
from typing import Any

import numpy as np

from safe_envs.dynamics.lie import relative_degree
from safe_envs.errors import ConfigurationError, require_whole, shown
from safe_envs.problem.problem import SafetyProblem

Progress = Callable[[float], None]
"""Called with the part of the work that is done, from 0 to 1."""

_MOST_BYTES = 2e9
_BYTES = 8


class Purpose(IntEnum):
    """Second entries of the seeds of everything random in learning: no two uses share a stream.

    None is 0: NumPy takes [s, 0] for s, whose children are those of safe sets and episodes. The
    small numbers belong to safe-set analyses, bounds and the states at which an identification is
    reported.
    """

    DATA = 1001
    PATHS = 1002
    STATES = 1003
    TRAINING = 1004
    HELD_OUT = 1005
    SENSOR = 1006


def random_stream(seed: int, purpose: Purpose) -> np.random.Generator:
    """Return the random stream of a seed for a purpose.

    Args:
        seed: from 0.
        purpose: of the stream.

    Raises:
        ConfigurationError: the seed is no whole number from 0.
    """
    require_whole("seed", seed, 0)
    return np.random.default_rng([int(seed), int(purpose)])


def require_room(numbers: float, what: str, remedy: str) -> None:
    """Raise ConfigurationError where numbers would take more than 2 GB of memory.

    Args:
        numbers: how many.
        what: they are.
        remedy: what to lower.
    """
    size = _BYTES * numbers
    if size > _MOST_BYTES:
        raise ConfigurationError(
            f"{what} take {size / 1e9:.3g} GB; at most {_MOST_BYTES / 1e9:g} GB are allowed: lower"
            f" {remedy}"
        )


def require_kind(name: str, value: Any, kind: type, source: str) -> None:
    """Raise ConfigurationError unless a value is of a kind.

    Args:
        name: of the argument.
        value: that was given.
        kind: that it has to be of.
        source: where such an object comes from.
    """
    if not isinstance(value, kind):
        raise ConfigurationError(
            f"{name} = {reprlib.repr(value)}, a {type(value).__name__}; give a {kind.__name__}, as"
            f" {source} makes it"
        )


def require_degrees(problem: SafetyProblem, given: Any) -> None:
    """Raise ValueError unless these are the relative degrees of a problem's barriers.

    Args:
        problem: whose barriers are taken.
        given: degrees that a file tells.
    """
    wanted = [relative_degree(problem.model, b.expression) for b in problem.barriers]
    if given != wanted:
        raise ValueError(f"the degrees {shown(given)}, where the barriers have {wanted}")


def require_problem(problem: Any) -> None:
    """Raise ConfigurationError where an env or its id was given for a problem."""
    require_kind("problem", problem, SafetyProblem, "make_problem of safe_envs.registry")
