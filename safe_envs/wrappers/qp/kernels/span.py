"""Least squares with a few vectors, by an orthonormal basis of their span.

Vectors are rows of a table. Those that are taken count, and of these the entries that are free,
where `at` is 0. One that depends on those before it is left out, up to rounding.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

DEPENDENT = 1e-14
"""Part of a vector that the rounding of others leaves of it."""


def span_of_rows(
    rows: np.ndarray,
    taken: np.ndarray,
    at: np.ndarray,
    basis: np.ndarray,
    triangle: np.ndarray,
    order: np.ndarray,
) -> int:
    """Orthonormalise vectors: each is the sum of `triangle` times `basis`, up to its own place.

    Args:
        rows: the vectors, at least as many as `taken` says, of n entries.
        taken: positive for those that count.
        at: 0 for free entries, shape (n,).
        basis: receives the basis, as many rows as can be independent.
        triangle: receives the coefficients, the vectors in columns.
        order: receives the number of the vector for each one of the basis.

    Returns:
        How many are in the basis.
    """
    n, count, most = len(at), 0, min(len(order), len(at))
    for i in range(len(taken)):
        if taken[i] > 0.0 and count < most:
            size = 0.0
            for j in range(n):
                basis[count, j] = rows[i, j] if at[j] == 0.0 else 0.0
                size += basis[count, j] * basis[count, j]
            for c in range(count):
                triangle[c, count] = 0.0
            for _ in range(2):  # the second time takes back the rounding of the first
                for c in range(count):
                    share = 0.0
                    for j in range(n):
                        share += basis[c, j] * basis[count, j]
                    triangle[c, count] += share
                    for j in range(n):
                        basis[count, j] -= share * basis[c, j]
            left = 0.0
            for j in range(n):
                left += basis[count, j] * basis[count, j]
            if left > DEPENDENT * DEPENDENT * size:
                length = sqrt(left)
                for j in range(n):
                    basis[count, j] /= length
                triangle[count, count] = length
                order[count] = i
                count += 1
    return count


def split_along_span(
    count: int,
    vector: np.ndarray,
    at: np.ndarray,
    basis: np.ndarray,
    triangle: np.ndarray,
    shares: np.ndarray,
    rest: np.ndarray,
) -> None:
    """Write the free entries of a vector as a sum of vectors and a rest that is normal to them.

    Args:
        count: how many are in the basis.
        vector: the vector, shape (n,).
        at: 0 for free entries, shape (n,).
        basis: see `span_of_rows`.
        triangle: see there.
        shares: receives the coefficients of the vectors in the basis, in its order.
        rest: receives the rest, 0 for entries that are not free, shape (n,).
    """
    n = len(at)
    for j in range(n):
        rest[j] = vector[j] if at[j] == 0.0 else 0.0
    for c in range(count):
        shares[c] = 0.0
    for _ in range(2):
        for c in range(count):
            share = 0.0
            for j in range(n):
                share += basis[c, j] * rest[j]
            shares[c] += share
            for j in range(n):
                rest[j] -= share * basis[c, j]
    for back in range(count):
        c = count - 1 - back
        for d in range(c + 1, count):
            shares[c] -= triangle[c, d] * shares[d]
        shares[c] /= triangle[c, c]


def least_step_in_span(
    count: int,
    values: np.ndarray,
    basis: np.ndarray,
    triangle: np.ndarray,
    step: np.ndarray,
) -> None:
    """Find the shortest step along which the vectors in the basis have given products.

    Args:
        count: how many are in the basis.
        values: the products, in the order of the basis, which are overwritten.
        basis: see `span_of_rows`.
        triangle: see there.
        step: receives the step, shape (n,).
    """
    for j in range(len(step)):
        step[j] = 0.0
    for c in range(count):
        for d in range(c):
            values[c] -= triangle[d, c] * values[d]
        values[c] /= triangle[c, c]
        for j in range(len(step)):
            step[j] += values[c] * basis[c, j]


def normals_of_rows(
    a: np.ndarray, w: np.ndarray, normals: np.ndarray, unit: np.ndarray, roots: np.ndarray
) -> None:
    """Write the constraints in inputs times the roots of their weights, with unit length.

    Args:
        a: constraints, shape (k, m).
        w: positive weights, shape (m,).
        normals: receives the constraints, shape (k, m).
        unit: receives their lengths, 0 for those that say nothing of the input, shape (k,).
        roots: receives the roots, shape (m,).
    """
    k, m = a.shape
    for j in range(m):
        roots[j] = sqrt(w[j])
    for i in range(k):
        size, square = 0.0, 0.0
        for j in range(m):
            normals[i, j] = a[i, j] / roots[j]
            size = max(size, abs(normals[i, j]))
        if size > 0.0:
            for j in range(m):
                normals[i, j] /= size  # so that squares neither overflow nor vanish
                square += normals[i, j] * normals[i, j]
            for j in range(m):
                normals[i, j] /= sqrt(square)
        unit[i] = size * sqrt(square)
