"""Symmetric matrices as components: the upper triangle, (1, 1), (1, 2), .., (1, n), (2, 2), ..."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np


@lru_cache(maxsize=64)
def pairs(n: int) -> tuple[tuple[int, int], ...]:
    """Return the places (i, j), i <= j, of the components of an n x n matrix, in order."""
    return tuple((i, j) for i in range(n) for j in range(i, n))


@lru_cache(maxsize=64)
def places(n: int) -> dict[tuple[int, int], int]:
    """Return the index of the component of each place (i, j), on both sides of the diagonal."""
    found = {pair: index for index, pair in enumerate(pairs(n))}
    return found | {(j, i): index for (i, j), index in found.items()}


def packed(matrix: Any) -> list[float]:
    """Return the components of a symmetric matrix (n, n)."""
    table = np.asarray(matrix, dtype=float)
    return [float(table[i, j]) for i, j in pairs(len(table))]


def unpacked(components: Sequence[Any], n: int) -> np.ndarray:
    """Return the matrix of components.

    Args:
        components: n (n + 1)/2 numbers, or arrays (B,).
        n: order of the matrix.

    Returns:
        Shape (n, n), or (B, n, n).
    """
    index = np.array([[places(n)[i, j] for j in range(n)] for i in range(n)])
    table = np.stack([np.asarray(c, dtype=float) for c in components])
    return np.moveaxis(table[index], (0, 1), (-2, -1))


def positive_part(components: Sequence[Any], n: int) -> list[Any]:
    """Return the smallest positive semidefinite matrix above a symmetric one, by components.

    Its eigenvalues are those of the other, or 0 in the place of negative ones.

    Args:
        components: floats or arrays (B,).
        n: order of the matrix.
    """
    if n == 1:
        return [np.maximum(components[0], 0.0)]
    values, vectors = np.linalg.eigh(unpacked(components, n))
    scaled = vectors * np.maximum(values, 0.0)[..., None, :]
    found = scaled @ np.swapaxes(vectors, -1, -2)
    return [found[..., i, j] for i, j in pairs(n)]


def cholesky(components: Sequence[Any], n: int) -> list[list[Any]]:
    """Return L with L L' = P, L_ij as entry j of list i, of a positive semidefinite P.

    Where a pivot is not positive, its column is 0: then L L' leaves out what rounding alone makes.

    Args:
        components: of P, floats or arrays (B,).
        n: order of the matrix.
    """
    at, zero = places(n), np.zeros(np.shape(components[0]))
    rows: list[list[Any]] = [[zero] * n for _ in range(n)]
    for j in range(n):
        pivot = components[at[j, j]] - sum(rows[j][k] ** 2 for k in range(j))
        # What is left of a pivot after rounding counts as nothing.
        sound = pivot > 1e-14 * abs(components[at[j, j]])
        root = np.sqrt(np.where(sound, pivot, 1.0))
        rows[j][j] = np.where(sound, root, 0.0)
        for i in range(j + 1, n):
            rest = components[at[i, j]] - sum(rows[i][k] * rows[j][k] for k in range(j))
            rows[i][j] = np.where(sound, rest / root, 0.0)
    return rows
