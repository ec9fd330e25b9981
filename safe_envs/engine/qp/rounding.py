"""The one tolerance with which a constraint counts as met, and arrays that the solvers share.

A constraint a . u + b >= 0 is met by an input u if

    a . u + b >= -ROUNDING (|b| + sum_j |a_j u_j|)

A sum of n floating-point products differs from the exact one by at most n eps times the sum of
their sizes; ROUNDING leaves room for the coefficients, which were rounded themselves. The sizes are
those of the terms at u, so that neither the unit of a constraint nor that of an input matters.

Every solver, for one state and for a batch, says `feasible` where the action that it returns meets
all constraints in this sense.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from functools import reduce
from operator import add, mul
from typing import Any

import numpy as np

ROUNDING = 16.0 * sys.float_info.epsilon
"""Relative error of a constraint's value."""

Floats = Sequence[float]
"""Numbers of one state, one for each input or constraint."""

Entries = Sequence[Any]
"""Numbers of a batch of B states, each a float or an array (B,)."""

Arrays = Sequence[np.ndarray]

FloatAnswer = tuple[list[float], list[float], list[bool], bool]
ArrayAnswer = tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray], np.ndarray]
"""Inputs (m), margins and binding constraints (k), and whether all constraints can be met."""


def added(terms: Iterable[Any]) -> Any:
    """Return the sum of floats or arrays, added in order.

    From Python 3.12 on `sum` corrects the rounding of floats, which NumPy and compiled code do not:
    a state by itself would have another result than in a batch.

    Args:
        terms: the floats or arrays.
    """
    return reduce(add, terms, 0.0)


def tolerance(a: Floats, b: float, u: Floats) -> float:
    """Return by how much a constraint may be violated at m inputs and count as met.

    Args:
        a: m coefficients.
        b: offset.
        u: m inputs.
    """
    # Each term is scaled by itself, so that their sum does not overflow.
    return ROUNDING * abs(b) + added([ROUNDING * abs(aj * uj) for aj, uj in zip(a, u, strict=True)])


def tolerances(a: Entries | np.ndarray, b: Any, u: Entries | np.ndarray) -> Any:
    """Return the tolerances of a batch; see `tolerance`. Coefficients and inputs are in front."""
    found = ROUNDING * np.abs(b)
    for aj, uj in zip(a, u, strict=True):
        found = found + ROUNDING * np.abs(aj * uj)
    return found


def stack(entries: Entries, size: int) -> np.ndarray:
    """Return floats and arrays (B,) as the rows of an array (len(entries), B).

    Args:
        entries: the floats and arrays.
        size: B.
    """
    table = np.empty((len(entries), size))
    for row, entry in zip(table, entries, strict=True):
        row[:] = entry
    return table


def total(parts: np.ndarray) -> np.ndarray:
    """Return the sum over the first axis, in an order that does not depend on the batch."""
    result = parts[0].copy()
    for part in parts[1:]:
        result += part
    return result


def margins(a: Sequence[Floats], b: Floats, u: Floats) -> tuple[list[float], list[float]]:
    """Return the margins (k) at inputs, and their rounding.

    Args:
        a: k constraints of m coefficients.
        b: k offsets.
        u: m inputs.
    """
    margin, allowed = [], []
    for row, offset in zip(a, b, strict=True):
        terms = [*map(mul, row, u), offset]
        margin.append(sum(terms))
        allowed.append(ROUNDING * sum(map(abs, terms)))
    return margin, allowed


class PlainQP:
    """A QP of one state.

    Attributes:
        start: the clipped proposal.
        margin: of the constraints there.
    """

    def __init__(
        self,
        a: Sequence[Floats],
        b: Floats,
        v: Floats,
        low: Floats,
        high: Floats,
        w: Floats,
        priority: Floats,
    ) -> None:
        """Take a QP; see `dispatch.project_floats`."""
        self.a, self.b, self.v, self.low, self.high = a, b, v, low, high
        self.w, self.priority = w, priority
        self.start = [
            lo if vj < lo else hi if vj > hi else vj
            for vj, lo, hi in zip(v, low, high, strict=True)
        ]
        self.margin = [
            sum(map(mul, row, self.start)) + offset for row, offset in zip(a, b, strict=True)
        ]

    def meets_each(self, rows: list[int]) -> bool:
        """Return whether the input bounds allow to meet each of some constraints by itself.

        Args:
            rows: the constraints.
        """
        for i in rows:
            most = self.b[i]
            for aj, lo, hi in zip(self.a[i], self.low, self.high, strict=True):
                most += aj * (hi if aj > 0.0 else lo)
            if not most >= 0.0:
                return False
        return True
