"""Working sets that ProxQP, an augmented-Lagrangian solver in C++, proposes for a batch.

A second opinion: its answers have the precision of its settings, so that of these only the
constraints and bounds that hold them are taken. Its defaults return feasible points that are not
the minimisers, and a QP with contradicting constraints ends at the iteration limit. So the settings
ask for the duality gap and cap the iterations.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# It lives in a prefix of its own.
from proxsuite import proxqp  # pyright: ignore[reportMissingImports]

from safe_envs.engine.qp.rounding import total
from safe_envs.engine.qp.working_set import ArrayQP

_PRECISION = {
    "eps_abs": 1e-9,
    "eps_rel": 0.0,
    "check_duality_gap": True,
    "eps_duality_gap_abs": 1e-9,
}
_SETTINGS = {**_PRECISION, "eps_primal_inf": 1e-14, "max_iter": 200, "max_iter_in": 50}
_INFINITY = 1e20
_PRESSES = 1e-7
"""The constraint or bound of a multiplier binds from this share of the largest."""
_WIDE = 1e3
"""A box that reaches this many times further than the violated constraints is too wide to be a unit
of length."""
_REACH = 10.0
"""The unit then, in ways to the violated constraints."""


def propose(p: ArrayQP) -> tuple[np.ndarray, np.ndarray]:
    """Return the constraints (k, B) that count and the bounds (m, B) that hold the inputs.

    Where the constraints contradict each other, they are of no use.

    Args:
        p: the QPs.
    """
    of_state = [np.moveaxis(part, -1, 0) for part in (p.a, p.b, p.v, p.low, p.high, p.roots**2)]
    rows, below, above = _solve(_Scaled.of(*of_state))
    return rows.T, np.where(below, -1.0, np.where(above, 1.0, 0.0)).T


def _dot(a: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return products (B, k) of constraints (B, k, m) and inputs (B, m)."""
    return total(np.moveaxis(a * u[:, None, :], 2, 0))


def _units(
    a: np.ndarray, b: np.ndarray, v: np.ndarray, low: np.ndarray, high: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the origin and the unit of each input (B, m).

    They are those of the input bounds, or of the way to the violated constraints where the bounds
    are too wide.
    """
    inside = np.clip(v, low, high)
    missed = np.maximum(-(_dot(a, inside) + b), 0.0)
    steepness = np.sqrt((a**2 / w[:, None, :]).sum(axis=2))
    way = np.divide(missed, steepness, out=np.zeros_like(missed), where=steepness > 0.0).max(axis=1)
    way = way[:, None] / np.sqrt(w)
    half = 0.5 * high - 0.5 * low
    wide = (half > _WIDE * way) & (way > 0.0)
    return np.where(wide, inside, 0.5 * low + 0.5 * high), np.where(wide, _REACH * way, half)


class _Scaled(NamedTuple):
    """The problem in z = (u - center) / half, with constraints of unit length."""

    rows: np.ndarray
    offsets: np.ndarray
    target: np.ndarray
    curvature: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(
        cls,
        a: np.ndarray,
        b: np.ndarray,
        v: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
        w: np.ndarray,
    ) -> _Scaled:
        center, half = _units(a, b, v, low, high, w)
        rows = a * half[:, None, :]
        offsets = b + _dot(a, center)
        lengths = np.linalg.norm(rows, axis=2)
        # A flat constraint says nothing of the input: its offset alone decides, in its own units.
        lengths = np.where(
            lengths > np.finfo(float).tiny, lengths, np.maximum(np.abs(offsets), 1.0)
        )
        curvature = w * half**2
        return cls(
            rows / lengths[:, :, None],
            offsets / lengths,
            (v - center) / half,
            curvature / curvature.max(axis=1, keepdims=True),
            np.maximum((low - center) / half, -_INFINITY),
            np.minimum((high - center) / half, _INFINITY),
        )

    def objective(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Return Hessian and gradient, scaled down where the proposal lies far outside."""
        size = max(1.0, float(np.abs(self.target[i]).max()))
        return np.diag(self.curvature[i] / size), -self.curvature[i] * self.target[i] / size


def _solve(scaled: _Scaled) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the constraints (B, k) and bounds (B, m) that hold the minimisers, by ProxQP."""
    count, k, m = scaled.rows.shape
    # The solver does not come back from numbers that are not finite.
    solvable = np.flatnonzero(
        np.all([np.isfinite(part).reshape(count, -1).all(axis=1) for part in scaled], axis=0)
    ).tolist()
    batch = proxqp.dense.BatchQP(len(solvable))
    for i in solvable:
        qp = batch.init_qp_in_place(m, 0, k + m)
        for name, value in _SETTINGS.items():
            setattr(qp.settings, name, value)
        rows = np.vstack([scaled.rows[i], np.eye(m)])
        lower = np.concatenate([-scaled.offsets[i], scaled.low[i]])
        qp.init(
            *scaled.objective(i),
            None,
            None,
            rows,
            lower,
            np.concatenate([np.full(k, _INFINITY), scaled.high[i]]),
        )
    proxqp.dense.solve_in_parallel(batch, 1)
    pressures = np.zeros((count, k + m))
    for place, i in enumerate(solvable):
        pressures[i] = batch.get(place).results.z
    share = _PRESSES * np.abs(pressures).max(axis=1, keepdims=True)
    return (pressures < -share)[:, :k], (pressures < -share)[:, k:], (pressures > share)[:, k:]
