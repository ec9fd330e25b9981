"""Errors of the options of a problem, which need no problem but what it is called.

A command looks for them before anything is imported that builds the problem.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

from safe_envs.errors import ConfigurationError, nearest, shown

LONGEST_DELAY = 1000
"""Control periods: all inputs under way are kept, and predicted with at every decision."""

_WIDEST = 1e100
"""Largest bound of an input: its square, an effort, is still a number."""


def require_bounds(name: str, low: float, high: float) -> None:
    """Raise ConfigurationError unless two numbers can be the bounds of an input.

    Args:
        name: of the input.
        low: its lower bound.
        high: its upper bound.
    """
    if not -_WIDEST <= low < high <= _WIDEST:
        raise ConfigurationError(
            f"input_bounds of {name} are [{low}, {high}]; give bounds within {_WIDEST:g}, the lower"
            " one below the upper. Unbounded control has wide bounds"
        )


def require_period(dt: float) -> None:
    """Raise ConfigurationError unless a number can be a control period, in s."""
    if not (dt > 0 and math.isfinite(dt)):
        raise ConfigurationError(f"dt = {dt} s; a control period is positive and finite")


def refused_noise(noise: Any, names: Sequence[str]) -> ConfigurationError:
    """Return the error of levels of noise that are negative, not finite, or of a wrong number.

    Args:
        noise: what was given.
        names: of the channels.
    """
    if len(names) == 1:
        allowed = f"give one number from 0, for {names[0]}"
    else:
        allowed = (
            f"give one number from 0 for all channels, or {len(names)} of them for"
            f" {', '.join(names)}"
        )
    return ConfigurationError(f"noise = {shown(noise)}; {allowed}")


def unknown_start(start: str, starts: Iterable[str], count: int) -> ConfigurationError:
    """Return the error of the name of an initial distribution that there is not.

    Args:
        start: what was given.
        starts: names of the distributions.
        count: of states.
    """
    state = "or a number" if count == 1 else f"or {count} numbers"
    return ConfigurationError(f"unknown start {shown(start)}; {nearest(start, starts, state)}")


def wrong_start(count: int, states: Sequence[str]) -> ConfigurationError:
    """Return the error of an initial state of a wrong number of entries.

    Args:
        count: of what was given.
        states: names of the states.
    """
    return ConfigurationError(
        f"start has {count} numbers; the state has {len(states)}: {', '.join(states)}"
    )


def refused_bounds(input_bounds: Any, count: int) -> ConfigurationError:
    """Return the error of input bounds that are no pair, and not one for each input.

    Args:
        input_bounds: what was given.
        count: of inputs.
    """
    pairs = "" if count == 1 else f", or one such pair for each of the {count} inputs"
    return ConfigurationError(f"input_bounds = {shown(input_bounds)}; give (low, high){pairs}")
