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
import scipy.optimize
from proxsuite import proxqp  # pyright: ignore[reportMissingImports]  (it lives in a prefix of its own)

_PRECISION = {"eps_abs": 1e-9, "eps_rel": 0.0, "check_duality_gap": True, "eps_duality_gap_abs": 1e-9}
_SETTINGS = {**_PRECISION, "eps_primal_inf": 1e-14, "max_iter": 200, "max_iter_in": 50}
_INFINITY = 1e20
_ACCEPTED = 1e-7
"""Largest violation of a normalised row that counts as met: a hundred times what the solver is asked for."""


class Projection(NamedTuple):
    """Arrays over a batch of B states: inputs (B, m), margins and binding rows (B, k), whether all can be met (B,)."""

    u: np.ndarray
    margin: np.ndarray
    active: np.ndarray
    feasible: np.ndarray


def project(a: np.ndarray, b: np.ndarray, v: np.ndarray, low: np.ndarray, high: np.ndarray, w: np.ndarray) -> Projection:
    """Project proposed inputs onto k rows a u + b >= 0 and a box.

    Args:
        a: rows, shape (B, k, m).
        b: offsets, shape (B, k).
        v: proposed inputs, shape (B, m).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        w: positive weights, shape (m,).
    """
    u = np.clip(v, low, high)
    margin = (a @ u[:, :, None])[:, :, 0] + b
    feasible = np.ones(len(u), dtype=bool)
    active = np.zeros(margin.shape, dtype=bool)
    acting = np.flatnonzero((margin < 0.0).any(axis=1))
    if acting.size:
        scaled = _Scaled.of(a[acting], b[acting], v[acting], low, high, w)
        z, met = scaled.solve()
        feasible[acting] = met
        u[acting] = np.clip(scaled.center + scaled.half * z, low, high)
        margin[acting] = (a[acting] @ u[acting][:, :, None])[:, :, 0] + b[acting]
        active[acting] = margin[acting] <= _ACCEPTED * scaled.lengths
    return Projection(u, margin, active, feasible)


class _Scaled(NamedTuple):
    """The problem in z = (u - center) / half, with the box [-1, 1] and rows of unit length."""

    rows: np.ndarray
    offsets: np.ndarray
    lengths: np.ndarray
    target: np.ndarray
    hessian: np.ndarray
    center: np.ndarray
    half: np.ndarray

    @classmethod
    def of(cls, a: np.ndarray, b: np.ndarray, v: np.ndarray, low: np.ndarray, high: np.ndarray, w: np.ndarray) -> _Scaled:
        center, half = 0.5 * (low + high), 0.5 * (high - low)
        rows = a * half
        offsets = b + a @ center
        lengths = np.linalg.norm(rows, axis=2)
        # A flat row says nothing of the input: its offset alone decides, in its own units.
        lengths = np.where(lengths > np.finfo(float).tiny, lengths, np.maximum(np.abs(offsets), 1.0))
        curvature = w * half**2
        return cls(
            rows / lengths[:, :, None], offsets / lengths, lengths, (v - center) / half, np.diag(curvature / curvature.max()), center, half
        )

    def solve(self) -> tuple[np.ndarray, np.ndarray]:
        """Minimisers (B, m), and whether the rows are met (B,)."""
        z, met = self._in_batch()
        for i in np.flatnonzero(~met).tolist():
            least = self._least_violating(i)
            slack = np.maximum(-(self.rows[i] @ least + self.offsets[i]), 0.0)
            nearest = self._nearest(i, slack + _ACCEPTED)
            z[i] = least if nearest is None else nearest
            # Without a certified minimiser the rows may be met, but the step is flagged all the same.
            met[i] = nearest is not None and bool((slack <= _ACCEPTED).all())
        return z, met

    def _in_batch(self) -> tuple[np.ndarray, np.ndarray]:
        count, k, m = self.rows.shape
        batch = proxqp.dense.BatchQP(count)
        upper = np.concatenate([np.full(k, _INFINITY), np.ones(m)])
        for i in range(count):
            qp = batch.init_qp_in_place(m, 0, k + m)
            for name, value in _SETTINGS.items():
                setattr(qp.settings, name, value)
            rows = np.vstack([self.rows[i], np.eye(m)])
            lower = np.concatenate([-self.offsets[i], -np.ones(m)])
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
        return self.hessian / size, -self.hessian @ self.target[i] / size

    def _meets(self, i: int, z: np.ndarray, slack: np.ndarray | float) -> bool:
        rows_met = self.rows[i] @ z + self.offsets[i] + slack >= -_ACCEPTED
        return bool(rows_met.all() and (np.abs(z) <= 1.0 + _ACCEPTED).all())

    def _nearest(self, i: int, slack: np.ndarray) -> np.ndarray | None:
        """The minimiser with the rows relaxed until they can be met, without a guess; None where it is not found."""
        bound = np.ones(self.half.size)
        problem = qpsolvers.Problem(*self._objective(i), -self.rows[i], self.offsets[i] + slack, lb=-bound, ub=bound)
        solution = qpsolvers.solve_problem(problem, solver="proxqp", initial_guess=proxqp.NO_INITIAL_GUESS, **_PRECISION)
        z = solution.x
        return z if solution.found and z is not None and self._meets(i, z, slack) else None

    def _least_violating(self, i: int) -> np.ndarray:
        """An action of least sum of squared slacks, these in the rows' own units.

        With p the positive and s the negative part of a row's margin, min |rows z + offsets - p|^2 over z in the box and
        p >= 0 leaves s as the residual: a bounded least-squares problem, which BVLS solves exactly.
        """
        k, m = self.rows.shape[1:]
        units = (self.lengths[i] / self.lengths[i].max())[:, None]
        matrix = units * np.hstack([self.rows[i], -np.eye(k)])
        low, high = np.concatenate([-np.ones(m), np.zeros(k)]), np.concatenate([np.ones(m), np.full(k, np.inf)])
        fit = scipy.optimize.lsq_linear(matrix, -units[:, 0] * self.offsets[i], (low, high), method="bvls", tol=1e-14)
        return np.clip(fit.x[:m], -1.0, 1.0)
