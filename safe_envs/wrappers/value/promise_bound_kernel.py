"""Bounds of the expected next value under inputs, as kernels with flat arrays.

The operations are those of `ExpectedBounds`, in the same order.
"""

from __future__ import annotations

from math import inf

import numpy as np

from safe_envs.wrappers.value.promise_cell_kernel import (
    promise_box,
    promise_shifts,
)
from safe_envs.wrappers.value.promise_layout import (
    AT_BOXES,
    AT_INPUTS,
    AT_IS_AFFINE,
    AT_SCENARIOS,
    AT_SEES_VALUES,
    AT_WEIGHTS,
    IN_ARRAYS,
    IN_TRIED,
)
from safe_envs.wrappers.value.promise_slots import promise_images

CAP_ROUNDS = 60


def promise_expected(
    k: int, layer: int, rest: float, table: np.ndarray, data: np.ndarray, work: np.ndarray
) -> float:
    """Bound the expected next value under the tried input from below, for the worst scenario.

    Args:
        k: the control instant.
        layer: place of the first entry of a table.
        rest: what noise beyond all boxes adds.
        table: values.
        data: numbers of the program.
        work: scratch array.

    Returns:
        The bound.
    """
    boxes, weights, worst = int(data[AT_BOXES]), int(data[AT_WEIGHTS]), inf
    if data[AT_IS_AFFINE] == 0.0:
        promise_images(k, data, work)
    for r in range(int(data[AT_SCENARIOS])):
        promise_shifts(r, data, work)
        total = rest
        for w in range(boxes):
            value = promise_box(layer, r * boxes + w, table, data, work)
            total += data[weights + w] * value
        worst = min(worst, total)
    return worst


def promise_sufficient(
    k: int, layer: int, level: float, table: np.ndarray, data: np.ndarray, work: np.ndarray
) -> tuple[float, float]:
    """Return the bound under the tried input, and the least c for which E min(c, L) is a level.

    Args:
        k: the control instant.
        layer: place of the first entry of a table.
        level: that is wanted.
        table: values.
        data: numbers of the program.
        work: scratch array.
    """
    if data[AT_SEES_VALUES] == 0.0:
        return promise_expected(k, layer, 0.0, table, data, work), inf
    boxes, weights = int(data[AT_BOXES]), int(data[AT_WEIGHTS])
    cap, worst = level, inf
    if data[AT_IS_AFFINE] == 0.0:
        promise_images(k, data, work)
    for r in range(int(data[AT_SCENARIOS])):
        promise_shifts(r, data, work)
        total = 0.0
        for w in range(boxes):
            value = promise_box(layer, r * boxes + w, table, data, work)
            work[IN_ARRAYS + w] = value
            total += data[weights + w] * value
        worst = min(worst, total)
        cap = promise_capped(level, cap, data, work) if total > level else inf
    return worst, cap


def promise_capped(level: float, cap: float, data: np.ndarray, work: np.ndarray) -> float:
    """Return the least number, no less than one that is too small, whose bound is the level.

    Args:
        level: that is wanted.
        cap: the number to begin with.
        data: numbers of the program.
        work: scratch array with the values of the boxes of noise.
    """
    boxes, weights = int(data[AT_BOXES]), int(data[AT_WEIGHTS])
    for _ in range(CAP_ROUNDS):
        bound, slope = 0.0, 0.0
        for w in range(boxes):
            value, weight = work[IN_ARRAYS + w], data[weights + w]
            if value > cap:
                bound += weight * cap
                slope += weight
            else:
                bound += weight * value
        if bound >= level:
            return cap
        if slope <= 0.0:
            return inf
        # A little more than the root, for rounding.
        cap += (level - bound) / slope * (1.0 + 1e-9) + 1e-16
    return inf


def promise_scan(
    k: int,
    layer: int,
    rest: float,
    inputs: int,
    count: int,
    table: np.ndarray,
    data: np.ndarray,
    work: np.ndarray,
) -> int:
    """Put the bounds under several inputs into the scratch array; return the place of the largest.

    Args:
        k: the control instant.
        layer: place of the first entry of a table.
        rest: what noise beyond all boxes adds.
        inputs: place of the inputs.
        count: their number.
        table: values.
        data: numbers of the program.
        work: scratch array.

    Returns:
        Which of them has the largest bound, the first one of several.
    """
    m, values, best = int(data[AT_INPUTS]), IN_ARRAYS + int(data[AT_BOXES]), 0
    for v in range(count):
        for j in range(m):
            work[IN_TRIED + j] = data[inputs + v * m + j]
        work[values + v] = promise_expected(k, layer, rest, table, data, work)
        if work[values + v] > work[values + best]:
            best = v
    return best
