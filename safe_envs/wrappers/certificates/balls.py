"""Balls of Arb that hold expressions, and polynomials with their derivatives."""

from __future__ import annotations

import functools
import math
import operator
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.errors import ConfigurationError, install_extra


def require_flint() -> Any:
    """Return the module of python-flint.

    Raises:
        ConfigurationError: it is not installed.
    """
    try:
        import flint  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ConfigurationError(
            f"the check by ball arithmetic needs python-flint; {install_extra('proofs')}, or check"
            " without it"
        ) from error
    return flint


class Balls:
    """Expressions in ball arithmetic."""

    def __init__(self, flint: Any) -> None:
        self.flint, self.arb = flint, flint.arb

    def rational(self, value: Any) -> Any:
        """Return the ball of a fraction or a float."""
        p, q = (value.p, value.q) if isinstance(value, sp.Rational) else value.as_integer_ratio()
        return self.arb(self.flint.fmpq(int(p), int(q)))

    def _power(self, base: Any, exponent: sp.Rational, nonnegative: bool) -> Any:
        if exponent.q not in (1, 2):
            raise ConfigurationError(f"this check does not know the power {exponent}; use others")
        if exponent.q == 2:
            base = (base.nonnegative_part() if nonnegative else base).sqrt()
        found = self.arb(1)
        for _ in range(abs(int(exponent.p))):
            found = found * base
        return 1 / found if exponent < 0 else found

    def value(self, e: Any, known: dict[Any, Any]) -> Any:
        """Return the ball of an expression.

        Args:
            e: expression.
            known: balls of its symbols; all that is found is added to it.

        Raises:
            ConfigurationError: it has a function or a power that is not known here.
        """
        if e in known:
            return known[e]
        name = type(e).__name__
        if e.is_Rational:
            return self.rational(e)
        if e.is_NumberSymbol:
            return self.arb.pi() if e is sp.pi else self.arb.const_e()
        if e.is_Pow and e.exp.is_Rational:
            base = self.value(e.base, known)
            found = self._power(base, e.exp, bool(e.base.is_nonnegative))
        else:
            found = self._applied(name, [self.value(x, known) for x in e.args])
        known[e] = found
        return found

    def _applied(self, name: str, args: list[Any]) -> Any:
        first = args[0]
        if name in ("Add", "Mul"):
            return functools.reduce(operator.add if name == "Add" else operator.mul, args)
        if name in ("Max", "Min"):
            return functools.reduce(lambda x, y: getattr(x, name.lower())(y), args)
        if name == "Heaviside":
            return (first.sgn() + 1) / 2
        if name in ("sin", "cos", "exp", "log", "tanh", "atan"):
            return getattr(first, name)()
        if name in ("Abs", "sign"):
            return abs(first) if name == "Abs" else first.sgn()
        raise ConfigurationError(f"this check does not know the function {name}; use others")


class PolynomialBalls:
    """A polynomial and its derivatives as balls."""

    def __init__(self, psi: Polynomial, balls: Balls) -> None:
        self._balls, self._psi, self._shape = balls, psi, psi.tensor.shape
        self._entries = [balls.rational(v) for v in psi.tensor.ravel()]
        self._powers = list(np.ndindex(*self._shape))
        self._weights: dict[Any, Any] = {}

    def _shifted(self, z: list[Any]) -> Any:
        mat, entries = self._balls.flint.arb_mat, self._entries
        for d, middle in zip(self._shape, z, strict=True):
            powers = [self._balls.arb(1)]
            for _ in range(d - 1):
                powers.append(powers[-1] * middle)
            shift = [
                [powers[j - k] * math.comb(j, k) if j >= k else 0 for j in range(d)]
                for k in range(d)
            ]
            rest = len(entries) // d
            entries = (mat(shift) * mat(d, rest, entries)).transpose().entries()
        return mat(1, len(entries), entries)

    def _weights_of(self, r: tuple[Any, ...], orders: tuple[Any, ...]) -> Any:
        """Return the matrix from shifted coefficients to the derivatives on a box of radii r."""
        key = (r, orders)
        if key not in self._weights:
            balls, psi = self._balls, self._psi
            axes: list[Any] = []
            for radius, scale, d in zip(r, psi.scale, self._shape, strict=True):
                wide = balls.rational(radius) / balls.rational(scale)
                powers = [balls.arb(1), balls.arb(0, wide.upper())]
                for k in range(2, d + 1):
                    whole = (wide**k).upper() if wide > 0 else balls.arb(0)
                    powers.append(
                        balls.arb(whole / 2, whole / 2) if k % 2 == 0 else balls.arb(0, whole)
                    )
                axes.append(powers)
            lines = []
            for key_of in self._powers:
                line = []
                for order in orders:
                    taken = [order.count(i) for i in range(psi.n)]
                    weight = balls.arb(1)
                    for i, (k, a) in enumerate(zip(key_of, taken, strict=True)):
                        factor = self._balls.rational(1 / psi.scale[i] ** a) * math.perm(k, a)
                        weight = weight * (factor * axes[i][k - a] if k >= a else 0)
                    line.append(weight)
                lines.append(line)
            if len(self._weights) > 100:
                self._weights.clear()
            self._weights[key] = balls.flint.arb_mat(lines)
        return self._weights[key]

    def __call__(self, x: list[Any], r: tuple[Any, ...], orders: tuple[Any, ...]) -> list[Any]:
        """Return the derivatives of some orders on the states within radii r of x."""
        psi, balls = self._psi, self._balls
        z = [
            (m - balls.rational(c)) / balls.rational(s)
            for m, c, s in zip(x, psi.center, psi.scale, strict=True)
        ]
        return (self._shifted(z) * self._weights_of(r, orders)).entries()


class MeanValueForm:
    """f(x_0), and the gradient on a box of states."""

    def __init__(self, middle: Any, slopes: list[Any], r: tuple[float, ...], box: Any) -> None:
        self.middle, self.slopes, self.r, self.box = middle, slopes, r, box

    def plus(self, multiple: Any, other: MeanValueForm) -> MeanValueForm:
        """Return the sum with a multiple of another form.

        Args:
            multiple: ball or number.
            other: form on the same states.
        """
        slopes = [a + multiple * b for a, b in zip(self.slopes, other.slopes, strict=True)]
        box = self.box + multiple * other.box
        return MeanValueForm(self.middle + multiple * other.middle, slopes, self.r, box)

    @cached_property
    def _reach(self) -> Any:
        return sum(abs(s).upper() * r for s, r in zip(self.slopes, self.r, strict=True))

    @cached_property
    def low(self) -> Any:
        """A lower end."""
        return _better(self.middle - self._reach, self.box, "lower")

    @cached_property
    def high(self) -> Any:
        """An upper end."""
        return _better(self.middle + self._reach, self.box, "upper")


def _better(first: Any, other: Any, end: str) -> Any:
    """Return the narrower one of two ends; that of a ball without bounds is none."""
    ends = [getattr(ball, end)() for ball in (first, other) if ball.is_finite()]
    if not ends:
        return first
    return (max if end == "lower" else min)(ends)
