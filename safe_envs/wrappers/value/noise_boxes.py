"""Boxes of standard normals, with their probabilities."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

_FURTHEST = 5.6
"""Largest absolute value of a normal in an interval; beyond it is .00000002."""

_EVEN = 0.55
"""How much of an interval's width does not grow with its distance from 0."""

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


def noise_boxes(counts: Sequence[int]) -> NoiseBoxes:
    """Return boxes that hold nearly all values of some standard normals.

    Args:
        counts: number of intervals of each normal; without any there is one box of nothing.
    """
    from scipy.special import ndtr

    edges = [_edges(count) for count in counts]
    chances = [np.diff(ndtr(each)) for each in edges]
    low, high, weights = [], [], []
    for places in itertools.product(*map(range, counts)):
        weight = math.prod(float(each[i]) for each, i in zip(chances, places, strict=True))
        if weight > _NEGLIGIBLE:
            low.append([each[i] for each, i in zip(edges, places, strict=True)])
            high.append([each[i + 1] for each, i in zip(edges, places, strict=True)])
            weights.append(weight)
    shape = (len(weights), len(counts))
    # The weights of several boxes never exceed 1, whatever the rounding.
    total = np.array(weights) * (1.0 - 1e-15 if counts else 1.0)
    return NoiseBoxes(
        np.reshape(low, shape).T,
        np.reshape(high, shape).T,
        total,
        max(0.0, 1.0 - float(total.sum())),
    )


def _edges(count: int) -> np.ndarray:
    """Return the ends of intervals of a normal, which are wider where its density is low."""
    t = np.linspace(-1.0, 1.0, count + 1)
    return _FURTHEST * (_EVEN * t + (1.0 - _EVEN) * t**3)
