"""Values where the points of a step lie, interpolated and weighted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix

from safe_envs.wrappers.value.node_grid import NodeGrid

_CUBIC_AXES = 2
"""Axes along which cubic polynomials are taken. On the coarse grids of more axes their overshoots,
which the best inputs look for, would grow from step to step."""

Points = list[np.ndarray]
"""An array for each coordinate."""


def weighted_means(
    grid: NodeGrid, reached: Points, weights: np.ndarray, table: np.ndarray
) -> np.ndarray:
    """Return the weighted sum over noises of interpolated values, shape (U, B).

    Args:
        grid: of the values.
        reached: points, arrays (U, B, W).
        weights: of them, shape (U, B, W).
        table: on the nodes; NaN where there is no value, whose share goes to the others.
    """
    kept = np.flatnonzero(weights)
    nodes, shares = grid.corners([each.reshape(-1)[kept] for each in reached])
    values = table[nodes]
    missing = np.isnan(values)
    if missing.any():
        shares, values = np.where(missing, 0.0, shares), np.where(missing, 0.0, values)
        total = shares.sum(axis=0)
        shares = np.divide(shares, total, out=np.zeros_like(shares), where=total > 0.0)
    found = np.zeros(weights.size)
    found[kept] = weights.reshape(-1)[kept] * np.einsum("cb,cb->b", shares, values)
    return found.reshape(weights.shape).sum(axis=-1)


def weighted_matrix(
    grid: NodeGrid, reached: Points, weights: np.ndarray, known: np.ndarray | None
) -> Any:
    """Return the matrix that interpolates values where a step leads, with weights.

    Args:
        grid: of the values.
        reached: points, arrays (U, B, W).
        weights: of them, shape (U, B, W).
        known: place of each node in the values, -1 for none; its share goes to the others.
    """
    inputs, count, noises = weights.shape
    flat = weights.reshape(-1)
    kept = np.flatnonzero(flat)
    points: Sequence[np.ndarray] = [each.reshape(-1)[kept] for each in reached]
    if len(grid.counts) <= _CUBIC_AXES:
        nodes, shares = grid.around(points, None if known is None else known >= 0)
    else:
        nodes, shares = grid.corners(points)
    columns = grid.size
    if known is not None:
        columns = int(known.max()) + 1
        nodes = known[nodes]
        shares = np.where(nodes >= 0, shares, 0.0)
        total = shares.sum(axis=0)
        shares = np.divide(shares, total, out=np.zeros_like(shares), where=total > 0.0)
        nodes = np.maximum(nodes, 0)
    rows = np.broadcast_to(kept // noises, nodes.shape)
    data = (shares * flat[kept]).astype(np.float32)
    used = data.reshape(-1) != 0.0
    entries = (
        data.reshape(-1)[used],
        (rows.reshape(-1)[used], nodes.reshape(-1)[used]),
    )
    return csr_matrix(entries, shape=(inputs * count, columns), dtype=np.float32)
