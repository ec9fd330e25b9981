"""First-order forms of a polynomial and its derivatives, by expanding it about each box.

The exact coefficients are expanded about the middle of a box, so that terms cancel as they do in
the polynomial, which interval arithmetic on its monomials would not see.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.enclosures.forms import MORE, Form, middle, with_range
from safe_envs.enclosures.intervals import Interval

_UNIT = 2.0**-53
_WIDEST = 1e6
"""Boxes that reach further, in scaled variables, are not expanded about."""

Order = tuple[int, ...]


@dataclass(frozen=True)
class ExpandedPolynomial:
    """A polynomial, ready to be expanded about many boxes.

    Args:
        polynomial: exact.
    """

    polynomial: Polynomial

    @cached_property
    def _coefficients(self) -> np.ndarray:
        return self.polynomial.tensor.astype(float)

    @cached_property
    def _center(self) -> np.ndarray:
        return np.array([float(c) for c in self.polynomial.center])

    @cached_property
    def _scale(self) -> np.ndarray:
        return np.array([float(s) for s in self.polynomial.scale])

    def forms(self, low: np.ndarray, high: np.ndarray, orders: Sequence[Order]) -> list[Form]:
        """Return the forms of derivatives on boxes.

        Args:
            low: lower ends, shape (n, B).
            high: upper ends, shape (n, B).
            orders: how often each derivative is taken in each state; zeros for the polynomial.

        Returns:
            One for each order.
        """
        mid, rad = middle(low, high)
        scaled = (mid.T - self._center) / self._scale, rad.T / self._scale
        near = np.abs(scaled[0]) + scaled[1] <= _WIDEST
        far = ~np.asarray(near.all(axis=1))
        center, width = (np.where(far[:, None], 0.0, part) for part in scaled)
        reach = max(1.0, float((np.abs(center) + width).max(initial=0.0))) * MORE
        # What the scaled variables are computed from, relative to which they are rounded.
        entering = (np.abs(mid.T) + rad.T + np.abs(self._center)) / self._scale
        size = float(np.where(far[:, None], 0.0, entering).max(initial=1.0))
        count = len(center)
        expanded = _moved(
            np.broadcast_to(self._coefficients, (count, *self._coefficients.shape)), center
        )
        return [
            self._form(expanded, width, order, self._error(order, reach, size), far)
            for order in orders
        ]

    def _form(
        self, expanded: np.ndarray, width: np.ndarray, order: Order, error: float, far: np.ndarray
    ) -> Form:
        """Return the form of a derivative from the coefficients of the polynomial."""
        n, factor = len(order), 1.0
        found = expanded
        for i, times in enumerate(order):
            found = np.moveaxis(found, i + 1, -1)[..., times:]
            powers = np.arange(found.shape[-1])
            rising = np.ones(len(powers))
            for k in range(1, times + 1):
                rising *= powers + k
            steps = width[:, i, None] ** powers
            between = [1] * (found.ndim - 2)
            found = found * (rising * steps).reshape(len(width), *between, len(powers))
            found = np.moveaxis(found, -1, i + 1)
            factor /= self._scale[i] ** times
        found = found * factor
        boxes = len(width)
        center, slopes = np.zeros(boxes), np.zeros((n, boxes))
        if found.size:
            rest = found.copy()
            center = rest[(slice(None), *[0] * n)].copy()
            rest[(slice(None), *[0] * n)] = 0.0
            for i in range(n):
                if found.shape[i + 1] > 1:
                    place = (slice(None), *[int(j == i) for j in range(n)])
                    slopes[i] = rest[place]
                    rest[place] = 0.0
            size = np.abs(rest).sum(axis=tuple(range(1, n + 1)))
            # Monomials of even exponents lie in [0, 1]: half of them goes to the center.
            even = rest[(slice(None), *[slice(None, None, 2)] * n)]
            center += 0.5 * even.sum(axis=tuple(range(1, n + 1)))
            size -= 0.5 * np.abs(even).sum(axis=tuple(range(1, n + 1)))
        else:
            size = np.zeros(boxes)
        radius = np.where(far, np.inf, size * MORE + error)
        unknown = Interval(np.full(boxes, -np.inf), np.full(boxes, np.inf))
        return with_range(center, slopes, radius, unknown, np.ones(boxes, dtype=bool))

    def _error(self, order: Order, reach: float, size: float) -> float:
        """Return what rounding may have changed a derivative by on a box."""
        # Each coefficient is a sum of products of exact ones with binomials and powers, so that its
        # error is a number of units in the last place of the sum of absolute values. That sum over
        # all coefficients is the derivative of the polynomial with absolute coefficients at the
        # corner that is farthest. Errors of the scaled variables, of less than 16 units in the last
        # place of what enters, move the argument, which costs what the next derivatives bound.
        n, degrees = len(order), self._coefficients.shape
        operations = 8 * sum(degrees) + 16
        own = self._majorant(order, reach)
        nearby = [
            self._majorant(tuple(o + (i == j) for j, o in enumerate(order)), reach)
            * float(self._scale[i])
            for i in range(n)
        ]
        return _UNIT * MORE * (operations * own + 16.0 * size * sum(nearby))

    def _majorant(self, order: Order, reach: float) -> float:
        """Return the derivative of the polynomial with absolute coefficients at a corner."""
        found = np.abs(self._coefficients)
        for i in range(len(order) - 1, -1, -1):
            powers = np.arange(found.shape[i])
            falling = np.ones(len(powers))
            for k in range(order[i]):
                falling *= np.maximum(powers - k, 0)
            lowered = reach ** np.maximum(powers - order[i], 0)
            found = np.tensordot(found, falling * lowered, axes=(i, 0))
            found = found / self._scale[i] ** order[i]
        return float(found) * (1.0 + 1e-9)


def _moved(found: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Return coefficients about points from those about 0, one array of them for each point."""
    for i, z in enumerate(center.T):
        axis = np.moveaxis(found, i + 1, -1)
        shape = axis.shape
        moved = np.matmul(axis.reshape(len(z), -1, shape[-1]), _shifts(z, shape[-1]))
        found = np.moveaxis(moved.reshape(shape), -1, i + 1)
    return found


def _shifts(z: np.ndarray, count: int) -> np.ndarray:
    """Return the matrices [b, j, k] = binomial(j, k) z_b^(j - k), shape (B, count, count)."""
    j, k = np.mgrid[:count, :count]
    binomials = np.array([[float(math.comb(a, b)) for b in range(count)] for a in range(count)])
    return np.where(j >= k, binomials * z[:, None, None] ** np.maximum(j - k, 0), 0.0)
