"""The linear program whose solution is a barrier."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

_MOST_COEFFICIENT = 1000.0
_SECONDS, _TIME_OVER = 10.0, 1
"""Of a linear program, and what SciPy says where they did not suffice."""

_SLACK = 1e-9


@dataclass(frozen=True)
class Claims:
    """What psi, the sum of a basis with coefficients, has to meet.

    Attributes:
        generator: coefficients of A psi + a psi, which is to be >= -m, shape (B, K).
        at_most_one: values of the basis where psi <= 1, shape (C, K).
        not_positive: values of the basis where psi <= 0, shape (D, K).
    """

    generator: np.ndarray
    at_most_one: np.ndarray
    not_positive: np.ndarray


@dataclass(frozen=True)
class MeanBound:
    """psi(x_0) e^(-a T) - m (1 - e^(-a T))/a, for c = 1.

    Attributes:
        rate: a >= 0 in 1/s.
        horizon: T in s.
    """

    rate: float
    horizon: float

    @property
    def decay(self) -> float:
        """The factor e^(-a T) of psi."""
        return math.exp(-self.rate * self.horizon)

    @property
    def spent(self) -> float:
        """The factor (1 - e^(-a T))/a of m, in s."""
        a = self.rate
        return -math.expm1(-a * self.horizon) / a if a else self.horizon

    def mean(self, psi: np.ndarray, m: float, supremum: float) -> float:
        """Return the mean of the bound over starts.

        Args:
            psi: at the starts, shape (B,).
            m: shortfall.
            supremum: c.
        """
        values = (psi * self.decay - m * self.spent) / supremum
        return float(values.clip(0.0, 1.0).mean())


def solve(claims: Claims, bound: MeanBound, weights: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Return the coefficients and the shortfall m of the largest mean bound.

    Args:
        claims: that psi has to meet.
        bound: which is linear in psi and m.
        weights: mean of the basis over the starts that count, shape (K,), with their part of all
            starts as its first entry: the first member of the basis is 1.

    Returns:
        Coefficients, shape (K,), and m; nothing where no solution was found.
    """
    from scipy.optimize import linprog

    g, one, zero = claims.generator, claims.at_most_one, claims.not_positive
    matrix = np.zeros((len(g) + len(one) + len(zero), len(weights) + 1))
    matrix[:, :-1] = np.concatenate([-g, one, zero])
    matrix[: len(g), -1] = -1.0
    limits = np.zeros(len(matrix))
    limits[len(g) : len(g) + len(one)] = 1.0
    sizes = np.abs(matrix).max(axis=1)
    cost = np.append(-bound.decay * weights, bound.spent * weights[0])
    ranges = [(-_MOST_COEFFICIENT, _MOST_COEFFICIENT)] * len(weights) + [(0.0, None)]
    for method in ("highs-ds", "highs-ipm"):
        found = linprog(
            cost,
            matrix / sizes[:, None],
            limits / sizes - _SLACK,
            bounds=ranges,
            method=method,
            options={"time_limit": _SECONDS},
        )
        if found.x is not None and found.status != _TIME_OVER:
            return found.x[:-1], max(0.0, float(found.x[-1]))
    return None
