"""The functions of `bellman_kernel` for arrays, without Numba.

The arguments are those of the kernels. They give the same numbers, but for the order of sums.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from safe_envs.values.expected_value_kernel import AXES
from safe_envs.values.grid import GridArrays

_AT_ONCE = 200_000

_ROUNDS = 60


def expected_values(first: int, last: int, *arguments: Any) -> None:
    """Bound the expected value of states under inputs from below; see `bellman_kernel`."""
    images, effects, inputs, weights, layers, tables, beyond, *grid, _, found = arguments
    for part in _parts(first, last, images):
        own = inputs[part] if len(inputs) > 1 else inputs
        for u in range(inputs.shape[1]):
            v = u if images.shape[1] > 1 else 0
            given = images[part, v], effects[part], own[:, u], weights, layers[part]
            found[part, u] = _expected(*given, tables, beyond, GridArrays(*grid))


def sweep_lower(first: int, last: int, turn: int, *arguments: Any) -> None:
    """Maximise the bound of the expected value over all inputs; see `bellman_kernel`."""
    images, effects, inputs, weights, tables, beyond, _, *grid, _, best, found = arguments
    del turn  # Arrays try all inputs each time.
    for part in _parts(first, last, images):
        going = part[best[part] >= 0]
        largest = np.full(len(going), -np.inf)
        layers = np.zeros(len(going), dtype=np.int64)
        for u in range(inputs.shape[1]):
            v = u if images.shape[1] > 1 else 0
            given = images[going, v], effects[going], inputs[:, u], weights, layers
            value = _expected(*given, tables, beyond, GridArrays(*grid))
            better = value > largest
            best[going[better]], largest[better] = u, value[better]
        found[going] = largest


def sweep_upper(first: int, last: int, *arguments: Any) -> None:
    """Maximise an upper bound of the expected value over all inputs; see `bellman_kernel`."""
    images, effects, inputs, weights, tables, beyond, *grid, _, known, _, _, found = arguments
    for part in _parts(first, last, images):
        layers = np.zeros(len(part), dtype=np.int64)
        for u in range(inputs.shape[1]):
            v = u if images.shape[1] > 1 else 0
            given = images[part, v], effects[part], inputs[:, u], weights, layers
            value = -_expected(*given, tables, beyond, GridArrays(*grid))
            known[part, u] = np.minimum(value, known[part, u])
        found[part] = known[part].max(axis=1)


def kept_values(first: int, last: int, *arguments: Any) -> None:
    """Bound expected values, and find how little of them suffices; see `promise_kernel`."""
    images, effects, inputs, weights, layers, tables, *grid, _, _, levels, expected, found = (
        arguments
    )
    for part in _parts(first, last, images):
        given = images[part, 0], effects[part], inputs[part, 0], layers[part]
        values = _box_values(*given, tables, GridArrays(*grid))
        expected[part] = (values @ weights).min(axis=1)
        wanted, caps = levels[part, None], np.repeat(levels[part, None], images.shape[2], axis=1)
        open_ = np.ones(caps.shape, dtype=bool)
        for _ in range(_ROUNDS):
            bound = np.minimum(values, caps[..., None]) @ weights
            slope = (values > caps[..., None]) @ weights
            open_ = (bound < wanted) & (caps < np.inf)
            if not open_.any():
                break
            more = (wanted - bound) / np.maximum(slope, 1e-300) * (1.0 + 1e-9) + 1e-16
            caps = np.where(open_, np.where(slope > 0.0, caps + more, np.inf), caps)
        else:
            caps[open_] = np.inf
        found[part] = caps.max(axis=1)


def _parts(first: int, last: int, images: np.ndarray) -> list[np.ndarray]:
    size = max(1, _AT_ONCE // (images.shape[2] * images.shape[3]))
    return [np.arange(a, min(a + size, last)) for a in range(first, last, size)]


def _expected(
    images: np.ndarray,
    effects: np.ndarray,
    inputs: np.ndarray,
    weights: np.ndarray,
    layers: np.ndarray,
    tables: np.ndarray,
    rest: float,
    grid: GridArrays,
) -> np.ndarray:
    """Return bounds (B,) for images (B, R, W, n, 2) and inputs (B or 1, m, 2)."""
    value = _box_values(images, effects, inputs, layers, tables, grid)
    return (rest + value @ weights).min(axis=1)


def _box_values(
    images: np.ndarray,
    effects: np.ndarray,
    inputs: np.ndarray,
    layers: np.ndarray,
    tables: np.ndarray,
    grid: GridArrays,
) -> np.ndarray:
    """Return the least values (B, R, W) of the cells that images (B, R, W, n, 2) touch."""
    products = effects[..., :, None] * inputs[:, None, None, :, None, :]
    low = images[..., 0] + products.min(axis=(-1, -2)).sum(axis=-1)[:, :, None]
    high = images[..., 1] + products.max(axis=(-1, -2)).sum(axis=-1)[:, :, None]
    first, last, misses, leaves = _windows(low, high, grid)
    value = _least(layers[:, None, None], tables, grid.counts, first, last)
    value = np.where(leaves, np.minimum(value, 0.0), value)
    return np.where(misses, 0.0, value)


def _windows(
    low: np.ndarray, high: np.ndarray, grid: GridArrays
) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray, np.ndarray]:
    """Return the first and the last cell along each axis, and what misses or leaves the grid."""
    counts, _, edges, scales = grid
    firsts, lasts = [], []
    misses = np.zeros(low.shape[:-1], dtype=bool)
    leaves = np.zeros(low.shape[:-1], dtype=bool)
    for i in range(low.shape[-1]):
        count, begin = counts[i], counts[AXES + i]
        own = edges[begin : begin + count + 1]
        a, b = low[..., i] - scales[i, 3], high[..., i] + scales[i, 3]
        start, period = scales[i, 0], scales[i, 2]
        if period > 0.0:
            turns = period * np.floor((a - start) / period)
            whole = b - a >= period
            a, b = a - turns, b - turns
            beyond = b >= start + period
            first = np.clip(np.searchsorted(own, a, side="right") - 1, 0, count - 1)
            last = np.searchsorted(own, np.where(beyond, b - period, b), side="right") - 1
            last = np.clip(last, 0, count - 1) + np.where(beyond, count, 0)
            first, last = np.where(whole, 0, first), np.where(whole, count - 1, last)
        else:
            first = np.searchsorted(own, a, side="right") - 1
            last = np.searchsorted(own, b, side="right") - 1
            misses |= (last < 0) | (first >= count)
            leaves |= (first < 0) | (last >= count)
            first, last = np.clip(first, 0, count - 1), np.clip(last, 0, count - 1)
        firsts.append(first)
        lasts.append(last)
    return firsts, lasts, misses, leaves


def _least(
    layers: np.ndarray,
    tables: np.ndarray,
    counts: np.ndarray,
    first: list[np.ndarray],
    last: list[np.ndarray],
) -> np.ndarray:
    """Return the least value of each box of cells, an entry of the table standing for a block."""
    blocks = counts[4 * AXES :]
    last = [
        np.maximum(a, b - n + 1) for a, b, n in zip(first, last, blocks[: len(first)], strict=True)
    ]
    widths = [int((b - a).max(initial=0)) for a, b in zip(first, last, strict=True)]
    least = np.full(first[0].shape, np.inf)
    steps = [[*range(0, width, n), width] for width, n in zip(widths, blocks, strict=False)]
    for moves in itertools.product(*steps):
        cell = np.zeros(first[0].shape, dtype=np.int64)
        for i, (a, b, move) in enumerate(zip(first, last, moves, strict=True)):
            place = np.minimum(a + move, b)
            cell = cell * counts[i] + np.where(place >= counts[i], place - counts[i], place)
        np.minimum(least, tables[layers, cell], out=least)
    return least
