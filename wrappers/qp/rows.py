"""What the solvers share: rows of a batch as one array, and when a number differs from zero by rounding only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

ROUNDING = 16.0 * float(np.finfo(float).eps)
"""Relative error that a sum of three products may have, with room for coefficients that were rounded themselves."""


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
