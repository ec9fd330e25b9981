"""Least squares of the constraints that are missed, whatever their rank.

In an orthonormal basis of the constraints, in which the problem has full rank.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from safe_envs.compiled.plain_natives import table_view, vector_view
from safe_envs.wrappers.qp.kernels.span import span_of_rows, split_along_span

NO_ROW = 1e-14
"""Part of the largest constraint that rounding leaves of another."""


def work_of_fit(k: int, m: int) -> int:
    """Return the length of the scratch array of `fit_missed`.

    Args:
        k: number of constraints.
        m: number of inputs.
    """
    return 2 * k * m + 2 * m * m + 3 * (k + m)


def fit_missed(
    scaled: np.ndarray,
    margins: np.ndarray,
    missed: np.ndarray,
    held: np.ndarray,
    step: np.ndarray,
    work: np.ndarray,
) -> None:
    """Find the shortest step that leaves the least sum of squares of the margins that take part.

    Args:
        scaled: coefficients, shape (k, m).
        margins: margins, shape (k,).
        missed: positive for the constraints that take part, shape (k,).
        held: 0 for the inputs that may move, shape (m,).
        step: receives the step, shape (m,).
        work: scratch of `work_of_fit`.
    """
    k, m = len(margins), len(step)
    columns, table = table_view(work, 0, m, k), table_view(work, k * m, k, m)
    place = 2 * k * m
    space, triangle = table_view(work, place, m, m), table_view(work, place + m * m, m, m)
    place += 2 * m * m
    wanted, whole = vector_view(work, place, k), vector_view(work, place + k, k)
    rest, taken = vector_view(work, place + 2 * k, k), vector_view(work, place + 3 * k, m)
    order = vector_view(work, place + 3 * k + m, m)
    shares = vector_view(work, place + 3 * k + 2 * m, m)
    for i in range(k):
        wanted[i] = -margins[i] if missed[i] > 0.0 else 0.0
        whole[i] = 0.0
        for j in range(m):
            table[i, j] = scaled[i, j] if missed[i] > 0.0 and held[j] == 0.0 else 0.0
    size = space_of_rows(table, space)
    for c in range(m):
        taken[c] = 1.0 if c < size else 0.0
        for i in range(k):
            columns[c, i] = 0.0
            if c < size and missed[i] > 0.0:
                for j in range(m):
                    columns[c, i] += scaled[i, j] * space[c, j]
    basis = table_view(work, k * m, m, k)  # in place of `table`, which has served
    count = span_of_rows(columns, taken, whole, basis, triangle, order)
    split_along_span(count, wanted, whole, basis, triangle, shares, rest)
    for j in range(m):
        step[j] = 0.0
        for c in range(count):
            step[j] += shares[c] * space[int(order[c]), j]


def space_of_rows(table: np.ndarray, space: np.ndarray) -> int:
    """Find an orthonormal basis of the rows of a table, the largest ones first.

    Args:
        table: the rows, shape (k, m), which are overwritten.
        space: receives the basis, shape (m, m).

    Returns:
        How many there are.
    """
    k, m = table.shape
    count, least = 0, 0.0
    while count < m:
        chosen, largest = -1, least
        for i in range(k):
            square = 0.0
            for j in range(m):
                square += table[i, j] * table[i, j]
            if square > largest:
                chosen, largest = i, square
        if chosen < 0:
            break
        if count == 0:
            least = NO_ROW * NO_ROW * largest
        for j in range(m):
            space[count, j] = table[chosen, j] / sqrt(largest)
        for c in range(count):  # takes back rounding
            share = 0.0
            for j in range(m):
                share += space[c, j] * space[count, j]
            for j in range(m):
                space[count, j] -= share * space[c, j]
        length = 0.0
        for j in range(m):
            length += space[count, j] * space[count, j]
        for j in range(m):
            space[count, j] /= sqrt(length)
        for i in range(k):
            share = 0.0
            for j in range(m):
                share += table[i, j] * space[count, j]
            for j in range(m):
                table[i, j] = table[i, j] - share * space[count, j] if i != chosen else 0.0
        count += 1
    return count
