"""Polynomials of the states with exact coefficients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.errors import SystemDefinitionError


@dataclass(frozen=True)
class Polynomial:
    """A polynomial in z_i = (x_i - center_i)/scale_i, which lie in [-1, 1] on a box of interest.

    Scaled variables keep the coefficients of high degrees near 1, so that few decimals state them.

    Attributes:
        states: symbols x_1, ..., x_n.
        center: of that box.
        scale: half of its widths, each > 0.
        coefficients: of the monomials, by the exponents of z_1, ..., z_n.

    Raises:
        SystemDefinitionError: The numbers of states, centers, scales and exponents differ, a scale
            is not above 0, or an exponent is no whole number of at least 0.
    """

    states: tuple[sp.Symbol, ...]
    center: tuple[Fraction, ...]
    scale: tuple[Fraction, ...]
    coefficients: Mapping[tuple[int, ...], Fraction]

    def __post_init__(self) -> None:
        n = len(self.states)
        if {len(self.center), len(self.scale), *map(len, self.coefficients)} - {n}:
            raise SystemDefinitionError(
                f"a polynomial of {n} states needs {n} centers, scales and exponents"
            )
        if any(s <= 0 for s in self.scale):
            raise SystemDefinitionError("a scale of a polynomial must be above 0")
        if any(not isinstance(e, int) or e < 0 for key in self.coefficients for e in key):
            raise SystemDefinitionError("an exponent must be a whole number of at least 0")

    @property
    def degree(self) -> int:
        """Largest sum of exponents with a coefficient other than 0; 0 without any."""
        return max((sum(key) for key, value in self.coefficients.items() if value), default=0)

    @cached_property
    def tensor(self) -> np.ndarray:
        """Exact coefficients by exponents, an array of `Fraction` with one axis for each state."""
        degrees = [max((key[i] for key in self.coefficients), default=0) for i in range(self.n)]
        found = np.full([d + 1 for d in degrees], Fraction(0), dtype=object)
        for key, value in self.coefficients.items():
            found[key] = value
        return found

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.states)

    def derivative(self, i: int) -> Polynomial:
        """Return the derivative with respect to the state x_i."""
        lowered = {
            (*key[:i], key[i] - 1, *key[i + 1 :]): value * key[i] / self.scale[i]
            for key, value in self.coefficients.items()
            if key[i]
        }
        return Polynomial(self.states, self.center, self.scale, lowered)

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return the values at states in floating point.

        Args:
            x: states, shape (B, n).

        Returns:
            Shape (B,).
        """
        found = self.tensor.astype(float)[None]
        scaled = (x - np.array(self.center, dtype=float)) / np.array(self.scale, dtype=float)
        # Horner's rule along each axis, the last one first.
        for z in scaled.T[::-1]:
            result = found[..., -1]
            for k in range(found.shape[-1] - 2, -1, -1):
                result = result * z.reshape(-1, *[1] * (result.ndim - 1)) + found[..., k]
            found = result
        return np.broadcast_to(found, (len(x),)).copy()

    @cached_property
    def expression(self) -> sp.Expr:
        """The polynomial as an exact expression of the states, in nested form."""
        scaled = [
            (s - sp.Rational(c)) / sp.Rational(r)
            for s, c, r in zip(self.states, self.center, self.scale, strict=True)
        ]
        return _nested(self.tensor, scaled)


def _nested(tensor: np.ndarray, variables: Sequence[Any]) -> Any:
    """Return the expression of a tensor of coefficients by Horner's rule in each variable."""
    if not variables:
        value: Any = tensor[()] if isinstance(tensor, np.ndarray) else tensor
        return sp.Rational(value.numerator, value.denominator)
    found: Any = sp.Integer(0)
    for part in tensor[::-1]:
        found = found * variables[0] + _nested(part, variables[1:])
    return found
