"""Claims that hold without any room, as equalities at the center of psi.

Let e be a claim with fixed inputs. If e and its gradient are exactly 0 at the center, and the
matrix of its second derivatives is positive semidefinite around it (by the circles of Gershgorin),
then e >= 0 there, by Taylor's theorem. No bisection shows that.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.wrappers.certificates.certificate import BarrierCertificate
from safe_envs.wrappers.certificates.claims import Statement

_LARGEST_DEGREE = 6
_MOST_STATES = 4
_MOST_INPUTS = 3
_MOST_OPERATIONS = 500
_HALVINGS = 20

Enclose = Callable[[sp.Expr, np.ndarray, np.ndarray], tuple[float, float]]
"""From an expression of the states, a center and radii to the ends of what it is there."""


def proved_around(
    statement: Statement,
    certificate: BarrierCertificate,
    psi: dict[Any, sp.Symbol],
    enclose: Enclose,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return a box of states around the center of psi on which a claim holds.

    Args:
        statement: with the claim.
        certificate: that makes it.
        psi: symbols of psi and its derivatives in the claim.
        enclose: bounds expressions, soundly.

    Returns:
        Its center and radii, shapes (n,); None if there is none of this kind.
    """
    states, inputs = certificate.plant.states, statement.inputs
    polynomial = certificate.psi
    special = statement.zero is not None or statement.defined or statement.faces
    large = len(states) > _MOST_STATES or len(inputs) > _MOST_INPUTS
    if special or large or polynomial.degree > _LARGEST_DEGREE:
        return None
    center = [sp.Rational(v.numerator, v.denominator) for v in polynomial.center]
    middle = np.array([float(v) for v in center])
    # A center that no float is would need a box that is not around it.
    if any(sp.Rational(float(v)) != v for v in center):
        return None
    exact = {psi[()]: polynomial.expression}
    for order, symbol in psi.items():
        derived = polynomial
        for i in order:
            derived = derived.derivative(i)
        exact[symbol] = derived.expression
    at = dict(zip(states, center, strict=True))
    sizes = np.array([float(high - low) for low, high in certificate.plant.workspace])
    for chosen in product(*((low, high) for _, low, high in inputs)):
        effects = [w * u for (w, _, _), u in zip(inputs, chosen, strict=True)]
        e = sp.Add(statement.claim, *effects).xreplace(exact)
        # Derivatives of a long expression would take too long.
        if e.count_ops() > _MOST_OPERATIONS:
            return None
        slopes = [sp.diff(e, s) for s in states]
        if e.atoms(sp.Abs, sp.Max, sp.Min) or any(d.xreplace(at) != 0 for d in (e, *slopes)):
            continue
        second = [[sp.diff(d, s) for s in states] for d in slopes]
        for k in range(_HALVINGS):
            radii = sizes * 0.5**k
            if _is_semidefinite(second, middle, radii, enclose):
                return middle, radii
    return None


def _is_semidefinite(second: Any, middle: Any, radii: Any, enclose: Enclose) -> bool:
    for i, line in enumerate(second):
        ends = [enclose(e, middle, radii) for e in line]
        others = sum(max(-low, high) for k, (low, high) in enumerate(ends) if k != i)
        # 1e-9 is far above the rounding of this sum.
        if not ends[i][0] >= others * (1 + 1e-9):
            return False
    return True
