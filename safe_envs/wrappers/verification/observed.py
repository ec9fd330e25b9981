"""States that were seen, compared with the suprema and the shortfall that a search found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safe_envs.wrappers.verification.formulas import Formulas
from safe_envs.wrappers.verification.safe_set import in_workspace, workspace_of

RELATIVE = 1e-6
"""Error that a search and rounding may leave, in parts of the number itself."""


def above_suprema(formulas: Formulas, suprema: Sequence[float], x: np.ndarray) -> str:
    """Say which b_j is above its c_j at a state of the invariant set; "" if none is.

    Args:
        formulas: of the chains.
        suprema: c_j of each chain function.
        x: states (B, n), those outside the set or the workspace among them.

    Returns:
        A text.
    """
    if formulas.certain:
        return ""  # No supremum matters there.
    b = formulas.chain(x[_inside(formulas, x)])
    for j in np.flatnonzero((b > np.array(suprema) * (1.0 + RELATIVE)).any(axis=0)).tolist():
        return reaches(formulas.names[j], float(b[:, j].max()), suprema[j])
    return ""


def above_shortfall(formulas: Formulas, shortfall: float, x: np.ndarray, u: np.ndarray) -> str:
    """Say by how much actions violate the conditions, if by more than was found; "" if not.

    Args:
        formulas: of the conditions.
        shortfall: the largest one that a search found.
        x: states (E, n); those outside the invariant set do not count.
        u: actions (E, m).

    Returns:
        A text.
    """
    inside = _inside(formulas, x)
    if not inside.any():
        return ""
    a, b = formulas.constraints_at(x[inside])
    moved = np.einsum("eki,ei->ek", a, u[inside])
    # Where a condition has no finite value nothing can be said of by how much it is violated.
    more = np.nan_to_num(-(moved + b) - shortfall, nan=0.0) > RELATIVE * (
        shortfall + abs(moved) + abs(b)
    )
    return violated_by(float(np.where(more, -(moved + b), 0.0).max()), shortfall) * bool(more.any())


def reaches(name: str, value: float, supremum: float) -> str:
    """Say that a function is above its supremum.

    Args:
        name: of the function.
        value: that it has.
        supremum: that a search found.

    Returns:
        A text.
    """
    return f"{name} reaches {value:.4g}, above the supremum of {supremum:.4g} that the search found"


def violated_by(most: float, shortfall: float) -> str:
    """Say that a filter violated its condition by more than the shortfall.

    Args:
        most: by how much, in the units of b_(r-1) per s.
        shortfall: that a search found.

    Returns:
        A text.
    """
    return (
        f"the filter violated the condition by {most:.4g}, more than the shortfall of"
        f" {shortfall:.4g} that the search found"
    )


def _inside(formulas: Formulas, x: np.ndarray) -> np.ndarray:
    """Return which states are in the invariant set and in the workspace, shape (B,)."""
    return np.all(formulas.chain(x) > 0.0, axis=1) & in_workspace(x, workspace_of(formulas.problem))
