"""The least value of the cells to which a box of noise leads, as kernels with flat arrays.

The operations are those of `expected_value_kernel`, in the same order.
"""

from __future__ import annotations

from math import floor, inf

import numpy as np

from safe_envs.wrappers.value.promise_layout import (
    AT_BOXES,
    AT_COORDINATES,
    AT_INPUTS,
    AT_MEANS,
    AT_SCANNED,
    AT_SCENARIOS,
    IN_ARRAYS,
    IN_SHIFTS,
    IN_SPANS,
    IN_TRIED,
)


def promise_cell(value: float, axis: int, data: np.ndarray) -> int:
    """Return the cell of a value along an axis; -1 below the grid, and their number above it.

    Args:
        value: of the coordinate.
        axis: place of the axis.
        data: numbers of the program.
    """
    scaled = (value - data[axis + 4]) * data[axis + 5]
    if not scaled >= 0.0:
        return -1
    last = int(data[axis + 3]) - 1
    guess = last
    if scaled < last:
        guess = int(scaled)
    cell = int(data[int(data[axis + 2]) + guess])
    count, first = int(data[axis]), int(data[axis + 1])
    while cell < count and data[first + cell + 1] <= value:
        cell += 1
    return cell


def promise_span(
    i: int, low: float, high: float, axis: int, data: np.ndarray, work: np.ndarray
) -> None:
    """Put the first and the last cell that an interval touches into the scratch array.

    Where the interval leaves the grid, the first one f is put as -1 - f, and where it misses the
    grid the last one as -1. Along a periodic axis the last may pass the end: cells begin again.

    Args:
        i: number of the axis.
        low: lower end of the interval.
        high: upper end.
        axis: place of the axis.
        data: numbers of the program.
        work: scratch array.
    """
    last, start, period = int(data[axis]) - 1, data[axis + 4], data[axis + 6]
    first, end = 0, last
    if period == 0.0:
        first, end = promise_cell(low, axis, data), promise_cell(high, axis, data)
        if first < 0 or end > last:
            if end < 0 or first > last:
                first, end = -1, -1
            else:
                first, end = -1 - max(first, 0), min(end, last)
    elif high - low < period:
        turns = period * floor((low - start) / period)
        low, high = low - turns, high - turns
        first = min(max(promise_cell(low, axis, data), 0), last)
        if high < start + period:
            end = min(promise_cell(high, axis, data), last)
        else:
            end = max(promise_cell(high - period, axis, data), 0) + last + 1
    work[IN_SPANS + 2 * i], work[IN_SPANS + 2 * i + 1] = float(first), float(end)


def promise_least(layer: int, table: np.ndarray, data: np.ndarray, work: np.ndarray) -> float:
    """Return the least value of the cells of the spans; 0 where they leave the grid.

    Args:
        layer: place of the first entry of a table.
        table: values.
        data: numbers of the program.
        work: scratch array with the spans.
    """
    n, axes = int(data[AT_COORDINATES]), int(data[AT_MEANS])
    n1 = int(data[axes + 8]) if n > 1 else 1
    n2 = int(data[axes + 16]) if n > 2 else 1
    n3 = int(data[axes + 24]) if n > 3 else 1
    n0 = int(data[axes])
    f0, l0, f1, l1 = int(work[0]), int(work[1]), int(work[2]), int(work[3])
    f2, l2, f3, l3 = int(work[4]), int(work[5]), int(work[6]), int(work[7])
    least = inf
    if min(min(f0, f1), min(f2, f3)) < 0:
        least = 0.0
        f0, f1 = (f0 if f0 >= 0 else -1 - f0), (f1 if f1 >= 0 else -1 - f1)
        f2, f3 = (f2 if f2 >= 0 else -1 - f2), (f3 if f3 >= 0 else -1 - f3)
    for i0 in range(f0, l0 + 1):
        c0 = (i0 - n0 if i0 >= n0 else i0) * n1
        for i1 in range(f1, l1 + 1):
            c1 = (c0 + (i1 - n1 if i1 >= n1 else i1)) * n2
            for i2 in range(f2, l2 + 1):
                c2 = (c1 + (i2 - n2 if i2 >= n2 else i2)) * n3
                for i3 in range(f3, l3 + 1):
                    value = float(table[layer + c2 + (i3 - n3 if i3 >= n3 else i3)])
                    if value < least:
                        least = value
    return least


def promise_shifts(r: int, data: np.ndarray, work: np.ndarray) -> None:
    """Put into the scratch array how far the tried input moves the ends of the images.

    Args:
        r: the scenario.
        data: numbers of the program.
        work: scratch array.
    """
    n, m = int(data[AT_COORDINATES]), int(data[AT_INPUTS])
    boxes, scenarios = int(data[AT_BOXES]), int(data[AT_SCENARIOS])
    effects = IN_ARRAYS + boxes + int(data[AT_SCANNED]) + scenarios * boxes * n * 2
    for i in range(n):
        slack = data[int(data[AT_MEANS]) + 8 * i + 7]
        low, high = -slack, slack
        for j in range(m):
            effect = effects + ((r * n + i) * m + j) * 2
            p, s = work[effect] * work[IN_TRIED + j], work[effect + 1] * work[IN_TRIED + j]
            low += min(p, s)
            high += max(p, s)
        work[IN_SHIFTS + 2 * i], work[IN_SHIFTS + 2 * i + 1] = low, high


def promise_box(
    layer: int, box: int, table: np.ndarray, data: np.ndarray, work: np.ndarray
) -> float:
    """Return the least value of the cells that an image touches.

    Args:
        layer: place of the first entry of a table.
        box: number of the image.
        table: values.
        data: numbers of the program.
        work: scratch array.
    """
    n, axes = int(data[AT_COORDINATES]), int(data[AT_MEANS])
    image = IN_ARRAYS + int(data[AT_BOXES]) + int(data[AT_SCANNED]) + box * n * 2
    for i in range(n):
        low = work[image + 2 * i] + work[IN_SHIFTS + 2 * i]
        high = work[image + 2 * i + 1] + work[IN_SHIFTS + 2 * i + 1]
        promise_span(i, low, high, axes + 8 * i, data, work)
    for i in range(n, 4):
        work[IN_SPANS + 2 * i], work[IN_SPANS + 2 * i + 1] = 0.0, 0.0
    return promise_least(layer, table, data, work)
