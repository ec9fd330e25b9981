"""Which points of curves are drawn."""

from __future__ import annotations

import numpy as np

_APART = 1.5
_MOST_POINTS = 1000
_MOST_IN_CHART = 400

BRUSHES = {
    1: ((0.0, 0.0),),
    2: ((0.0, -0.5), (0.43, 0.25), (-0.43, 0.25)),
    3: ((0.0, -0.9), (0.9, 0.0), (0.0, 0.9), (-0.9, 0.0), (0.0, 0.0)),
}
"""Offsets of the thin lines that make a line of 1, 2 or 3 pixels."""


def apart(points: np.ndarray) -> np.ndarray:
    """Return indices of points about 1.5 pixels apart along a path, with the first and the last."""
    steps = np.floor(_lengths(points) / _APART)
    return np.unique(np.concatenate([[0], np.flatnonzero(np.diff(steps)) + 1, [len(points) - 1]]))


def dash_ends(points: np.ndarray, period: float) -> list[tuple[list[float], list[float]]]:
    """Return the ends of each dash of a dashed path.

    Args:
        points: of the path, shape (k, 2).
        period: length of a dash and a gap.

    Returns:
        Pairs of points (x, y).
    """
    along = _lengths(points)
    stops = np.arange(0.0, along[-1], period / 2)
    places = np.stack([np.interp(stops, along, points[:, i]) for i in range(2)], axis=1).tolist()
    return list(zip(places[::2], places[1::2], strict=False))


def _lengths(points: np.ndarray) -> np.ndarray:
    """Return the length of a path up to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def thinned(count: int, most: int = _MOST_POINTS) -> np.ndarray:
    """Return indices of the points of a trail to draw, with the last one.

    Args:
        count: of the points of the trail.
        most: indices.

    Returns:
        Ascending indices.
    """
    # A power of two: points once drawn stay as the trail grows.
    stride = 1 << max(0, (count - 1) // most).bit_length()
    kept = np.arange(0, count, stride)
    return kept if kept[-1] == count - 1 else np.append(kept, count - 1)


def runs(flags: np.ndarray) -> list[slice]:
    """Return where flags are set, each run with the point before it, to be drawn as a line."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [slice(max(int(a) - 1, 0), int(b)) for a, b in edges.reshape(-1, 2)]


def thinned_minima(times: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return fewer points of a curve, with the smallest value of each group of points.

    Args:
        times: shape (k,).
        h: values, shape (k,).

    Returns:
        Times and values of at most about two points for each pixel of a chart.
    """
    stride = 1 + len(h) // _MOST_IN_CHART
    if stride == 1:
        return times, h
    starts = np.arange(0, len(h), stride)
    return times[np.minimum(starts + stride - 1, len(h) - 1)], np.minimum.reduceat(h, starts)
