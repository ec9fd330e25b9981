"""The points that working sets hold, and the proofs that they are the answers, for a batch.

As `safe_envs.wrappers.qp.working_set`, with arrays whose last axis is the batch. A working set is a
mask (k, B) of constraints, and -1 for inputs at the lower, 1 at the upper bound, else 0 (m, B).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from safe_envs.wrappers.qp.rounding import ROUNDING, total
from safe_envs.wrappers.qp.working_set import SURELY

_NOTHING = 1e-12
"""Part of the forces on an input that is rounding."""
_CORRECTIONS = 3
"""How often a point is found: the later times take back the rounding of a long way."""
_DEPENDENT = 1e-14
"""Part of a unit normal that the rounding of others leaves of it."""


class ArrayQP(NamedTuple):
    """QPs over a batch of B states, with constraints that may say nothing of the input.

    Attributes:
        a: constraints, shape (k, m, B).
        b: offsets, shape (k, B).
        v: proposed inputs, shape (m, B).
        low: lower bounds, shape (m, B).
        high: upper bounds, shape (m, B).
        roots: of the weights, shape (m, B).
        priority: positive weights of the squared slacks, shape (k, 1).
        normals: constraints of unit length in inputs times roots, shape (k, m, B).
        lengths: of the constraints, 1 for those that say nothing, shape (k, B).
    """

    a: np.ndarray
    b: np.ndarray
    v: np.ndarray
    low: np.ndarray
    high: np.ndarray
    roots: np.ndarray
    priority: np.ndarray
    normals: np.ndarray
    lengths: np.ndarray

    @classmethod
    def of(
        cls,
        a: np.ndarray,
        b: np.ndarray,
        v: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
        w: np.ndarray,
        priority: np.ndarray,
    ) -> ArrayQP:
        """Return the QPs.

        Args:
            a: constraints, shape (k, m, B).
            b: offsets, shape (k, B).
            v: proposed inputs, shape (m, B).
            low: lower bounds, shape (m, B).
            high: upper bounds, shape (m, B).
            w: positive weights of the inputs, shape (m, B).
            priority: positive weights of the squared slacks, shape (k, 1).
        """
        roots = np.sqrt(w)
        normals = a / roots
        sizes = np.abs(normals).max(axis=1)
        sizes[sizes == 0.0] = 1.0
        normals /= sizes[:, None]  # so that squares neither overflow nor vanish
        lengths = np.sqrt(total(np.swapaxes(normals * normals, 0, 1)))
        lengths[lengths == 0.0] = 1.0
        normals /= lengths[:, None]
        return cls(a, b, v, low, high, roots, priority, normals, lengths * sizes)

    def take(self, states: np.ndarray) -> ArrayQP:
        """Return the QPs of some states."""
        a, b, v, low, high, roots, _, normals, lengths = [
            part if part is self.priority else part[..., states] for part in self
        ]
        return ArrayQP(a, b, v, low, high, roots, self.priority, normals, lengths)

    def margins(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the margins (k, B) at inputs (m, B), and their rounding."""
        products = np.swapaxes(self.a * u, 0, 1)
        margin = total(products) + self.b
        np.abs(products, out=products)
        return margin, ROUNDING * (total(products) + np.abs(self.b))


class Points(NamedTuple):
    """Inputs (m, B), margins and their rounding (k, B), and which inputs are proved (B,)."""

    u: np.ndarray
    margin: np.ndarray
    allowed: np.ndarray
    proved: np.ndarray


def find_points(p: ArrayQP, rows: np.ndarray, at: np.ndarray) -> Points:
    """Return the points of working sets.

    Args:
        p: the QPs.
        rows: constraints that count, shape (k, B).
        at: bounds that hold the inputs, shape (m, B).
    """
    free = at == 0
    u = np.where(free, p.v, np.where(at < 0, p.low, p.high))
    fit = _Fit(np.where(rows[:, None] & free, p.normals, 0.0), rows, p)
    for _ in range(_CORRECTIONS):
        gaps = np.where(rows, (total(np.swapaxes(p.a * u, 0, 1)) + p.b) / p.lengths, 0.0)
        steps = fit.steps(gaps) / p.roots
        u = u - steps
        if (np.abs(steps) <= ROUNDING * np.abs(u)).all():
            break
    way = (u - p.v) * p.roots
    nothing = ROUNDING * np.abs(way).max(axis=0)
    u = np.where(free & (np.abs(u) * p.roots <= nothing), 0.0, u)
    inside = np.minimum(np.maximum(u, p.low), p.high)
    doubt = np.maximum(nothing / p.roots, ROUNDING * np.abs(inside))
    proved: Any = (np.abs(u - inside) <= doubt).all(axis=0)
    u = inside
    way = (u - p.v) * p.roots
    margin, allowed = p.margins(u)
    pressures = fit.pressures(np.where(free, way, 0.0))
    missed = margin < -SURELY * allowed
    proved &= np.where(
        rows, missed | ((pressures >= -nothing) & (margin <= allowed)), margin >= -allowed
    ).all(axis=0)
    proved &= missed.any(axis=0) | (margin >= -allowed).all(axis=0)
    # Over the steepest, so that small forces do not vanish.
    unit = np.where(missed, p.lengths, 0.0).max(axis=0)
    unit = np.where(unit > 0.0, unit, 1.0)
    parts = p.a * np.where(missed, p.priority * (-margin / unit), 0.0)[:, None]
    force, doubt = total(parts), _NOTHING * total(np.abs(parts))
    rest = way - total(p.normals * pressures[:, None])
    outwards = force * at
    presses = (outwards > doubt) | ((outwards >= -doubt) & (rest * at <= nothing))
    balanced: Any = np.where(free, np.abs(force) <= doubt, presses).all(axis=0)
    close = (proved & ~balanced).nonzero()[0]
    if close.size:  # then the rounding of the slacks counts, too
        errors = np.where(missed, p.priority * allowed, 0.0)[:, close] / unit[close]
        unsure = doubt[:, close] + total(np.abs(p.a[..., close]) * errors[:, None])
        balanced[close] = np.where(
            free[:, close], np.abs(force[:, close]) <= unsure, presses[:, close]
        ).all(axis=0)
    proved &= balanced
    return Points(u, margin, allowed, proved)


class _Fit:
    """Normals as sums of an orthonormal basis, and the least squares fit of their coordinates.

    Args:
        normals: of constraints that count along free inputs, else 0, shape (k, m, B).
        rows: constraints that count, shape (k, B).
        p: the QPs.
    """

    def __init__(self, normals: np.ndarray, rows: np.ndarray, p: ArrayQP) -> None:
        k, m, size = normals.shape
        basis, coordinates = np.zeros((m, m, size)), np.zeros((m, k, size))
        rank = np.zeros(size, dtype=np.intp)
        every = np.arange(size)
        for i in range(k):
            rest, most = normals[i], min(i, m)
            for _ in range(2):  # the second time takes back the rounding of the first
                for c in range(most):
                    share = total(basis[c] * rest)
                    rest = rest - share * basis[c]
                    coordinates[c, i] += share
            left = np.sqrt(total(rest * rest))
            new = (left > _DEPENDENT) & (rank < m)
            if i == 0:
                left = np.where(new, left, 1.0)
                basis[0], coordinates[0, 0] = (
                    np.where(new, rest / left, 0.0),
                    np.where(new, left, 0.0),
                )
            else:
                places, states = rank[new], every[new]
                basis[places, :, states] = (rest[:, new] / left[new]).T
                coordinates[places, i, states] = left[new]
            rank += new
        sizes = np.sqrt(p.priority) * p.lengths
        sizes = np.where(rows, sizes, 0.0)
        largest = sizes.max(axis=0)
        whole = rank == np.count_nonzero(rows, axis=0)
        self._weights = np.where(whole, 1.0, sizes / np.where(largest > 0.0, largest, 1.0))
        self._basis = basis
        self._most = most = min(k, m)
        self._fits = coordinates[:most] * self._weights
        self._triangle = np.zeros((most, most, size))
        for c in range(most):
            column = self._fits[c]
            for _ in range(2):
                for d in range(c):
                    share = total(self._fits[d] * column)
                    column = column - share * self._fits[d]
                    self._triangle[d, c] += share
            left = np.sqrt(total(column * column))
            left[left == 0.0] = 1.0
            self._fits[c] = column / left
            self._triangle[c, c] = left

    def steps(self, gaps: np.ndarray) -> np.ndarray:
        """Return the shortest steps (m, B) that fit gaps (k, B) best."""
        scaled = gaps * self._weights
        found = [total(self._fits[c] * scaled) for c in range(self._most)]
        for c in range(self._most - 1, -1, -1):
            found[c] = found[c] / self._triangle[c, c]
            for d in range(c):
                found[d] = found[d] - self._triangle[d, c] * found[c]
        step = found[0] * self._basis[0]
        for c in range(1, self._most):
            step += found[c] * self._basis[c]
        return step

    def pressures(self, way: np.ndarray) -> np.ndarray:
        """Return the least factors (k, B) with which normals make up ways (m, B) in their span."""
        found = [total(self._basis[c] * way) for c in range(self._most)]
        result = np.zeros_like(self._weights)
        for c in range(self._most):
            for d in range(c):
                found[c] = found[c] - self._triangle[d, c] * found[d]
            found[c] = found[c] / self._triangle[c, c]
            result += found[c] * self._fits[c]
        return result * self._weights
