"""The expected value of a state under an input, bounded from below; see `bellman_kernel`."""

from __future__ import annotations

from math import floor, inf

import numpy as np

AXES = 4
"""Axes of the tables in kernels; those that a problem does not have are of one cell."""


def expected_value(  # noqa: PLR0913
    a: int,
    v: int,
    b: int,
    u: int,
    images: np.ndarray,
    effects: np.ndarray,
    inputs: np.ndarray,
    weights: np.ndarray,
    layer: int,
    tables: np.ndarray,
    rest: float,
    counts: np.ndarray,
    places: np.ndarray,
    edges: np.ndarray,
    scales: np.ndarray,
    shifts: np.ndarray,
) -> float:
    """Bound the expected value of a state under an input from below, for the worst scenario.

    Args:
        a: the state.
        v: place of the input in `images`.
        b: place of the state in `inputs`.
        u: place of the input in `inputs`.
        images: see `expected_values`, as for all others.
        effects: see there.
        inputs: see there.
        weights: see there.
        layer: which of the tables to take.
        tables: see there.
        rest: see there.
        counts: of the grid.
        places: of the grid.
        edges: of the grid.
        scales: of the grid.
        shifts: scratch array.
    """
    n = effects.shape[2]
    worst = inf
    for r in range(images.shape[2]):
        move_by_inputs(a, r, b, u, effects, inputs, scales, shifts)
        total = rest
        for w in range(images.shape[3]):
            value = box_value(
                images[a, v, r, w], n, shifts, layer, tables, counts, places, edges, scales
            )
            total += weights[w] * value
        worst = min(worst, total)
    return worst


def move_by_inputs(
    a: int,
    r: int,
    b: int,
    u: int,
    effects: np.ndarray,
    inputs: np.ndarray,
    scales: np.ndarray,
    shifts: np.ndarray,
) -> None:
    """Put into `shifts` how far an input moves the ends of the images, with room for rounding.

    Args:
        a: the state.
        r: the scenario.
        b: place of the state in `inputs`.
        u: place of the input in `inputs`.
        effects: see `expected_values`, as for all others.
        inputs: see there.
        scales: of the grid.
        shifts: receives the lower and the upper shift of each coordinate.
    """
    n, m = effects.shape[2], effects.shape[3]
    for i in range(n):
        low, high = -scales[i, 3], scales[i, 3]
        for j in range(m):
            b0, b1 = effects[a, r, i, j, 0], effects[a, r, i, j, 1]
            u0, u1 = inputs[b, u, j, 0], inputs[b, u, j, 1]
            p, q, s, t = b0 * u0, b0 * u1, b1 * u0, b1 * u1
            low += min(min(p, q), min(s, t))
            high += max(max(p, q), max(s, t))
        shifts[2 * i], shifts[2 * i + 1] = low, high


def box_value(  # noqa: PLR0913
    image: np.ndarray,
    n: int,
    shifts: np.ndarray,
    layer: int,
    tables: np.ndarray,
    counts: np.ndarray,
    places: np.ndarray,
    edges: np.ndarray,
    scales: np.ndarray,
) -> float:
    """Return the least value of the cells that an image touches.

    Args:
        image: ends of each coordinate, shape (n, 2).
        n: number of coordinates.
        shifts: of the ends; see `move_by_inputs`.
        layer: which of the tables to take.
        tables: see `expected_values`.
        counts: of the grid.
        places: of the grid.
        edges: of the grid.
        scales: of the grid.
    """
    f1, l1, f2, l2, f3, l3 = 0, 0, 0, 0, 0, 0
    f0, l0 = cells_between(
        image[0, 0] + shifts[0], image[0, 1] + shifts[1], 0, counts, places, edges, scales
    )
    if n > 1:
        f1, l1 = cells_between(
            image[1, 0] + shifts[2],
            image[1, 1] + shifts[3],
            1,
            counts,
            places,
            edges,
            scales,
        )
    if n > 2:
        f2, l2 = cells_between(
            image[2, 0] + shifts[4],
            image[2, 1] + shifts[5],
            2,
            counts,
            places,
            edges,
            scales,
        )
    if n > 3:
        f3, l3 = cells_between(
            image[3, 0] + shifts[6],
            image[3, 1] + shifts[7],
            3,
            counts,
            places,
            edges,
            scales,
        )
    return least_value(f0, l0, f1, l1, f2, l2, f3, l3, layer, tables, counts)


def cells_between(
    low: float,
    high: float,
    i: int,
    counts: np.ndarray,
    places: np.ndarray,
    edges: np.ndarray,
    scales: np.ndarray,
) -> tuple[int, int]:
    """Return the first and the last cell that an interval touches along an axis.

    Where the interval leaves the grid, the first one f is returned as -1 - f, and where it misses
    the grid the last one is -1. Along a periodic axis the last may pass the end: the cells begin
    again.

    Args:
        low: lower end of the interval.
        high: upper end.
        i: the axis.
        counts: of the grid.
        places: of the grid.
        edges: of the grid.
        scales: of the grid.
    """
    period, last = scales[i, 2], counts[i] - 1
    if period == 0.0:
        first = cell_of_value(low, i, counts, places, edges, scales)
        end = cell_of_value(high, i, counts, places, edges, scales)
        if first >= 0 and end <= last:
            return first, end
        if end < 0 or first > last:
            return -1, -1
        return -1 - max(first, 0), min(end, last)
    if high - low >= period:
        return 0, last
    turns = period * floor((low - scales[i, 0]) / period)
    low, high = low - turns, high - turns
    first = min(max(cell_of_value(low, i, counts, places, edges, scales), 0), last)
    if high < scales[i, 0] + period:
        return first, min(cell_of_value(high, i, counts, places, edges, scales), last)
    beyond = cell_of_value(high - period, i, counts, places, edges, scales)
    return first, max(beyond, 0) + last + 1


def cell_of_value(
    value: float,
    i: int,
    counts: np.ndarray,
    places: np.ndarray,
    edges: np.ndarray,
    scales: np.ndarray,
) -> int:
    """Return the cell of a value along an axis; -1 below the grid, and their number above it.

    Args:
        value: of the coordinate.
        i: the axis.
        counts: of the grid.
        places: of the grid.
        edges: of the grid.
        scales: of the grid.
    """
    t = (value - scales[i, 0]) * scales[i, 1]
    if not t >= 0.0:
        return -1
    last = counts[3 * AXES + i] - 1
    cell = int(places[counts[2 * AXES + i] + (int(t) if t < last else last)])
    count, first = counts[i], counts[AXES + i]
    while cell < count and edges[first + cell + 1] <= value:
        cell += 1
    return cell


def least_value(  # noqa: PLR0913
    f0: int,
    l0: int,
    f1: int,
    l1: int,
    f2: int,
    l2: int,
    f3: int,
    l3: int,
    layer: int,
    tables: np.ndarray,
    counts: np.ndarray,
) -> float:
    """Return the least value of a box of cells; 0 where it leaves the grid, if all are positive.

    An entry of the table stands for a block of cells that begins there.

    Args:
        f0: first cell along the first axis; see `cells_between`, as for all others.
        l0: last cell.
        f1: along the second axis.
        l1: last cell.
        f2: along the third axis.
        l2: last cell.
        f3: along the fourth axis.
        l3: last cell.
        layer: which of the tables to take.
        tables: shape (T, cells).
        counts: of the grid.
    """
    n0, n1, n2, n3 = counts[0], counts[1], counts[2], counts[3]
    b0, b1, b2, b3 = (
        counts[4 * AXES],
        counts[4 * AXES + 1],
        counts[4 * AXES + 2],
        counts[4 * AXES + 3],
    )
    least = inf
    if min(min(f0, f1), min(f2, f3)) < 0:
        least = 0.0
        f0, f1 = (f0 if f0 >= 0 else -1 - f0), (f1 if f1 >= 0 else -1 - f1)
        f2, f3 = (f2 if f2 >= 0 else -1 - f2), (f3 if f3 >= 0 else -1 - f3)
    # The last block of an axis ends with the last cell.
    e0, e1, e2, e3 = (
        max(f0, l0 - b0 + 1),
        max(f1, l1 - b1 + 1),
        max(f2, l2 - b2 + 1),
        max(f3, l3 - b3 + 1),
    )
    for i0 in range(f0, l0 + 1, b0):
        c0 = min(i0, e0)
        c0 = (c0 - n0 if c0 >= n0 else c0) * n1
        for i1 in range(f1, l1 + 1, b1):
            c1 = min(i1, e1)
            c1 = (c0 + (c1 - n1 if c1 >= n1 else c1)) * n2
            for i2 in range(f2, l2 + 1, b2):
                c2 = min(i2, e2)
                c2 = (c1 + (c2 - n2 if c2 >= n2 else c2)) * n3
                for i3 in range(f3, l3 + 1, b3):
                    c3 = min(i3, e3)
                    value = tables[layer, c2 + (c3 - n3 if c3 >= n3 else c3)]
                    if value < least:
                        least = value
    return least
