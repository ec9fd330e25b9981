"""Quadratures by Gauss and Hermite over the standard normals of a sub-step."""

from __future__ import annotations

import itertools

import numpy as np

Rule = tuple[np.ndarray, np.ndarray]
"""Nodes of shape (channels, count), and their weights, of sum 1."""

_NODES, _MOST_NODES = 28, 1 << 14


def normal_rules(channels: int) -> tuple[Rule, ...]:
    """Return quadratures over independent standard normals, of more and more nodes.

    Args:
        channels: number of normals; without any there is one rule of one node.
    """
    if not channels:
        return (_tensor(1, 0),)
    most = min(_NODES, int(_MOST_NODES ** (1 / channels)))
    return tuple(_tensor(max(most * part // 8, 1), channels) for part in (4, 5, 6, 8))


def _tensor(count: int, channels: int) -> Rule:
    nodes, weights = np.polynomial.hermite_e.hermegauss(count)
    weights = weights / weights.sum()
    shape = (count**channels, channels)
    grid = np.array(list(itertools.product(nodes, repeat=channels))).reshape(shape)
    shares = np.array(list(itertools.product(weights, repeat=channels))).reshape(shape)
    return grid.T, shares.prod(axis=1)
