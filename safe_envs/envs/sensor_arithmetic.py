"""Arithmetic of samples: values within a period, the quantile of losses, values that are none."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import NormalDist

import numpy as np

from safe_envs.problem.measurement import Channel


def wrapped(channel: Channel, value: float) -> float:
    """Return a value in (-period/2, period/2], if its channel has a period.

    Args:
        channel: of a sensor.
        value: that it measures.
    """
    period = channel.period
    if not period or not math.isfinite(value):
        return value
    return value - period * math.ceil(value / period - 0.5)


def wrapped_batch(channel: Channel, values: np.ndarray) -> np.ndarray:
    """Return the values (num_envs,) of a batch as `wrapped` does.

    Args:
        channel: of a sensor.
        values: that it measures.
    """
    period = channel.period
    return values - period * np.ceil(values / period - 0.5) if period else values


def loss_quantile(channel: Channel) -> float:
    """Return the number below which a standard normal one is with the probability of a loss."""
    return NormalDist().inv_cdf(channel.dropout) if channel.dropout else -math.inf


def value_or_nan(measure: Callable[..., Sequence[float]], x: Sequence[float]) -> float:
    """Return what is measured of a state, NaN where it has no value.

    Args:
        measure: one number of the components of a state.
        x: those components.
    """
    try:
        return measure(*x)[0]
    except (ArithmeticError, ValueError):
        return math.nan
