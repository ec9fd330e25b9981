"""The Bellman operator on the cells of a grid, as kernels.

A state goes to one of a number of boxes, each with a probability; what is taken of a box is the
least value of the cells that it touches. Upper envelopes are computed as lower ones of their
negative values.

`images` holds for each state, input, scenario of the uncertain parameters, and box of the noise the
ends of each coordinate, without what an input adds in proportion; `effects` holds the ends of the
proportion for each state, scenario, coordinate and input. `counts`, `places` and `scales` describe
a grid: see `GridArrays`.
"""

from __future__ import annotations

from math import floor, inf

import numpy as np

AXES = 4
"""Axes of the tables in kernels; those that a problem does not have are of one cell."""


def expected_values(  # noqa: PLR0913
    first: int,
    last: int,
    images: np.ndarray,
    effects: np.ndarray,
    inputs: np.ndarray,
    weights: np.ndarray,
    rows: np.ndarray,
    tables: np.ndarray,
    ends: tuple[float, float],
    counts: np.ndarray,
    places: np.ndarray,
    edges: np.ndarray,
    scales: np.ndarray,
    window: np.ndarray,
    found: np.ndarray,
) -> None:
    """Bound the expected value of states under inputs from below.

    Args:
        first: state to begin with.
        last: state to end before.
        images: see the module, shape (B, 1 or V, R, W, n, 2).
        effects: see the module, shape (B, R, n, m, 2).
        inputs: ends of each input, shape (B or 1, V, m, 2).
        weights: probability of each box of the noise, shape (W,).
        rows: row of the tables for each state, shape (B,).
        tables: values of the next control instant, shape (rows, cells).
        ends: value outside the grid, and what the noise beyond all boxes adds.
        counts: of the grid.
        places: of the grid.
        edges: of the grid.
        scales: of the grid.
        window: scratch array of 8 entries.
        found: receives the bounds, shape (B, V).
    """
    several = images.shape[1] > 1
    own = inputs.shape[0] > 1
    for a in range(first, last):
        for u in range(inputs.shape[1]):
            found[a, u] = expected_value(
                a,
                u if several else 0,
                a if own else 0,
                u,
                images,
                effects,
                inputs,
                weights,
                rows[a],
                tables,
                ends,
                counts,
                places,
                edges,
                scales,
                window,
            )


def sweep_lower(  # noqa: PLR0913
    first: int,
    last: int,
    turn: int,
    images: np.ndarray,
    effects: np.ndarray,
    inputs: np.ndarray,
    weights: np.ndarray,
    tables: np.ndarray,
    ends: tuple[float, float],
    neighbours: np.ndarray,
    counts: np.ndarray,
    places: np.ndarray,
    edges: np.ndarray,
    scales: np.ndarray,
    window: np.ndarray,
    best: np.ndarray,
    found: np.ndarray,
) -> None:
    """Maximise the bound of the expected value over some of the inputs.

    Any input gives a lower envelope. Those near the best one of the last sweep, and another one each
    time, find nearly the maximum of all.

    Args:
        first: state to begin with.
        last: state to end before.
        turn: number of the sweep; all inputs are tried where it is 0.
        images: see `expected_values`, as for all others.
        effects: see there.
        inputs: see there, shape (1, U, m, 2).
        weights: see there.
        tables: see there, of one row.
        ends: see there.
        neighbours: of each input, shape (U, N), -1 for none.
        counts: of the grid.
        places: of the grid.
        edges: of the grid.
        scales: of the grid.
        window: scratch array of 8 entries.
        best: the best input of the last sweep, which is replaced, shape (B,); -1 where nothing is to
            be found.
        found: receives the bounds, shape (B,).
    """
    several = images.shape[1] > 1
    tried = inputs.shape[1]
    for a in range(first, last):
        if best[a] < 0:
            continue
        largest, chosen = -inf, best[a]
        number = tried if turn == 0 else neighbours.shape[1] + 2
        for j in range(number):
            if turn == 0:
                u = j
            elif j == 0:
                u = best[a]
            elif j == 1:
                u = (a * 7 + turn) % tried
            else:
                u = neighbours[best[a], j - 2]
            if u >= 0:
                value = expected_value(
                    a,
                    u if several else 0,
                    0,
                    u,
                    images,
                    effects,
                    inputs,
                    weights,
                    0,
                    tables,
                    ends,
                    counts,
                    places,
                    edges,
                    scales,
                    window,
                )
                if value > largest:
                    largest, chosen = value, u
        best[a] = chosen
        found[a] = largest


def sweep_upper(  # noqa: PLR0913
    first: int,
    last: int,
    images: np.ndarray,
    effects: np.ndarray,
    inputs: np.ndarray,
    weights: np.ndarray,
    tables: np.ndarray,
    ends: tuple[float, float],
    counts: np.ndarray,
    places: np.ndarray,
    edges: np.ndarray,
    scales: np.ndarray,
    window: np.ndarray,
    known: np.ndarray,
    found: np.ndarray,
) -> None:
    """Maximise an upper bound of the expected value over all inputs.

    Upper envelopes do not rise backwards in time, so that what was found for an input in an earlier
    sweep is a bound still: only inputs whose bound is the largest are computed again.

    Args:
        first: state to begin with.
        last: state to end before.
        images: see `expected_values`, as for all others.
        effects: see there.
        inputs: boxes that cover all inputs, shape (1, U, m, 2).
        weights: see there.
        tables: see there; the negative values, of one row.
        ends: see there.
        counts: of the grid.
        places: of the grid.
        edges: of the grid.
        scales: of the grid.
        window: scratch array of 8 entries.
        known: upper bounds for each input, which are replaced, shape (B, U).
        found: receives the upper bounds, shape (B,).
    """
    several = images.shape[1] > 1
    tried = inputs.shape[1]
    for a in range(first, last):
        settled = -inf
        for _ in range(tried):
            largest, chosen = -inf, 0
            for u in range(tried):
                if known[a, u] > largest:
                    largest, chosen = known[a, u], u
            if largest <= settled:
                break
            value = -expected_value(
                a,
                chosen if several else 0,
                0,
                chosen,
                images,
                effects,
                inputs,
                weights,
                0,
                tables,
                ends,
                counts,
                places,
                edges,
                scales,
                window,
            )
            # Rounding may lift a bound by a little.
            known[a, chosen] = min(value, largest)
            settled = max(settled, known[a, chosen])
        largest = -inf
        for u in range(tried):
            if known[a, u] > largest:
                largest = known[a, u]
        found[a] = largest


def expected_value(  # noqa: PLR0913
    a: int,
    v: int,
    b: int,
    u: int,
    images: np.ndarray,
    effects: np.ndarray,
    inputs: np.ndarray,
    weights: np.ndarray,
    row: int,
    tables: np.ndarray,
    ends: tuple[float, float],
    counts: np.ndarray,
    places: np.ndarray,
    edges: np.ndarray,
    scales: np.ndarray,
    window: np.ndarray,
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
        row: of the tables.
        tables: see there.
        ends: see there.
        counts: of the grid.
        places: of the grid.
        edges: of the grid.
        scales: of the grid.
        window: scratch array.
    """
    outside, rest = ends
    n, m = effects.shape[2], effects.shape[3]
    worst = inf
    for r in range(images.shape[2]):
        total = rest
        for w in range(images.shape[3]):
            leaves = False
            misses = False
            for i in range(n):
                low, high = images[a, v, r, w, i, 0], images[a, v, r, w, i, 1]
                for j in range(m):
                    b0, b1 = effects[a, r, i, j, 0], effects[a, r, i, j, 1]
                    if b0 != 0.0 or b1 != 0.0:
                        u0, u1 = inputs[b, u, j, 0], inputs[b, u, j, 1]
                        p, q, s, t = b0 * u0, b0 * u1, b1 * u0, b1 * u1
                        low += min(min(p, q), min(s, t))
                        high += max(max(p, q), max(s, t))
                # The sums above are rounded.
                low, high = low - scales[i, 3], high + scales[i, 3]
                count = counts[i]
                period = scales[i, 2]
                if period > 0.0:
                    if high - low >= period:
                        window[2 * i], window[2 * i + 1] = 0, count - 1
                    else:
                        turns = period * floor((low - scales[i, 0]) / period)
                        low, high = low - turns, high - turns
                        c = cell_of_value(low, i, counts, places, edges, scales)
                        window[2 * i] = min(max(c, 0), count - 1)
                        if high < scales[i, 0] + period:
                            c = cell_of_value(high, i, counts, places, edges, scales)
                            window[2 * i + 1] = min(c, count - 1)
                        else:
                            c = cell_of_value(high - period, i, counts, places, edges, scales)
                            window[2 * i + 1] = max(c, 0) + count
                else:
                    first = cell_of_value(low, i, counts, places, edges, scales)
                    last = cell_of_value(high, i, counts, places, edges, scales)
                    misses = misses or last < 0 or first >= count
                    leaves = leaves or first < 0 or last >= count
                    window[2 * i], window[2 * i + 1] = max(first, 0), min(last, count - 1)
            if misses:
                value = outside
            else:
                value = least_value(row, tables, counts, window)
                if leaves:
                    value = min(value, outside)
            total += weights[w] * value
        worst = min(worst, total)
    return worst


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


def least_value(row: int, tables: np.ndarray, counts: np.ndarray, window: np.ndarray) -> float:
    """Return the least value of a box of cells.

    Args:
        row: of the tables.
        tables: shape (rows, cells).
        counts: of the grid.
        window: first and last cell along each axis; they pass the end of a periodic one.
    """
    least = inf
    for i0 in range(window[0], window[1] + 1):
        c0 = (i0 - counts[0] if i0 >= counts[0] else i0) * counts[1]
        for i1 in range(window[2], window[3] + 1):
            c1 = (c0 + (i1 - counts[1] if i1 >= counts[1] else i1)) * counts[2]
            for i2 in range(window[4], window[5] + 1):
                c2 = (c1 + (i2 - counts[2] if i2 >= counts[2] else i2)) * counts[3]
                for i3 in range(window[6], window[7] + 1):
                    c3 = c2 + (i3 - counts[3] if i3 >= counts[3] else i3)
                    value = tables[row, c3]
                    if value < least:
                        least = value
    return least
