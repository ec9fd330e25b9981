"""What lies between the input that is sent and the one that the plant executes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.errors import ConfigurationError, require_whole, shown
from safe_envs.problem.option_errors import LONGEST_DELAY
from safe_envs.validators import numbers_in

Limits = tuple[tuple[float, float], ...]
"""(low, high) of the rate of each input, in its unit per second."""


def require_delay(name: str, delay: Any) -> None:
    """Raise ConfigurationError unless a delay is a whole number of control periods.

    Args:
        name: of the argument.
        delay: that was given.
    """
    require_whole(name, delay, 0)
    if delay > LONGEST_DELAY:
        raise ConfigurationError(
            f"{name} = {delay}; it counts control periods, {LONGEST_DELAY} at most"
        )


def rate_limits(name: str, given: Any, count: int) -> Limits:
    """Return the bounds of the rate of each input.

    Args:
        name: of the argument, for errors.
        given: (low, high) for all inputs, or one such pair for each, in the input's unit per s.
        count: number of inputs.

    Raises:
        ConfigurationError: They are neither, or not low < 0 < high: then an input could not be
            held, and not be kept within its bounds.
    """
    pairs = numbers_in(given)
    pairs = np.broadcast_to(pairs, (count, 2)) if pairs.shape == (2,) else pairs
    found = tuple((float(low), float(high)) for low, high in pairs) if pairs.ndim == 2 else ()
    if pairs.shape != (count, 2) or not all(
        -1e100 <= low < 0.0 < high <= 1e100 for low, high in found
    ):
        raise ConfigurationError(
            f"{name} = {shown(given)}; give (low, high) with low < 0 < high in the input's unit per"
            f" second, or one such pair for each of the {count} inputs"
        )
    return found


def resting_input(box: Sequence[tuple[float, float]]) -> list[float]:
    """Return the input that is executed before any arrives: within its bounds, nearest to 0.

    Args:
        box: (low, high) of each input.
    """
    return [min(max(0.0, low), high) for low, high in box]


def why_not_direct(problem: Any, what: str) -> str:
    """Return why something that takes inputs to be executed when they are sent cannot be had.

    Args:
        problem: a `SafetyProblem`.
        what: what is asked for, a plural.

    Returns:
        "" for a problem without a delay or a slew limit, in the plant or as filters believe it.
    """
    if problem.direct:
        return ""
    return (
        f"{what} are not for a delay or a slew limit: {problem.name} has {problem.actuators}; they"
        " are about inputs that are executed as and when they are sent. Leave delay, model_delay"
        " and slew_limit out; rate_limit states limited rates as part of the system"
    )


def require_direct(problem: Any, what: str) -> None:
    """Raise ConfigurationError where there is a reason; see `why_not_direct`.

    Args:
        problem: see there.
        what: see there.
    """
    reason = why_not_direct(problem, what)
    if reason:
        raise ConfigurationError(reason)
