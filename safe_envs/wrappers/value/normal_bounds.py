"""Proved bounds of the distribution function of a standard normal.

Phi is taken from its Taylor polynomial of degree 10 around the nearest multiple c of 1/8. The
coefficients Phi(c), (-1)^(n-1) He_(n-1)(c) phi(c)/n! come from interval arithmetic with 200 bits:
Phi(c) = 1/2 + phi(c) sum_n c^(2n+1)/(2n+1)!!, whose terms are positive, and fall by half at least
from 2n + 3 >= 2 c^2, so that what is left of them is at most twice the next one.

Error, for |z| <= 9 and t = z - c, |t| <= 1/16; t is exact by Sterbenz' lemma, or z for c = 0.
With |He_n(z)| exp(-z^2/4) <= 1.0865 sqrt(n!) (Cramer) what the polynomial leaves out is at most
.4335 sqrt(10!) t^11/11! < 2e-18. Of the sum over n >= 1, at most .03 in absolute terms, rounding
takes 22 units 2^-53 relative to it, and its coefficients are off by 2^-52: together < 8e-17. Phi(c)
and the last addition are off by 2^-53 < 1.2e-16 each. All is below 3.2e-16.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

ERROR = 4e-16
"""Of Phi as it is computed, at most."""

_FURTHEST = 9.0
"""Phi is below 1.2e-19 at the negative of it, and rises."""

_TAIL = 1.2e-19
_NODES, _DEGREE, _BITS = 8, 10, 200


def normal_below(z: Any) -> np.ndarray:
    """Return numbers that are at most Phi(z), in [0, 1].

    Args:
        z: any shape; infinite values are allowed.
    """
    z = np.asarray(z, dtype=np.float64)
    found = np.maximum(_polynomial(z) - ERROR, 0.0)
    return np.where(z > _FURTHEST, 1.0 - ERROR, np.where(z < -_FURTHEST, 0.0, found))


def normal_above(z: Any) -> np.ndarray:
    """Return numbers that are at least Phi(z), in [0, 1].

    Args:
        z: any shape; infinite values are allowed.
    """
    z = np.asarray(z, dtype=np.float64)
    found = np.minimum(_polynomial(z) + ERROR, 1.0)
    return np.where(z > _FURTHEST, 1.0, np.where(z < -_FURTHEST, _TAIL, found))


def _polynomial(z: np.ndarray) -> np.ndarray:
    z = np.clip(z, -_FURTHEST, _FURTHEST)
    place = np.rint(z * _NODES)
    t = z - place / _NODES
    rows = coefficients()[:, place.astype(np.int64) + int(_FURTHEST * _NODES)]
    found = rows[_DEGREE]
    for row in rows[_DEGREE - 1 :: -1]:
        found = found * t + row
    return found


@lru_cache(maxsize=1)
def coefficients() -> np.ndarray:
    """Return Taylor coefficients at the multiples of 1/8 in [-9, 9], shape (11, nodes).

    Raises:
        ArithmeticError: Interval arithmetic does not give them to a float's precision.
    """
    from mpmath.ctx_iv import MPIntervalContext

    iv: Any = MPIntervalContext()
    iv.prec = _BITS
    last = int(_FURTHEST * _NODES)
    found = np.empty((_DEGREE + 1, 2 * last + 1))
    for j in range(last + 1):
        c = iv.mpf(j) / _NODES
        density = iv.exp(-c * c / 2) / iv.sqrt(2 * iv.pi)
        value = iv.mpf(1) / 2 + density * _series(iv, c)
        hermite = [iv.mpf(1), c]
        while len(hermite) < _DEGREE:
            hermite.append(c * hermite[-1] - (len(hermite) - 1) * hermite[-2])
        for n in range(1, _DEGREE + 1):
            a = _rounded(hermite[n - 1] * density / math.factorial(n))
            # The derivative has the sign (-1)^(n-1), which He_(n-1) has at -c against c.
            found[n, last + j], found[n, last - j] = (-1) ** (n - 1) * a, a
        found[0, last + j], found[0, last - j] = _rounded(value), _rounded(1 - value)
    found.setflags(write=False)
    return found


def _series(iv: Any, c: Any) -> Any:
    """Return the sum over n of c^(2n+1)/(2n+1)!!."""
    total, term, n = iv.mpf(0), c, 0
    while True:
        total += term
        n += 1
        term = term * c * c / (2 * n + 1)
        if 2 * n + 3 >= 2 * float(c.b) ** 2 and float(term.b) < 2.0**-160:
            return total + iv.mpf([0, 1]) * 2 * term


def _rounded(number: Any) -> float:
    """Return the float next to a number that is enclosed in a narrow interval."""
    low, high = number.a, number.b
    if float(high - low) > 2.0**-120:
        raise ArithmeticError("an interval of 200 bits is too wide")
    return float(low)
