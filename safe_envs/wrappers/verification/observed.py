"""States that were seen, held against the suprema and the shortfall that a search found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safe_envs.wrappers.verification.formulas import Formulas
from safe_envs.wrappers.verification.safe_set import in_workspace, workspace_of

_RELATIVE = 1e-6
"""What a search and rounding may leave, in parts of the number itself."""


def above_suprema(formulas: Formulas, suprema: Sequence[float], x: np.ndarray) -> str:
    """Which b_j is above its c_j at one of the states (B, n) that are in the set that the
    conditions keep, in words; or ""."""
    if formulas.certain:
        return ""  # No supremum matters there.
    b = formulas.chain(x[_inside(formulas, x)])
    for j in np.flatnonzero((b > np.array(suprema) * (1.0 + _RELATIVE)).any(axis=0)).tolist():
        return (
            f"{described(formulas, j)} reaches {b[:, j].max():.4g}, above the supremum of"
            f" {suprema[j]:.4g} that the search found"
        )
    return ""


def below_slack(formulas: Formulas, shortfall: float, x: np.ndarray, u: np.ndarray) -> str:
    """By how much actions (E, m) miss the conditions at states (E, n) of the set that is kept, if
    it is more than was found; or ""."""
    inside = _inside(formulas, x)
    if not inside.any():
        return ""
    a, b = formulas.rows(x[inside])
    moved = np.einsum("eki,ei->ek", a, u[inside])
    # Where a condition has no finite value nothing can be said of by how much it is missed.
    more = np.nan_to_num(-(moved + b) - shortfall, nan=0.0) > _RELATIVE * (
        shortfall + abs(moved) + abs(b)
    )
    if not more.any():
        return ""
    most = float(np.where(more, -(moved + b), 0.0).max())
    return (
        f"the filter missed the condition by {most:.4g}, more than the shortfall of {shortfall:.4g}"
        " that the search found"
    )


def _inside(formulas: Formulas, x: np.ndarray) -> np.ndarray:
    """Which states are in the set that is kept, and in the workspace, shape (B,)."""
    return np.all(formulas.chain(x) > 0.0, axis=1) & in_workspace(x, workspace_of(formulas.problem))


def described(formulas: Formulas, j: int) -> str:
    """What the j-th of all chain functions is called."""
    i = next(i for i, stage in enumerate(formulas.stages) if stage.start <= j < stage.stop)
    name, stage = formulas.problem.barriers[i].name, j - formulas.stages[i].start
    return (
        name if stage == 0 else f"b_{stage}" + (f" of {name}" if len(formulas.stages) > 1 else "")
    )
