"""What a user gives to a log next to a decision: the state, bounds, and values at run time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.errors import InvalidInputError
from safe_envs.wrappers.filter_qp.limits import WIDEST

Defaults = Sequence[tuple[sp.Symbol, str, float | None]]
"""Each symbol of run time, its name, and its value where none is given."""


def runtime_values(known: Defaults, parameters: Mapping[Any, float]) -> list[float]:
    """Return what was given at run time, in order.

    Args:
        known: to the filter.
        parameters: as given to the filter.

    Raises:
        InvalidInputError: A value is missing, given twice, or of a name that is unknown.
    """
    found, used = [], 0
    for symbol, name, default in known:
        value = parameters.get(name)
        if value is None:
            value = parameters.get(symbol)
        if value is not None:
            used += 1
        elif default is not None:
            value = default
        else:
            raise InvalidInputError(f"parameters lacks {symbol}; give what the filter was given")
        found.append(value)
    if used < len(parameters):
        raise InvalidInputError(
            f"parameters has {', '.join(map(str, parameters))}; the log takes each of"
            f" {', '.join([name for _, name, _ in known]) or 'none'} once"
        )
    return found


def require_finite(headings: Sequence[str], values: Sequence[float]) -> None:
    """Raise InvalidInputError unless the time, the state and the parameters are finite.

    Args:
        headings: of the first columns of a log, and of others.
        values: of the first columns.
    """
    for heading, value in zip(headings, values, strict=False):
        if not math.isfinite(value):
            raise InvalidInputError(
                f"{heading} is {value}, of which a filter decides nothing; give what it decided"
                " about"
            )


def pairs_of(bounds: Any, m: int) -> tuple[Sequence[float], Sequence[float]]:
    """Return lower and upper bounds.

    Args:
        bounds: one pair, or one for each input.
        m: number of inputs.
    """
    pairs = np.broadcast_to(np.asarray(bounds, dtype=float), (m, 2))
    return pairs[:, 0].tolist(), pairs[:, 1].tolist()


def endless(bounds: Sequence[float]) -> list[float]:
    """Return bounds with infinities where a filter has `WIDEST`.

    Args:
        bounds: of a filter.
    """
    return [math.copysign(math.inf, b) if abs(b) == WIDEST else b for b in bounds]
