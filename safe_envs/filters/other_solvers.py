"""The QP of a filter by the solvers that qpsolvers knows, for comparison with our own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.errors import ConfigurationError, nearest

TOLERANCE = 1e-8
"""Part of the terms of a constraint by which these solvers may violate it, and say it is met."""

BINDING = 1e-4
"""Part of its terms below which the value of a constraint is taken for 0: it binds."""

_SETTINGS: dict[str, dict[str, Any]] = {
    "proxqp": {"eps_abs": 1e-10},
    "daqp": {"primal_tol": 1e-10, "dual_tol": 1e-10},
}
"""Of solvers whose own tolerances are wider."""


def require_solver(solver: str) -> None:
    """Raise ConfigurationError unless a QP solver is installed.

    Args:
        solver: one of `qpsolvers.available_solvers`, such as "proxqp".
    """
    import qpsolvers

    known = qpsolvers.available_solvers
    if solver not in known:
        raise ConfigurationError(
            f"solver = {solver!r} is not installed; {nearest(str(solver), known)}"
        )


def solve_with(
    solver: str,
    rows: np.ndarray,
    proposed: Sequence[float],
    ends: Sequence[float],
    weights: Sequence[float],
) -> tuple[list[float], bool]:
    """Return the input that is nearest to a proposed one, and whether all constraints are met.

    Where they cannot be met together, the sum of their squared slacks, times the priorities, is as
    small as can be, and the input is the nearest of those.

    Args:
        solver: one of `qpsolvers.available_solvers`.
        rows: coefficients and offset of each constraint a . u + b >= 0, shape (k, m + 1).
        proposed: input (m).
        ends: m lower and m upper bounds.
        weights: of the inputs (m) and priorities (k).

    Raises:
        ConfigurationError: The solver finds no answer.
    """
    m, k = len(proposed), len(rows)
    a, b = rows[:, :m], rows[:, m]
    low, high = np.array(ends[:m]), np.array(ends[m:])
    near = np.array(weights[:m]), np.array(proposed)

    def met_at(u: np.ndarray) -> bool:
        return bool((a @ u + b >= -TOLERANCE * (abs(a) @ abs(u) + abs(b))).all())

    u = _solve(solver, *near, -a, b, low, high)
    feasible = u is not None and met_at(u)
    if not feasible:
        # With the slacks as inputs of their own, which bounds of the constraints allow.
        both, nothing = np.concatenate([np.zeros(m), weights[m:]]), np.zeros(m + k)
        wide = [np.concatenate(part) for part in ((low, np.zeros(k)), (high, np.full(k, np.inf)))]
        least = _solve(solver, both, nothing, np.hstack([-a, -np.eye(k)]), b, *wide)
        if least is None:
            raise ConfigurationError(
                f"solver = {solver!r} finds no answer for the constraints {rows.tolist()}; take"
                " another one, or none"
            )
        terms = abs(a) @ (1.0 + abs(least[:m])) + abs(b)
        slack = np.maximum(least[m:], 0.0) + TOLERANCE * terms
        closest = _solve(solver, *near, -a, b + slack, low, high)
        u = least[:m] if closest is None else closest
        # A solver may find no answer at first, and yet there is one without slacks.
        feasible = met_at(np.clip(least[:m], low, high))
    assert u is not None
    return np.clip(u, low, high).tolist(), feasible


def _solve(solver: str, w: Any, v: Any, g: Any, h: Any, low: Any, high: Any) -> np.ndarray | None:
    """Minimise 1/2 sum_j w_j (u_j - v_j)^2 subject to g u <= h within bounds."""
    import qpsolvers

    problem = qpsolvers.Problem(np.diag(w), -w * v, g, h, lb=low, ub=high)
    found = qpsolvers.solve_problem(problem, solver=solver, **_SETTINGS.get(solver, {}))
    x = found.x if found.found else None
    return x if x is not None and np.isfinite(x).all() else None
