"""Working sets that DAQP, a dual active-set solver in C, proposes for one state.

Its tolerances are absolute, so that the inputs are measured from the clipped proposal, in ways to
the furthest constraint, and constraints have unit length.
"""

from __future__ import annotations

import functools
from array import array
from collections.abc import Iterator
from operator import mul, sub
from typing import Any

import daqp
import numpy as np

from safe_envs.wrappers.qp.working_set import FloatQP, WorkingSet

_INFINITY = 1e30
_SETTINGS = {"primal_tol": 1e-11, "dual_tol": 1e-12, "iter_limit": 500}
_SOFT = 1e-4
"""Root of the weight of the inputs against that of the constraint that weighs least."""
_FIRM = 1e-7
"""That against the constraint that weighs most: where it is less, rounding hides the slacks."""


def propose(qp: FloatQP) -> Iterator[WorkingSet]:
    """Yield working sets, the likeliest first.

    Args:
        qp: a QP whose constraints the clipped proposal misses.
    """
    k, m = len(qp.b), len(qp.v)
    gaps = [-value / length for value, length in zip(qp.margin, qp.lengths, strict=True)]
    unit = max(gaps)
    start, scales = qp.start, [root / unit for root in qp.roots]
    least = [*map(mul, map(sub, qp.low, start), scales)]
    lower = array("d", least + [gap / unit for gap in gaps])
    upper = array("d", [*map(mul, map(sub, qp.high, start), scales)] + [_INFINITY] * k)
    target = [*map(mul, map(sub, start, qp.v), scales)]
    sizes, nothing = qp.sizes, [0.0] * k
    smallest, largest = min(sizes), max(sizes)
    # Where constraints weigh very differently, soft ones give way though they could be met.
    soft = max(_SOFT * smallest, _FIRM * largest)
    for width in (k, 0) if soft < 100.0 * _SOFT * smallest else (0, k):
        if width:
            numbers = []
            for i, normal in enumerate(qp.normals):
                numbers += normal
                numbers += nothing
                numbers[i - k] = soft / sizes[i]
        else:
            numbers = [c for normal in qp.normals for c in normal]
        pressures = _pressures(m + width, k, target + nothing[:width], numbers, upper, lower)
        if pressures:
            yield WorkingSet(
                [i for i in range(k) if pressures[m + i] < 0.0],
                [-1 if q < 0.0 else 1 if q > 0.0 else 0 for q in pressures[:m]],
            )


def _pressures(
    n: int, k: int, target: list[float], numbers: list[float], upper: Any, lower: Any
) -> list[float]:
    """Return the pressures of bounds and constraints, with signs; none where there is no answer."""
    rows: Any = memoryview(array("d", numbers)).cast("B").cast("d", (k, n))
    identity, sense = _constants(n, len(upper))
    _, _, flag, info = daqp.solve(
        identity, array("d", target), rows, upper, lower, sense, **_SETTINGS
    )
    return info["lam"].tolist() if flag > 0 else []


@functools.cache
def _constants(n: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.eye(n), np.zeros(count, dtype=np.intc)
