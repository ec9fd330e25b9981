"""The signals of a problem: states, inputs and features with their ranges, and time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.arrays import numbers_in
from safe_envs.dynamics import symbols
from safe_envs.problem.option_errors import refused_bounds

TIME = symbols.TIME
"""Time since the start of the episode, in s: references and rewards may depend on it. No state or
input, which may have any sign, is the same symbol, even if its name is t."""


@dataclass(frozen=True)
class Variable:
    """A state or an input with its range.

    For a state the range is the workspace: an episode ends when the state leaves it (an infinite
    range never ends one). For an input it holds the admissible actions, and is finite. The unit is
    a label.
    """

    symbol: sp.Symbol
    low: float
    high: float
    unit: str = ""


@dataclass(frozen=True)
class Feature:
    """An entry of the observation: an expression of states and `TIME`, with finite bounds."""

    name: str
    expression: sp.Expr
    low: float
    high: float

    @property
    def symbol(self) -> sp.Symbol:
        """The symbol by which a nominal controller refers to it."""
        return sp.Symbol(self.name, real=True)


@lru_cache(maxsize=256)
def excess(variables: tuple[Variable, ...]) -> sp.Expr:
    """Return by how much the furthest variable is outside its range; -1 without a bound.

    Remembered, since SymPy compares every pair of arguments of a maximum.
    """
    symmetric: dict[float, list[sp.Expr]] = {}
    found: list[sp.Expr] = []
    for v in variables:
        if v.low == -v.high and math.isfinite(v.high):
            symmetric.setdefault(v.high, []).append(sp.Abs(v.symbol))
        else:
            found += [v.symbol - v.high] * math.isfinite(v.high)
            found += [v.low - v.symbol] * math.isfinite(v.low)
    found += [sp.Max(*sizes) - half for half, sizes in symmetric.items()]
    return sp.Max(*found) if found else sp.Integer(-1)


def bound_pairs(input_bounds: Any, count: int) -> list[tuple[float, float]]:
    """Return the bounds of each input.

    Args:
        input_bounds: (low, high) for all inputs, or one such pair for each.
        count: number of inputs.

    Raises:
        ConfigurationError: They are neither.
    """
    pairs = numbers_in(input_bounds)
    pairs = np.broadcast_to(pairs, (count, 2)) if pairs.shape == (2,) else pairs
    if pairs.shape != (count, 2):
        raise refused_bounds(input_bounds, count)
    return [(float(low), float(high)) for low, high in pairs]
