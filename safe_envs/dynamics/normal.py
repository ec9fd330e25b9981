"""Standard normal and exponential numbers of uniforms, as arrays; see `normal_kernel`."""

from __future__ import annotations

import numpy as np

from safe_envs.dynamics import normal_kernel as kernel

_PIECE = 16384
"""Numbers to compute at a time: so many, with all that is computed on the way, fit the cache."""

_Pairs = tuple[np.ndarray, ...]
"""Coefficients of two polynomials, each pair (2, 1), the highest power first."""


def _coefficients(above: str, below: str) -> _Pairs:
    tops = [getattr(kernel, f"{above}{i}") for i in range(7, -1, -1)]
    lows = [*(getattr(kernel, f"{below}{i}") for i in range(7, 0, -1)), 1.0]
    return tuple(np.array(pair)[:, None] for pair in zip(tops, lows, strict=True))


_CENTRAL, _NEAR, _FAR = _coefficients("A", "B"), _coefficients("C", "D"), _coefficients("E", "F")


def standard_normals(uniforms: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Return the standard normal numbers of uniforms of `StreamReader`.

    Args:
        uniforms: in [0, 1), of any shape.
        out: contiguous array of the same shape for the result, which may be `uniforms` itself; None
            for a new one.
    """
    found = np.empty(np.shape(uniforms)) if out is None else out
    np.subtract(uniforms, 0.5, out=found)
    flat = found.reshape(-1)
    work = np.empty((2, min(flat.size, _PIECE)))
    for first in range(0, flat.size, _PIECE):
        piece = flat[first : first + _PIECE]
        _invert(piece, work[:, : piece.size])
    return found


def standard_exponentials(uniforms: np.ndarray) -> np.ndarray:
    """Return the standard exponentials of uniforms of `StreamReader`, in [0, 1); same shape."""
    found = np.log(uniforms + kernel.HALF_STEP)
    return np.negative(found, out=found)


def _invert(q: np.ndarray, work: np.ndarray) -> None:
    """Put the normal numbers of U - 1/2 in place of them; `work` is of shape (2, q.size)."""
    q += kernel.HALF_STEP
    distance = np.abs(q)
    tails = np.flatnonzero(distance > kernel.CENTRAL)
    signed, distance = q[tails], distance[tails]
    r = q * q
    np.subtract(kernel.CENTRAL_SQUARE, r, out=r)
    # The central function has poles in the tails, which get values of their own below.
    np.maximum(r, 0.0, out=r)
    q *= _quotient(_CENTRAL, r, work)
    found = _tail(distance)
    q[tails] = np.copysign(found, signed, out=found)


def _tail(distance: np.ndarray) -> np.ndarray:
    """Return the normal numbers of the uniforms that lie above 1/2 by so much."""
    r = np.subtract(0.5, distance)
    np.log(r, out=r)
    np.negative(r, out=r)
    np.sqrt(r, out=r)
    far = np.flatnonzero(r > kernel.NEAR_END)
    beyond = r[far] - kernel.FAR_SHIFT
    r -= kernel.NEAR_SHIFT
    found = _quotient(_NEAR, r, np.empty((2, r.size)))
    if far.size:
        found[far] = _quotient(_FAR, beyond, np.empty((2, far.size)))
    return found


def _quotient(pairs: _Pairs, r: np.ndarray, work: np.ndarray) -> np.ndarray:
    """Return the quotient of a pair of polynomials in r, computed in `work` (2, r.size)."""
    np.multiply(pairs[0], r, out=work)
    for pair in pairs[1:-1]:
        work += pair
        work *= r
    work += pairs[-1]
    return np.divide(work[0], work[1], out=work[0])
