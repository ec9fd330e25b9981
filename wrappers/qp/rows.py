"""What the solvers share: rows of a batch as one array, and the one tolerance with which a row counts as met.

A row a . u + b >= 0 is met by an input u if

    a . u + b >= -ROUNDING (|b| + sum_j |a_j u_j|)

A sum of n floating-point products differs from the exact one by at most n eps times the sum of their sizes; ROUNDING leaves
room for the coefficients, which were rounded themselves. The sizes are those of the terms at u, so that neither the unit of a
row nor that of an input matters. Where a term is denormal its rounding is absolute: the smallest normal number stands for it.

Every solver, for one state and for a batch, says `feasible` where the action that it returns meets all rows in this sense.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

ROUNDING = 16.0 * sys.float_info.epsilon
"""Relative error of a row's value."""

_SMALLEST = sys.float_info.min
"""The smallest normal number: below it, rounding is absolute."""


def tolerance(a: Sequence[Any], b: Any, u: Sequence[Any]) -> Any:
    """Return by how much a row may miss at an input and be met all the same.

    Args:
        a: m coefficients, each a float or an array (B,).
        b: the offset, likewise.
        u: m inputs, likewise.
    """
    size = abs(b) * ROUNDING + _SMALLEST * ROUNDING
    for aj, uj in zip(a, u, strict=True):
        size = size + abs(aj) * ROUNDING * (abs(uj) + _SMALLEST)  # scaled first, so that no product overflows
    return size


def stack(entries: Sequence[Any], size: int) -> np.ndarray:
    """Floats and arrays (B,) as the rows of an array (len(entries), B)."""
    table = np.empty((len(entries), size))
    for row, entry in zip(table, entries, strict=True):
        row[:] = entry
    return table


def total(parts: np.ndarray) -> np.ndarray:
    """Sum over the first axis, in an order that does not depend on the size of the batch, as NumPy's own does."""
    result = parts[0].copy()
    for part in parts[1:]:
        result += part
    return result
