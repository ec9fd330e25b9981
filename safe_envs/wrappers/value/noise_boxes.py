"""Boxes of standard normals, with their probabilities."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

_HALF_EDGES = (0.0, 0.45, 0.95, 1.5, 2.1, 2.8, 3.8, 5.6)
"""Upper ends of the intervals of a normal, with their mirror images; beyond the last is .00000002.
They are wider where the density is low."""

_NEGLIGIBLE = 1e-10


class NoiseBoxes(NamedTuple):
    """Boxes of some standard normals.

    Attributes:
        low: least entries, shape (c, W).
        high: largest entries, shape (c, W).
        weights: probability of each box, shape (W,).
        rest: probability of the noise in none of them.
    """

    low: np.ndarray
    high: np.ndarray
    weights: np.ndarray
    rest: float


def noise_boxes(channels: int) -> NoiseBoxes:
    """Return boxes that hold nearly all values of some standard normals.

    Args:
        channels: number of normals; without any there is one box of nothing.
    """
    from scipy.special import ndtr

    half = np.array(_HALF_EDGES)
    edges = np.concatenate([-half[:0:-1], half])
    chances = np.diff(ndtr(edges))
    low, high, weights = [], [], []
    for places in itertools.product(range(len(chances)), repeat=channels):
        weight = float(np.prod(chances[list(places)]))
        if weight > _NEGLIGIBLE:
            low.append(edges[list(places)])
            high.append(edges[np.array(places, dtype=int) + 1])
            weights.append(weight)
    shape = (len(weights), channels)
    # The weights of several boxes never exceed 1, whatever the rounding.
    total = np.array(weights) * (1.0 - 1e-15 if channels else 1.0)
    return NoiseBoxes(
        np.reshape(low, shape).T,
        np.reshape(high, shape).T,
        total,
        max(0.0, 1.0 - float(total.sum())),
    )
