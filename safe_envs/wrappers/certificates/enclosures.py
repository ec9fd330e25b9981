"""Enclosures of expressions and polynomials on boxes, of the checker's own.

On a box x = x_0 + r e, all |e_i| <= 1, a quantity is enclosed by c + b e + [-rho, rho], with rho of
order r^2, and by an interval [low, high]; both are rounded outwards. Those of psi and its
derivatives come from its coefficients in powers of x - x_0.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.errors import ConfigurationError

EPS, _TINY, _POINT = 2.0**-48, 1e-290, 1e-13  # of roundings, underflow; least radius in psi


class Form(NamedTuple):
    """Enclosures on B boxes."""

    c: Any
    b: Any  # shape (n, B), all others (B,)
    rho: Any
    low: Any
    high: Any


def form(c: Any, b: Any, rho: Any, low: Any, high: Any) -> Form:
    """Round outwards and keep the better enclosure.

    Args:
        c: values of the linear part at the centers.
        b: its slopes times the radii.
        rho: largest distance from the linear part.
        low: lower ends.
        high: upper ends.

    Returns:
        The whole line where there is no number.
    """
    rho = rho + EPS * (np.abs(c) + np.abs(b).sum(0) + rho) + _TINY
    lost = ~(np.abs(c) + np.abs(b).sum(0) + rho < np.inf)
    c, b, rho = (np.where(lost, other, e) for e, other in ((c, 0.0), (b, 0.0), (rho, np.inf)))
    reach = (np.abs(b).sum(0) + rho) * (1 + EPS) + EPS * np.abs(c)
    low = np.fmax(low - EPS * np.abs(low) - _TINY * ~(low >= 0), c - reach)
    high = np.fmin(high + EPS * np.abs(high) + _TINY, c + reach)
    half = high / 2 - low / 2
    narrow = half < rho
    c, b = np.where(narrow, low + half, c), np.where(narrow, 0.0, b)
    rho = np.where(narrow, half * (1 + EPS) + EPS * np.abs(c) + _TINY, rho)
    return Form(c, b, rho, low, high)


def constant(value: Any, n: int) -> Form:
    """Return what holds the numbers that floats approximate.

    Args:
        value: floats, correctly rounded.
        n: number of states.
    """
    value = np.atleast_1d(np.asarray(value, dtype=float))
    return form(value, np.zeros((n, 1)), 0.0, value, value)


def plus(p: Form, q: Form) -> Form:
    """Return the sum of p and q.

    Args:
        p: first form.
        q: second form.
    """
    return form(*(x + y for x, y in zip(p, q, strict=True)))


def times(p: Form, q: Form) -> Form:
    """Return the product of p and q, for one and the same object the square.

    Args:
        p: first form.
        q: second form.
    """
    corners = [x * y for x in (p.low, p.high) for y in (q.low, q.high)]
    low, high = functools.reduce(np.minimum, corners), functools.reduce(np.maximum, corners)
    low = np.fmax(low, 0.0) if p is q else np.where((p.low >= 0) & (q.low >= 0), low, low - _TINY)
    squares, size = p.b * q.b / 2, np.abs(p.b).sum(0) + p.rho  # e_i^2 is in [0, 1]
    rest = size * (np.abs(q.b).sum(0) + q.rho) * (1 + 4 * EPS) - np.abs(squares).sum(0)
    rho, b = np.abs(p.c) * q.rho + np.abs(q.c) * p.rho + rest, p.c * q.b + q.c * p.b
    return form(p.c * q.c + squares.sum(0), b, rho, low, high)


def _power(p: Form, k: int) -> Form:
    root = _power(p, k // 2) if k > 1 else p
    return p if k == 1 else times(root, root) if k % 2 == 0 else times(p, _power(p, k - 1))


def _image(p: Form, y: Any, slope: Any, bend: Any, ends: Any = None) -> Form:
    """Apply a function: its derivative, its largest |second derivative| and range between ends."""
    low, high = ends(p.low, p.high) if ends else (y(p.low), y(p.high))
    size, steep = np.abs(p.b).sum(0) + p.rho, slope(p.c)
    bent = bend(np.minimum(p.low, p.c), np.maximum(p.high, p.c))
    known = np.isfinite(p.low) & np.isfinite(p.high)  # sin(1/x) is no number where 1/x is none
    low, high = np.where(known, low, -np.inf), np.where(known, high, np.inf)
    rho = np.abs(steep) * p.rho + bent * size * size / 2 + EPS
    return form(np.where(known, y(p.c), np.nan), steep * p.b, rho, low, high)


def _least(low: Any, high: Any) -> Any:
    return np.maximum(np.maximum(low, -high), 0.0)  # of |x|


def _inverted(low: Any, high: Any) -> Any:
    ends, pole = (1 / high, 1 / low), _least(low, high) == 0
    return np.where(pole, -np.inf, ends[0]), np.where(pole, np.inf, ends[1])


_FUNCTIONS: dict[str, tuple[Any, ...]] = {
    "sin": (np.sin, np.cos, lambda *_: 1.0, lambda *_: (-1.0, 1.0)),
    "cos": (np.cos, lambda x: -np.sin(x), lambda *_: 1.0, lambda *_: (-1.0, 1.0)),
    "exp": (np.exp, np.exp, lambda _, high: np.exp(high)),
    "log": (np.log, lambda x: 1 / x, lambda low, _: np.where(low > 0, low**-2.0, np.inf)),
    "tanh": (np.tanh, lambda x: 1 - np.tanh(x) ** 2, lambda *_: 0.77),
    "atan": (np.arctan, lambda x: 1 / (1 + x * x), lambda *_: 0.65),
    "sqrt": (np.sqrt, lambda x: 0.5 / np.sqrt(x), lambda low, _: np.fmax(low, 0) ** -1.5 / 4),
    "1/x": (lambda x: 1 / x, lambda x: -1 / x**2, lambda *x: 2 / _least(*x) ** 3, _inverted),
    "Abs": (
        *(np.abs, np.sign, lambda *x: np.where(_least(*x) == 0, np.inf, 0.0)),
        lambda low, high: (_least(low, high), np.maximum(-low, high)),
    ),
}


def value_of(e: Any, known: dict[Any, Form], n: int) -> Form:
    """Return the enclosure of an expression.

    Args:
        e: expression.
        known: enclosures of its symbols; all that is found is added to it.
        n: number of states.

    Raises:
        ConfigurationError: it has a function that is not known here.
    """
    if e in known:
        return known[e]
    name, args = type(e).__name__, e.args
    if e.is_Number or e.is_NumberSymbol:
        return constant(float(e), n)
    if e.is_Pow and args[1].is_Rational:
        base = value_of(args[0], known, n)
        base = _image(base, *_FUNCTIONS["sqrt"]) if args[1].q == 2 else base
        found = _power(base, abs(args[1].p)) if args[1].q <= 2 else None
        found = _image(found, *_FUNCTIONS["1/x"]) if found and args[1] < 0 else found
    elif name in ("Max", "Min"):
        rest = args[1] if len(args) == 2 else e.func(*args[1:])
        gap = sp.Abs(args[0] - rest) * (1 if name == "Max" else -1)
        found = value_of((args[0] + rest + gap) / 2, known, n)
    else:
        parts = [value_of(x, known, n) for x in args]
        if e.is_Add or e.is_Mul:
            found = functools.reduce(plus if e.is_Add else times, parts)
        else:
            found = _image(parts[0], *_FUNCTIONS[name]) if name in _FUNCTIONS else None
    if found is None:
        raise ConfigurationError(f"{e} has a function that the checker does not know; use others")
    known[e] = found
    return found


class PolynomialForms:
    """The enclosures of psi and its derivatives."""

    def __init__(self, psi: Polynomial) -> None:
        self.tensor, self.powers = psi.tensor.astype(float), np.indices(psi.tensor.shape)
        self.powers = self.powers.reshape(psi.n, -1)
        self.center, self.scale = (np.array(v, float)[:, None] for v in (psi.center, psi.scale))
        self.rounding = (4 * psi.n * max(self.tensor.shape) + 20) * 2.0**-52

    def _shifted(self, tensor: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the coefficients in powers of the distance from z, shape (B, K)."""
        found = tensor[None]
        for d, middle in zip(tensor.shape, z, strict=True):
            k = np.arange(d)
            matrix = np.vander(middle, d, True)[:, np.maximum(k - k[:, None], 0)]
            matrix *= [[math.comb(j, i) for j in k] for i in k]
            found = np.matmul(matrix, found.reshape(len(found), d, -1)).swapaxes(1, 2)
        return found.reshape(z.shape[1], -1)

    def __call__(self, x: np.ndarray, r: np.ndarray, orders: list[Any]) -> list[Form]:
        """Return one for each order, the indices of the states that are derived by."""
        z, slack = (x - self.center) / self.scale, EPS * (np.abs(x) + np.abs(self.center))
        slack = slack / self.scale + _POINT  # of z, which is rounded
        wide, shape = r / self.scale * (1 + EPS) + slack, self.tensor.shape
        parts = [
            np.vander(w, d, True)[:, k] for w, d, k in zip(wide, shape, self.powers, strict=True)
        ]
        size = math.prod(parts)
        terms = self._shifted(self.tensor, z) * size
        errors = self._shifted(np.abs(self.tensor), np.abs(z)) * size * self.rounding
        forms = []
        for order in orders:
            taken = np.bincount(np.array(order, int), minlength=len(x))
            up = self.powers - taken[:, None]
            counts = [
                [math.perm(k, a) for k in range(d)] for a, d in zip(taken, shape, strict=True)
            ]
            parts = [np.array(c, float)[k] for c, k in zip(counts, self.powers, strict=True)]
            weight = math.prod(parts) / np.prod(self.scale[:, 0] ** taken)
            total, even = up.sum(0), (up % 2 == 0).all(0) * (up.sum(0) > 0) / 2  # of z^2, in [0, 1]
            linear = weight * (total == 1) * (up == 1)  # (n, K)
            back = np.prod(wide ** taken[:, None], axis=0)
            c, b = terms @ (weight * ((total == 0) + even)) / back, linear @ terms.T / back
            rho = np.abs(terms) @ (weight * (total > 1) * (1 - even)) + errors @ weight
            rho = rho * (1 + terms.shape[1] * EPS) / back + (np.abs(b) * slack / wide).sum(0)
            rho = rho + terms.shape[1] * EPS / 8 * np.abs(c)  # of the sum that is c
            forms.append(form(c, b * (r / self.scale) / wide, rho * (1 + EPS), -np.inf, np.inf))
        return forms
