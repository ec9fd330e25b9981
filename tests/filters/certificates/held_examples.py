"""Certificates of held input that tests make; those of the package are proved."""

from __future__ import annotations

import functools
from dataclasses import replace
from fractions import Fraction
from typing import Any

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.filters.certificates.certificate import HeldCertificate
from safe_envs.filters.certificates.held_step import held_period
from safe_envs.filters.certificates.matching import plant_of
from safe_envs.proofs.held import held_certificate, prove_held_bound
from tests.conftest import problem_of

SCALAR = "safe_envs/Scalar-v0"


@functools.cache
def scalar_certificate() -> HeldCertificate:
    """Return one of Scalar for 50 periods, with psi = .9 - (x/.9)^4, proved in a second."""
    problem = problem_of(SCALAR, horizon=0.5)
    plant = plant_of(problem)
    scale = Fraction(5, 4)
    coefficients = {(0,): Fraction(9, 10), (4,): -((scale / Fraction(9, 10)) ** 4)}
    psi = Polynomial(plant.states, (Fraction(0),), (scale,), coefficients)
    bound = prove_held_bound(plant, psi, held_period(problem))
    return held_certificate(bound, problem.steps, SCALAR, {"horizon": 0.5})


def with_numbers(**numbers: Any) -> HeldCertificate:
    """Return that of Scalar with other numbers."""
    return replace(scalar_certificate(), **numbers)
