"""Whether a polynomial is a multiple of another one, in bounded time."""

from __future__ import annotations

import math
from typing import Any

import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial

_MOST_TERMS = 3000


def divides(h: sp.Expr, psi: Polynomial) -> bool:
    """Return whether psi is a polynomial times h, so that it is 0 where h is.

    Args:
        h: expression of the states of psi.
        psi: with exact coefficients.

    Returns:
        Whether it is known to be one; False for large polynomials.
    """
    n, degree = psi.n, psi.degree
    if not h.is_polynomial(*psi.states) or not 0 < _degree_bound(h) <= degree:
        return False
    if math.comb(n + degree, n) > _MOST_TERMS:
        return False
    return sp.reduced(sp.expand(psi.expression), [h], *psi.states)[1] == 0


def _degree_bound(e: Any) -> int:
    if e.is_Add:
        return max(map(_degree_bound, e.args))
    if e.is_Mul:
        return sum(map(_degree_bound, e.args))
    if e.is_Pow:
        return _degree_bound(e.base) * int(e.exp) if e.free_symbols else 0
    return int(bool(e.is_Symbol))
