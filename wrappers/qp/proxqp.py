"""Several constraint rows and a box: ProxQP, batched, and never wrong silently.

ProxQP's defaults return feasible points that are not the minimisers, and an infeasible problem ends at the iteration
limit. So the settings ask for the duality gap and cap the iterations, and every answer is checked against the rows. What
is left is solved in two exact steps, which serve contradicting rows too: the smallest sum of squared slacks first, then
the action nearest to the proposed one that needs no more than these.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import qpsolvers
from proxsuite import proxqp  # pyright: ignore[reportMissingImports]  (it lives in a prefix of its own)

from wrappers.qp.bounded_least_squares import least_violating
from wrappers.qp.rows import total

_PRECISION = {"eps_abs": 1e-9, "eps_rel": 0.0, "check_duality_gap": True, "eps_duality_gap_abs": 1e-9}
_SETTINGS = {**_PRECISION, "eps_primal_inf": 1e-14, "max_iter": 200, "max_iter_in": 50}
_INFINITY = 1e20
_ACCEPTED = 1e-7
"""Largest violation of a normalised row that counts as met: a hundred times what the solver is asked for."""
_WIDE = 1e3
"""A box that reaches this many times further than the violated rows is too wide to be a unit of length."""
_REACH = 10.0
"""The unit then, in ways to the violated rows."""


class Projection(NamedTuple):
    """Arrays over a batch of B states: inputs (B, m), margins and binding rows (B, k), whether all can be met (B,)."""

    u: np.ndarray
    margin: np.ndarray
    active: np.ndarray
    feasible: np.ndarray


def project(
    a: np.ndarray, b: np.ndarray, v: np.ndarray, low: np.ndarray, high: np.ndarray, w: np.ndarray, priority: np.ndarray
) -> Projection:
    """Project proposed inputs onto k rows a u + b >= 0 and a box.

    Args:
        a: rows, shape (B, k, m).
        b: offsets, shape (B, k).
        v: proposed inputs, shape (B, m).
        low: lower bounds, shape (B, m).
        high: upper bounds, shape (B, m).
        w: positive weights, shape (B, m).
        priority: positive weights of the squared slacks, shape (k,).
    """
    u = np.clip(v, low, high)
    margin = _dot(a, u) + b
    feasible = np.ones(len(u), dtype=bool)
    active = np.zeros(margin.shape, dtype=bool)
    acting = np.flatnonzero((margin < 0.0).any(axis=1))
    if acting.size:
        scaled = _Scaled.of(a[acting], b[acting], v[acting], low[acting], high[acting], w[acting])
        z, met = scaled.solve(priority)
        feasible[acting] = met
        u[acting] = np.clip(scaled.center + scaled.half * z, low[acting], high[acting])
        margin[acting] = _dot(a[acting], u[acting]) + b[acting]
        active[acting] = margin[acting] <= _ACCEPTED * scaled.lengths
    return Projection(u, margin, active, feasible)


def _dot(a: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Products (B, k) of rows (B, k, m) and inputs (B, m), summed in an order that does not depend on the batch."""
    return total(np.moveaxis(a * u[:, None, :], 2, 0))


def _units(a: np.ndarray, b: np.ndarray, v: np.ndarray, low: np.ndarray, high: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origin and unit of each input (B, m): those of the box, or of the way to the violated rows where the box is too wide."""
    inside = np.clip(v, low, high)
    missed = np.maximum(-(_dot(a, inside) + b), 0.0)
    steepness = np.sqrt((a**2 / w[:, None, :]).sum(axis=2))
    way = np.divide(missed, steepness, out=np.zeros_like(missed), where=steepness > 0.0).max(axis=1)
    way = way[:, None] / np.sqrt(w)
    half = 0.5 * high - 0.5 * low
    wide = (half > _WIDE * way) & (way > 0.0)
    return np.where(wide, inside, 0.5 * low + 0.5 * high), np.where(wide, _REACH * way, half)


class _Scaled(NamedTuple):
    """The problem in z = (u - center) / half, with z of order one and rows of unit length."""

    rows: np.ndarray
    offsets: np.ndarray
    lengths: np.ndarray
    target: np.ndarray
    curvature: np.ndarray
    center: np.ndarray
    half: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, a: np.ndarray, b: np.ndarray, v: np.ndarray, low: np.ndarray, high: np.ndarray, w: np.ndarray) -> _Scaled:
        center, half = _units(a, b, v, low, high, w)
        rows = a * half[:, None, :]
        offsets = b + _dot(a, center)
        lengths = np.linalg.norm(rows, axis=2)
        # A flat row says nothing of the input: its offset alone decides, in its own units.
        lengths = np.where(lengths > np.finfo(float).tiny, lengths, np.maximum(np.abs(offsets), 1.0))
        curvature = w * half**2
        return cls(
            rows / lengths[:, :, None],
            offsets / lengths,
            lengths,
            (v - center) / half,
            curvature / curvature.max(axis=1, keepdims=True),
            center,
            half,
            np.maximum((low - center) / half, -_INFINITY),
            np.minimum((high - center) / half, _INFINITY),
        )

    def solve(self, priority: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Minimisers (B, m), and whether the rows are met (B,)."""
        z, met = self._in_batch()
        for i in np.flatnonzero(~met).tolist():
            # Slacks count in the rows' own units.
            weights = priority * (self.lengths[i] / self.lengths[i].max()) ** 2
            least = least_violating(self.rows[i], self.offsets[i], self.low[i], self.high[i], weights)
            slack = np.maximum(-(self.rows[i] @ least + self.offsets[i]), 0.0)
            nearest = self._nearest(i, slack + _ACCEPTED)
            z[i] = least if nearest is None else nearest
            # Without a certified minimiser the rows may be met, but the step is flagged all the same.
            met[i] = nearest is not None and bool((slack <= _ACCEPTED).all())
        return z, met

    def _in_batch(self) -> tuple[np.ndarray, np.ndarray]:
        count, k, m = self.rows.shape
        batch = proxqp.dense.BatchQP(count)
        for i in range(count):
            qp = batch.init_qp_in_place(m, 0, k + m)
            for name, value in _SETTINGS.items():
                setattr(qp.settings, name, value)
            rows = np.vstack([self.rows[i], np.eye(m)])
            lower, upper = np.concatenate([-self.offsets[i], self.low[i]]), np.concatenate([np.full(k, _INFINITY), self.high[i]])
            qp.init(*self._objective(i), None, None, rows, lower, upper)
        proxqp.dense.solve_in_parallel(batch, 1)
        z, met = np.zeros((count, m)), np.zeros(count, dtype=bool)
        for i in range(count):
            results = batch.get(i).results
            if results.info.status == proxqp.PROXQP_SOLVED and self._meets(i, results.x, 0.0):
                z[i], met[i] = results.x, True
        return z, met

    def _objective(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Hessian and gradient, scaled down where the proposal lies far outside the box."""
        size = max(1.0, float(np.abs(self.target[i]).max()))
        return np.diag(self.curvature[i] / size), -self.curvature[i] * self.target[i] / size

    def _meets(self, i: int, z: np.ndarray, slack: np.ndarray | float) -> bool:
        rows_met = self.rows[i] @ z + self.offsets[i] + slack >= -_ACCEPTED
        return bool(rows_met.all() and (z >= self.low[i] - _ACCEPTED).all() and (z <= self.high[i] + _ACCEPTED).all())

    def _nearest(self, i: int, slack: np.ndarray) -> np.ndarray | None:
        """The minimiser with the rows relaxed until they can be met, without a guess; None where it is not found."""
        problem = qpsolvers.Problem(*self._objective(i), -self.rows[i], self.offsets[i] + slack, lb=self.low[i], ub=self.high[i])
        solution = qpsolvers.solve_problem(problem, solver="proxqp", initial_guess=proxqp.NO_INITIAL_GUESS, **_PRECISION)
        z = solution.x
        return z if solution.found and z is not None and self._meets(i, z, slack) else None
