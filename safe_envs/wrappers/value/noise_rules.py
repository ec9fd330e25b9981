"""Quadratures over the noise of a control period, for smooth functions and for edges of sets."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

_MOST_NODES = 81
_FEW_POINTS, _MANY_POINTS = 64, 256
_LEAST_WEIGHT = 1e-7
_WIDTHS = {1: 0.25, 2: 0.8}
_ENDS = {1: 4.75, 2: 4.4}


@dataclass(frozen=True)
class NoiseRule:
    """Nodes of standard normals, and their weights.

    Attributes:
        nodes: shape (d, W).
        weights: of sum 1, shape (W,).
        width: of the part that each node stands for, along each axis, within which noise may pass
            the edge of a set; 0 where each node stands for itself.
    """

    nodes: np.ndarray
    weights: np.ndarray
    width: float


def smooth_rule(normals: int) -> NoiseRule:
    """Return few nodes, exact for polynomials of degree 5 along each axis.

    Args:
        normals: number d of standard normals; quasi-random nodes are taken of many.
    """
    if not normals:
        return NoiseRule(np.zeros((0, 1)), np.ones(1), 0.0)
    if 3**normals > _MOST_NODES:
        return _points(normals, _FEW_POINTS)
    return _product(np.array([-np.sqrt(3.0), 0.0, np.sqrt(3.0)]), np.array([1, 4, 1]) / 6, normals)


def edge_rule(normals: int) -> NoiseRule:
    """Return many nodes in boxes, of which parts may lie beyond the edge of a set."""
    if normals not in _WIDTHS:
        return _points(normals, _MANY_POINTS) if normals else smooth_rule(0)
    from scipy.special import ndtr

    width, end = _WIDTHS[normals], _ENDS[normals]
    edges = np.linspace(-end, end, round(2 * end / width) + 1)
    masses = np.diff(ndtr(edges))
    weights = masses / masses.sum()
    middles = 0.5 * (edges[1:] + edges[:-1])
    # Nodes of variance 1 keep the spread of what is averaged.
    nodes = middles / np.sqrt(weights @ middles**2)
    return _product(nodes, weights, normals, float(edges[1] - edges[0]))


def _product(nodes: np.ndarray, weights: np.ndarray, normals: int, width: float = 0.0) -> NoiseRule:
    found = np.array(list(itertools.product(nodes, repeat=normals))).T
    shares = np.array(list(itertools.product(weights, repeat=normals))).prod(axis=1)
    kept = shares > _LEAST_WEIGHT
    return NoiseRule(found[:, kept], shares[kept] / shares[kept].sum(), width)


def _points(normals: int, count: int) -> NoiseRule:
    """Return quasi-random normals and their mirror images, of variance 1."""
    from scipy.special import ndtri
    from scipy.stats import qmc

    half = ndtri(qmc.Sobol(normals, rng=np.random.default_rng(0)).random(count // 2)).T
    half /= np.sqrt((half**2).mean(axis=1, keepdims=True))
    return NoiseRule(np.concatenate([half, -half], axis=1), np.full(count, 1.0 / count), 0.0)
