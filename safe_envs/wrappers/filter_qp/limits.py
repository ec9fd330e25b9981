"""Input bounds, weights and the control period, as users give them to make a filter."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.errors import ConfigurationError, shown
from safe_envs.number_text import finite_number
from safe_envs.problem.clf import CLF
from safe_envs.validators import numbers_in
from safe_envs.wrappers.conditions import AffineConstraint

WIDEST = 1e100
"""Largest bound of an input: its square, an effort, is still a number. It stands for infinite
ones."""


def read_bounds(
    inputs: Sequence[sp.Symbol], given: Any, endless: bool
) -> tuple[list[float], list[float]]:
    """Return the lower and the upper bounds of m inputs.

    Args:
        inputs: m symbols.
        given: (low, high) for all inputs, or one such pair for each.
        endless: whether ends may be infinite, for which `WIDEST` stands.

    Raises:
        ConfigurationError: They are neither, or no intervals.
    """
    pairs = np.empty(0) if given is None else numbers_in(given)
    if pairs.shape == (2,):
        pairs = np.broadcast_to(pairs, (len(inputs), 2))
    if pairs.shape != (len(inputs), 2):
        raise ConfigurationError(
            f"bounds = {shown(given)}; give (low, high) of the input in physical units, for all"
            f" inputs or for each of the {len(inputs)}"
            f"{'; an end may be infinite' if endless else ''}"
        )
    table: Any = pairs.tolist()
    for symbol, (low, high) in zip(inputs, table, strict=True):
        if not low < high:
            raise ConfigurationError(
                f"bounds of {symbol} are [{low}, {high}]; the lower one has to be below the upper"
            )
        require_ends(symbol, low, high, endless)
    low, high = np.clip(pairs, -WIDEST, WIDEST).T
    return low.tolist(), high.tolist()


def require_ends(symbol: sp.Symbol, low: float, high: float, endless: bool) -> None:
    """Raise ConfigurationError where an input's bound is infinite and may not be, or too wide.

    Args:
        symbol: of the input.
        low: its lower bound, a number.
        high: its upper bound, a number.
        endless: whether ends may be infinite.
    """
    if not endless and (math.isinf(low) or math.isinf(high)):
        raise ConfigurationError(
            f"bounds of {symbol} are [{low}, {high}]; a filter with a goal, a reciprocal condition,"
            " a certificate or an uncertain constraint needs finite ones, for it may go to their"
            " ends"
        )
    if low == math.inf or high == -math.inf or any(WIDEST < abs(b) < math.inf for b in (low, high)):
        raise ConfigurationError(
            f"bounds of {symbol} are [{low}, {high}]; finite ones are within {WIDEST:g}, and"
            " -math.inf and math.inf stand for none"
        )


def positive_weights(name: str, given: Any, count: int) -> list[float]:
    """Return weights as floats.

    Args:
        name: of the argument, for errors.
        given: as users give them; None for ones.
        count: how many there are to be.

    Raises:
        ConfigurationError: Their number is wrong, or one is not positive and finite.
    """
    values = np.ones(count) if given is None else numbers_in(given)
    if values.shape != (count,) or not (np.isfinite(values) & (values > 0.0)).all():
        raise ConfigurationError(f"{name} = {shown(given)}; give {count} positive numbers")
    return values.tolist()


def control_period(constraints: Sequence[AffineConstraint], dt: Any) -> float:
    """Return the control period in s, 0 where none is given.

    Args:
        constraints: those of the filter, some of which may need it.
        dt: as users give it.

    Raises:
        ConfigurationError: It is not positive and finite, or missing.
    """
    if dt is None:
        if any(constraint.change is not None for constraint in constraints):
            raise ConfigurationError(
                "a sampling margin of first order needs the control period: SafetyFilter(...,"
                " dt=...)"
            )
        return 0.0
    period = finite_number("dt", dt)
    if period <= 0.0:
        raise ConfigurationError(f"dt = {dt} s; a control period is positive and finite")
    return period


def takes_endless(constraints: Iterable[AffineConstraint], clf: CLF | None) -> bool:
    """Return whether a QP has a bounded answer without input bounds.

    That is so where the answer is the input nearest to the proposed one. A goal, and reciprocal
    conditions outside their domain, go as far as the bounds let them; and a plane above an
    uncertainty needs their corners.

    Args:
        constraints: of the QP.
        clf: its goal, if there is one.
    """
    return clf is None and all(c.demand is None and c.uncertainty is None for c in constraints)
