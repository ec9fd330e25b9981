"""Certificates that tests make by hand; nothing says that they are proofs."""

from __future__ import annotations

import itertools
from fractions import Fraction
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.filters.certificates.certificate import BarrierCertificate
from safe_envs.filters.certificates.matching import plant_of
from safe_envs.problem.problem import SafetyProblem


def polynomial_of(problem: SafetyProblem, expression: Any, scale: Any = 1) -> Polynomial:
    """A polynomial of the states as one of the states over a common scale."""
    states, share = problem.plant.states, sp.Rational(scale)
    scaled = sp.sympify(expression).xreplace({s: s * share for s in states})
    terms = sp.Poly(scaled, *states).terms()
    return Polynomial(
        states,
        (Fraction(0),) * len(states),
        (Fraction(share.p, share.q),) * len(states),
        {key: Fraction(int(value.p), int(value.q)) for key, value in terms},
    )


def random_polynomial(problem: SafetyProblem, degree: int, seed: int = 0) -> Polynomial:
    """A dense polynomial with random coefficients, about a center that is not 0."""
    rng, n = np.random.default_rng(seed), problem.plant.n
    keys = [k for k in itertools.product(range(degree + 1), repeat=n) if sum(k) <= degree]
    values = rng.integers(-(10**9), 10**9, len(keys)).tolist()
    return Polynomial(
        problem.plant.states,
        tuple(Fraction(i + 1, 10) for i in range(n)),
        tuple(Fraction(i + 3, 4) for i in range(n)),
        {key: Fraction(value, 10**9) for key, value in zip(keys, values, strict=True)},
    )


def certificate_of(problem: SafetyProblem, psi: Any, **numbers: Any) -> BarrierCertificate:
    """A certificate of a problem's plant.

    Args:
        problem: whose plant is taken.
        psi: polynomial, or an expression.
        numbers: other than a = m = 0 and c = T = 1.
    """
    psi = psi if isinstance(psi, Polynomial) else polynomial_of(problem, psi)
    given = {"rate": 0, "shortfall": 0, "supremum": 1, "horizon": 1, **numbers}
    exact = {key: Fraction(str(value)) for key, value in given.items()}
    return BarrierCertificate(f"safe_envs/{problem.name}-v0", {}, plant_of(problem), psi, **exact)
