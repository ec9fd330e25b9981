"""The constraints on the input that certificates ask for, as expressions of the states."""

from __future__ import annotations

import itertools
from fractions import Fraction
from typing import Any

import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.wrappers.certificates.certificate import (
    BarrierCertificate,
    Certificate,
    HeldCertificate,
)
from safe_envs.wrappers.certificates.held_step import HeldStep
from safe_envs.wrappers.certificates.matching import PERIOD, is_one_period
from safe_envs.wrappers.qp.rounding import ROUNDING


class Places:
    """Where the expressions of a constraint are evaluated: at the nearest state in the workspace.

    Nothing overflows there. An angle is taken back to the turn of the workspace.

    Attributes:
        nearest: that state, by the symbols of the states.
        domain: what is positive where the constraint has a meaning.
    """

    def __init__(self, certificate: Certificate) -> None:
        plant, psi = certificate.plant, certificate.psi
        self._z = tuple(sp.Symbol(f"z_{i}", real=True) for i in range(psi.n))
        ends = [tuple(sp.N(end, 17) for end in pair) for pair in plant.workspace]
        self.nearest: dict[Any, Any] = {}
        self._nearest_z: dict[Any, Any] = {}
        inside = []
        for i, (x, (low, high)) in enumerate(zip(psi.states, ends, strict=True)):
            if is_one_period(plant.workspace[i]):
                place = low + sp.Mod(x - low, PERIOD.evalf(17))
            else:
                place = sp.Max(low, sp.Min(x, high))
                inside.append(sp.Min(x - low, high - x))
            self.nearest[x] = place
            self._nearest_z[self._z[i]] = self._scaled(psi, i, place)
        # What rounding cannot tell from 0 counts as 0, so that a state alone and in a batch agree.
        size = sum(abs(float(value)) for value in psi.coefficients.values())
        rounding = sp.Float(ROUNDING * (1 + psi.degree) * size, 17)
        farthest = sp.Max(1, *[sp.Abs(z) for z in self._nearest_z.values()])
        self.domain = (
            self.value(psi) - rounding * farthest**psi.degree,
            *(self.at(barrier) for barrier in plant.barriers),
            *inside,
        )
        if isinstance(certificate, HeldCertificate):
            # It states nothing where a scaled state is not in [-1, 1].
            self.domain += tuple(1 - sp.Abs(z) for z in self._nearest_z.values())

    def at(self, expression: sp.Expr) -> sp.Expr:
        """Return an expression of the certificate at the nearest state."""
        return sp.N(expression, 17).xreplace(self.nearest)

    def value(self, polynomial: Polynomial) -> sp.Expr:
        """Return a polynomial in the scaled states of psi at the nearest state, in nested form."""
        return self._nested(polynomial).xreplace(self._nearest_z)

    def polynomial(self, psi: Polynomial) -> sp.Expr:
        """Return psi at the state itself, wherever that is."""
        scaled = {z: self._scaled(psi, i, psi.states[i]) for i, z in enumerate(self._z)}
        return self._nested(psi).xreplace(scaled)

    def _scaled(self, psi: Polynomial, i: int, place: Any) -> Any:
        center, scale = (sp.Float(sp.Rational(v[i]), 17) for v in (psi.center, psi.scale))
        return (place - center) / scale

    def _nested(self, polynomial: Polynomial) -> Any:
        nothing, one = (Fraction(0),) * polynomial.n, (Fraction(1),) * polynomial.n
        exact: Any = Polynomial(self._z, nothing, one, polynomial.coefficients).expression
        # A fraction of large whole numbers is no number of compiled code.
        fractions = (r for r in exact.atoms(sp.Rational) if not r.is_Integer)
        return exact.xreplace({r: sp.Float(r, 17) for r in fractions})


def generator_parts(
    certificate: BarrierCertificate, model: ControlAffineSDE, places: Places
) -> tuple[tuple[sp.Expr, ...], sp.Expr]:
    """Return a and b of the constraint a u + b >= 0 of continuous control.

    Args:
        certificate: with psi, and the numbers a and m.
        model: the same system with its own numbers.
        places: where it is evaluated.
    """
    slopes = [places.value(certificate.psi.derivative(i)) for i in range(model.n)]
    drift, effect = (
        sp.Matrix(model.numeric(part)).xreplace(places.nearest)
        for part in (model.drift, model.input_matrix)
    )
    curved, total = _ito_parts(certificate)
    offset = places.value(total)
    offset += sum(f * slope for f, slope in zip(drift, slopes, strict=True))
    offset += sum(places.at(weight) * places.value(second) for weight, second in curved)
    coefficient = tuple(
        sp.Add(*[effect[i, j] * slopes[i] for i in range(model.n)]) for j in range(model.m)
    )
    return coefficient, offset


def held_parts(certificate: HeldCertificate, places: Places) -> tuple[tuple[sp.Expr, ...], sp.Expr]:
    """Return a and b of the constraint a u + b >= 0 of held input; see `HeldStep.constraint`.

    Args:
        certificate: with psi, m and the control period.
        places: where it is evaluated.
    """
    step = HeldStep(certificate.plant, certificate.psi, certificate.period)
    coefficient, offset = step.constraint(certificate.shortfall)
    return (places.at(coefficient),), places.at(offset)


def _ito_parts(
    certificate: BarrierCertificate,
) -> tuple[list[tuple[sp.Expr, Polynomial]], Polynomial]:
    """Return 1/2 tr(sigma' psi_xx sigma) + a psi + m in parts.

    Returns:
        Second derivatives with weights that depend on the state, and the sum of all else.
    """
    plant, psi = certificate.plant, certificate.psi
    sigma: Any = sp.Matrix(plant.diffusion)
    covariance, n = sigma * sigma.T, len(plant.states)
    total = {key: certificate.rate * value for key, value in psi.coefficients.items()}
    total[(0,) * n] = total.get((0,) * n, Fraction(0)) + certificate.shortfall
    curved = []
    for i, j in itertools.combinations_with_replacement(range(n), 2):
        weight = covariance[i, j] if i < j else covariance[i, j] / 2
        second = psi.derivative(i).derivative(j)
        if weight.is_Rational:
            share = Fraction(int(weight.p), int(weight.q))
            for key, value in second.coefficients.items() if share else ():
                total[key] = total.get(key, Fraction(0)) + share * value
        else:
            curved.append((weight, second))
    return curved, Polynomial(psi.states, psi.center, psi.scale, total)
