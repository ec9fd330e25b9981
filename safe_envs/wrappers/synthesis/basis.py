"""Products of Chebyshev polynomials, in which linear programs are well conditioned."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial


class Jets(NamedTuple):
    """All members of a basis at states.

    Attributes:
        values: shape (B, K).
        gradients: with respect to the states, shape (B, n, K).
        hessians: shape (B, n, n, K).
    """

    values: np.ndarray
    gradients: np.ndarray
    hessians: np.ndarray


@dataclass(frozen=True)
class ChebyshevBasis:
    """Products T_i(z_1) T_j(z_2) ... up to a total degree, in z = (x - center)/scale.

    Attributes:
        states: symbols x_1, ..., x_n.
        center: of the states for which z is in [-1, 1].
        scale: half of the width of their range, each > 0.
        degree: largest total degree, at least 0.
        even: only members of even total degree, which are the same at z and -z.
    """

    states: tuple[sp.Symbol, ...]
    center: tuple[Fraction, ...]
    scale: tuple[Fraction, ...]
    degree: int
    even: bool = False

    @cached_property
    def exponents(self) -> np.ndarray:
        """The degrees i, j, ... of the members, shape (K, n); the first one is constant."""
        ranges = [range(self.degree + 1)] * len(self.states)
        step = 2 if self.even else 1
        totals = range(0, self.degree + 1, step)
        found = [key for key in itertools.product(*ranges) if sum(key) in totals]
        return np.array(sorted(found, key=lambda key: (sum(key), key)))

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return all members at states (B, n), shape (B, K)."""
        found = np.ones((len(x), len(self.exponents)))
        for i in range(len(self.states)):
            found *= self._along(x, i)[0][:, self.exponents[:, i]]
        return found

    def jets(self, x: np.ndarray) -> Jets:
        """Return all members with their derivatives at states.

        Args:
            x: states, shape (B, n).
        """
        n = len(self.states)
        each = [[part[:, self.exponents[:, i]] for part in self._along(x, i)] for i in range(n)]

        def product(orders: list[int]) -> np.ndarray:
            found = each[0][orders[0]]
            for own, order in zip(each[1:], orders[1:], strict=True):
                found = found * own[order]
            return found

        unit = np.eye(n, dtype=int)
        gradients = np.stack([product(e.tolist()) for e in unit], axis=1)
        hessians = np.empty((len(x), n, n, len(self.exponents)))
        for i in range(n):
            for j in range(i + 1):
                hessians[:, i, j] = hessians[:, j, i] = product((unit[i] + unit[j]).tolist())
        return Jets(product([0] * n), gradients, hessians)

    def embedded(self, lower: ChebyshevBasis, coefficients: np.ndarray) -> np.ndarray:
        """Return the coefficients of a polynomial of another basis, shape (K,).

        Args:
            lower: the other basis, all members of which this one has.
            coefficients: of its members.
        """
        places = {tuple(key): i for i, key in enumerate(self.exponents.tolist())}
        found = np.zeros(len(places))
        found[[places[tuple(key)] for key in lower.exponents.tolist()]] = coefficients
        return found

    def polynomial(self, coefficients: np.ndarray, decimals: int) -> Polynomial:
        """Return the polynomial of rounded coefficients, exactly.

        Args:
            coefficients: of the members, shape (K,).
            decimals: to which they are rounded.
        """
        monomials = _monomials(self.degree)
        found: dict[tuple[int, ...], Fraction] = {}
        for key, c in zip(self.exponents.tolist(), coefficients.tolist(), strict=True):
            exact = Fraction(round(c * 10**decimals), 10**decimals)
            if not exact:
                continue
            for powers in itertools.product(*(range(k % 2, k + 1, 2) for k in key)):
                factor = 1
                for k, power in zip(key, powers, strict=True):
                    factor *= monomials[k][power]
                found[powers] = found.get(powers, Fraction(0)) + exact * factor
        return Polynomial(
            self.states, self.center, self.scale, {k: v for k, v in found.items() if v}
        )

    def _along(self, x: np.ndarray, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return T_0, ..., T_N of one variable with two derivatives, shape (B, N + 1) each."""
        scale = float(self.scale[i])
        z = (x[:, i] - float(self.center[i])) / scale
        found = np.zeros((3, len(x), self.degree + 1))
        found[0, :, 0] = 1.0
        if self.degree:
            found[0, :, 1], found[1, :, 1] = z, 1.0
        for k in range(2, self.degree + 1):
            t, d, dd = found[:, :, k - 1]
            found[0, :, k] = 2.0 * z * t - found[0, :, k - 2]
            found[1, :, k] = 2.0 * (t + z * d) - found[1, :, k - 2]
            found[2, :, k] = 2.0 * (2.0 * d + z * dd) - found[2, :, k - 2]
        return found[0], found[1] / scale, found[2] / scale**2


def _monomials(degree: int) -> list[list[int]]:
    """Return the coefficients of T_0, ..., T_N by powers."""
    found = [[1], [0, 1]]
    for _ in range(2, degree + 1):
        raised = [0, *(2 * c for c in found[-1])]
        found.append([c - d for c, d in itertools.zip_longest(raised, found[-2], fillvalue=0)])
    return found
