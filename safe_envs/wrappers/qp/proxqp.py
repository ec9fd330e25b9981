"""Several constraints and input bounds: ProxQP for a batch, each answer checked and refined.

ProxQP's defaults return feasible points that are not the minimisers, and an infeasible problem ends
at the iteration limit. So the settings ask for the duality gap and cap the iterations. Of its
answer only the constraints and bounds that hold it are taken: the minimiser is the point of these
equations nearest to the proposal, if it meets all constraints, and if what holds it presses in the
right direction. So its precision is that of these equations, not that of the solver. States without
such a certificate, among them all with contradicting constraints, go to
`safe_envs.wrappers.qp.active_set` one by one.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

# It lives in a prefix of its own.
from proxsuite import proxqp  # pyright: ignore[reportMissingImports]

from safe_envs.wrappers.qp import active_set
from safe_envs.wrappers.qp.rounding import ROUNDING, tolerances, total

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


class Projection(NamedTuple):
    """Inputs (B, m), margins and binding constraints (B, k), and whether all can be met (B,)."""

    u: np.ndarray
    margin: np.ndarray
    active: np.ndarray
    feasible: np.ndarray


def project(
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    priority: np.ndarray,
) -> Projection:
    """Project proposed inputs, which violate a constraint, onto k constraints a u + b >= 0.

    Args:
        a: constraints, shape (B, k, m).
        b: offsets, shape (B, k).
        v: proposed inputs, shape (B, m).
        low: lower bounds, shape (B, m).
        high: upper bounds, shape (B, m).
        w: positive weights, shape (B, m).
        priority: positive weights of the squared slacks, shape (k,).

    Returns:
        The inputs, and how they meet the constraints.
    """
    problem = _Problem(a, b, v, low, high, w)
    u, certain = np.empty_like(v), np.zeros(len(v), dtype=bool)
    # ProxQP takes long to say that constraints cannot be met, and its answer is of no use then.
    left = np.flatnonzero(~problem.contradictory())
    if left.size:
        part = _Problem(*[numbers[left] for numbers in problem])
        u[left], certain[left] = part.certified(*_solve(_Scaled.of(part)))
    for i in np.flatnonzero(~certain).tolist():
        u[i] = active_set.project(a[i], b[i], v[i], low[i], high[i], w[i], priority)
    u = problem.tidied(u)
    margin, allowed = problem.margin(u), problem.tolerance(u)
    return Projection(u, margin, margin <= allowed, (margin >= -allowed).all(axis=1))


class _Problem(NamedTuple):
    """The arguments of `project`, over the batch."""

    a: np.ndarray
    b: np.ndarray
    v: np.ndarray
    low: np.ndarray
    high: np.ndarray
    w: np.ndarray

    def margin(self, u: np.ndarray) -> Any:
        """Values (B, k) of the constraints at inputs (B, m)."""
        return _dot(self.a, u) + self.b

    def tolerance(self, u: np.ndarray) -> Any:
        """By how much the constraints may miss there (B, k)."""
        return tolerances(np.moveaxis(self.a, 2, 0), self.b, u.T[:, :, None])

    def contradictory(self) -> np.ndarray:
        """Return where one or two constraints miss by more than rounding at every input (B,).

        It finds opposite constraints, not every set of constraints that cannot be met.
        """
        with np.errstate(all="ignore"):
            lengths = np.linalg.norm(self.a, axis=2)
            lengths = np.where(lengths > np.finfo(float).tiny, lengths, 1.0)
            a, b = self.a / lengths[:, :, None], self.b / lengths
            low, high = self.low[:, None, :], self.high[:, None, :]
            allowed = tolerances(
                np.moveaxis(a, 2, 0), b, np.moveaxis(np.maximum(np.abs(low), np.abs(high)), 2, 0)
            )
            first, second = np.triu_indices(a.shape[1])
            sums = a[:, first] + a[:, second]
            most = b[:, first] + b[:, second] + np.maximum(sums * low, sums * high).sum(axis=2)
            return (most < -2.0 * (allowed[:, first] + allowed[:, second])).any(axis=1)

    def tidied(self, u: np.ndarray) -> np.ndarray:
        """Return the inputs without the rounding that other inputs brought in.

        An input on which no constraint depends keeps its proposal. One that is nothing but rounding
        of the way from the proposal is 0, for a constraint of this input alone may ask for that.
        """
        roots, start = np.sqrt(self.w), np.clip(self.v, self.low, self.high)
        way = (np.abs(u - self.v) * roots).max(axis=1, keepdims=True)
        u = np.where(np.abs(u) <= ROUNDING * way / roots, np.clip(0.0, self.low, self.high), u)
        return np.where((self.a == 0.0).all(axis=1), start, u)

    def certified(
        self, rows: np.ndarray, below: np.ndarray, above: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the minimisers (B, m) that some constraints (B, k) and bounds (B, m) hold.

        Returns:
            These, and where they are those of the whole problem (B,).
        """
        roots, held = np.sqrt(self.w), below | above
        normals = self.a / roots[:, None, :]
        lengths = np.abs(normals).max(axis=2)
        lengths = np.where(lengths > 0.0, lengths, 1.0)
        normals = normals / lengths[:, :, None]
        working: Any = np.where(rows[:, :, None] & ~held[:, None, :], normals, 0.0)
        usable = np.isfinite(working).all(axis=(1, 2))
        inverse = np.linalg.pinv(np.where(usable[:, None, None], working, 0.0))
        u = np.where(below, self.low, np.where(above, self.high, self.v))
        # The second time takes back the rounding of a long way.
        for _ in range(2):
            u = u - _dot(inverse, np.where(rows, self.margin(u) / lengths, 0.0)) / roots
        u = self.tidied(np.clip(u, self.low, self.high))
        way = (u - self.v) * roots
        pressures = _dot(np.swapaxes(inverse, 1, 2), np.where(held, 0.0, way))
        rest = way - _dot(np.swapaxes(normals, 1, 2), np.where(rows, pressures, 0.0))
        rest = np.where(below, np.minimum(rest, 0.0), np.where(above, np.maximum(rest, 0.0), rest))
        nothing = ROUNDING * np.abs(way).max(axis=1)
        pressed = (np.abs(rest).max(axis=1) <= nothing) & (pressures >= -nothing[:, None]).all(
            axis=1
        )
        margin, allowed = self.margin(u), self.tolerance(u)
        met = (margin >= -allowed) & (~rows | (margin <= allowed))
        return u, usable & pressed & met.all(axis=1)


def _dot(a: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return products (B, k) of constraints (B, k, m) and inputs (B, m).

    The order of summation does not depend on the batch.
    """
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
    def of(cls, problem: _Problem) -> _Scaled:
        a, b, v, low, high, w = problem
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
