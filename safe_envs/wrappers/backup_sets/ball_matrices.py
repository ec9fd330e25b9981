"""Matrices with bounds of their errors: enclosures of products, and of the largest singular value.

A ball matrix [C - R, C + R] holds every matrix that differs from C by at most R, entry by entry.
Products are enclosed by |AB - A_c B_c| <= |A_c| B_r + A_r (|B_c| + B_r), and what rounding adds.

Rounding: a computed sum of n products is off by at most n u/(1 - n u) times the sum of their
absolute values, u = 2^-53, in whatever order it is added (Higham 2002, Sec. 3.1). All bounds here
allow a multiple of that. Numbers so small that products underflow are covered by `_TINY`.

Source: Rump 1999, "Fast and parallel interval arithmetic".
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safe_envs.dynamics.interval_arithmetic import Interval

_ULP = 2.0**-52
_TINY = 1e-290
_MORE = 1.0 + 1e-13
_QUIET = np.errstate(invalid="ignore", over="ignore")
"""What is infinite or NaN says that nothing is known."""


class BallMatrix(NamedTuple):
    """Matrices within a radius of a center, entry by entry; shapes (..., n, m)."""

    center: np.ndarray
    radius: np.ndarray


@_QUIET
def enclosing(a: Interval) -> BallMatrix:
    """Return the ball matrix that holds an interval of matrices; NaN where nothing is known."""
    center = 0.5 * a.low + 0.5 * a.high
    radius = np.maximum(a.high - center, center - a.low) * _MORE
    return BallMatrix(center, radius + _ULP * np.abs(center) + _TINY)


@_QUIET
def interval_of(a: BallMatrix) -> Interval:
    """Return the interval that holds a ball matrix; the whole line where nothing is known."""
    radius = a.radius * _MORE + _ULP * np.abs(a.center) + _TINY
    unknown = np.isnan(a.center + radius)
    return Interval(
        np.where(unknown, -np.inf, a.center - radius), np.where(unknown, np.inf, a.center + radius)
    )


@_QUIET
def plus(a: BallMatrix, b: BallMatrix) -> BallMatrix:
    """Return a + b.

    Args:
        a: shapes (..., n, m).
        b: likewise.
    """
    center = a.center + b.center
    return BallMatrix(center, (a.radius + b.radius) * _MORE + _ULP * np.abs(center) + _TINY)


@_QUIET
def scaled(factor: float, a: BallMatrix) -> BallMatrix:
    """Return the product of a float and a ball matrix.

    Args:
        factor: the float.
        a: the matrices.
    """
    center = factor * a.center
    return BallMatrix(center, abs(factor) * a.radius * _MORE + 2 * _ULP * np.abs(center) + _TINY)


@_QUIET
def times(a: BallMatrix, b: BallMatrix) -> BallMatrix:
    """Return the matrix product a b; NaN where nothing is known of a factor.

    Args:
        a: shapes (..., n, k).
        b: shapes (..., k, m).
    """
    center = a.center @ b.center
    sizes = np.abs(a.center), np.abs(b.center)
    rounding = 4 * a.center.shape[-1] * _ULP * (sizes[0] @ sizes[1])
    radius = sizes[0] @ b.radius + a.radius @ (sizes[1] + b.radius) + rounding
    return BallMatrix(center, radius * _MORE + _TINY)


def exactly(a: np.ndarray) -> BallMatrix:
    """Return the ball matrix of one matrix."""
    return BallMatrix(a, np.zeros_like(a))


@_QUIET
def norm_bound(a: BallMatrix) -> np.ndarray:
    """Return an upper bound of the largest singular value of every matrix in a.

    With computed factors U, s, V of the center, |C| <= |U| max(s) |V| + |C - U diag(s) V|, and
    |U|^2 <= 1 + |U'U - I|: nothing depends on how the factors were found.

    Args:
        a: shapes (..., n, m).

    Returns:
        Shape (...); infinite where a is not finite.
    """
    finite = np.asarray(np.isfinite(a.center + a.radius).all(axis=(-2, -1), keepdims=True))
    center = np.where(finite, a.center, 0.0)
    left, s, right = np.linalg.svd(center, full_matrices=False)
    product = times(exactly(left * s[..., None, :]), exactly(right))
    rest = plus(exactly(center), scaled(-1.0, product))
    slack = rest.radius + 4 * _ULP * np.abs(left * s[..., None, :]) @ np.abs(right)
    of_rest = frobenius(BallMatrix(rest.center, slack))
    bound = s.max(axis=-1) * _stretch(left) * _stretch(np.swapaxes(right, -1, -2)) + of_rest
    bound = (bound + frobenius(a, of_radius=True)) * _MORE + _TINY
    return np.where(finite[..., 0, 0], bound, np.inf)


@_QUIET
def frobenius(a: BallMatrix, of_radius: bool = False) -> np.ndarray:
    """Return an upper bound of the Frobenius norm of every matrix in a.

    Args:
        a: shapes (..., n, m).
        of_radius: of the differences from the center only.
    """
    sizes = a.radius if of_radius else np.abs(a.center) + a.radius
    return np.sqrt((sizes**2).sum(axis=(-2, -1))) * _MORE + _TINY


def _stretch(factor: np.ndarray) -> np.ndarray:
    """Return an upper bound of the norm of matrices whose columns are nearly orthonormal."""
    gram = times(exactly(np.swapaxes(factor, -1, -2)), exactly(factor))
    defect = frobenius(plus(gram, exactly(-np.eye(factor.shape[-1]))))
    return np.sqrt(1.0 + defect) * _MORE
