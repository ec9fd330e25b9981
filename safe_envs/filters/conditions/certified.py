"""The condition of a barrier certificate."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.engine.qp import ROUNDING
from safe_envs.errors import ConfigurationError, shown
from safe_envs.filters.certificates.certificate import BarrierCertificate
from safe_envs.filters.certificates.files import load_certificate
from safe_envs.filters.certificates.kept import differences, is_kept, kept_certificate
from safe_envs.filters.certificates.matching import (
    PERIOD,
    exact_in,
    is_among,
    system_differences,
)
from safe_envs.filters.conditions.base import FIRST_ORDER, AffineConstraint, Condition
from safe_envs.problem.actuators import require_direct
from safe_envs.problem.problem import Barrier, SafetyProblem


class Places:
    """Where the expressions of a constraint are evaluated: at the nearest state in the workspace.

    Nothing overflows there. An angle is taken back to the turn of the workspace.

    Attributes:
        nearest: that state, by the symbols of the states.
        domain: what is positive where the constraint has a meaning.
    """

    def __init__(self, certificate: BarrierCertificate) -> None:
        plant, psi = certificate.plant, certificate.psi
        self._z = tuple(sp.Symbol(f"z_{i}", real=True) for i in range(psi.n))
        ends = [tuple(sp.N(end, 17) for end in pair) for pair in plant.workspace]
        self.nearest: dict[Any, Any] = {}
        self._nearest_z: dict[Any, Any] = {}
        inside = []
        for i, (x, (low, high)) in enumerate(zip(psi.states, ends, strict=True)):
            if plant.angles[i]:
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
    """Return a and b of the constraint a u + b >= 0.

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


def _ito_parts(
    certificate: BarrierCertificate,
) -> tuple[list[tuple[sp.Expr, Polynomial]], Polynomial]:
    """Return 1/2 tr(sigma' psi_xx sigma) + a psi + m in parts."""
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


_ADVICE = (
    "Run `safe-envs certify` with the options of this env (--noise, --plant, --model, --box and so"
    " on), and give its file as certified:file=FILE"
)


@dataclass(frozen=True)
class Certified(Condition):
    """A psi + a psi + m >= 0 where psi and all barriers are positive, with the generator A.

    The barrier psi, a and m are those of a certificate. It is of all barriers at once: each of them
    gets this one constraint. Where psi or a barrier is not positive, and outside the workspace,
    there is no constraint, and the certificate says nothing: the filter executes the action that
    raises psi fastest, flagged as infeasible. Outside the workspace the values of psi are
    those at the nearest state in it, for a polynomial means nothing there.

    Attributes:
        certificate: with psi, a and m, and the system that it is of.
        file: from which it was read; None for one of this package, or of the caller's.

    Raises:
        ConfigurationError: a margin of first order is asked for.

    Source: the theorem of the certificate; see `BarrierCertificate`.
    """

    certificate: BarrierCertificate = field(hash=False)
    file: str | None = None
    name = "certified"
    stochastic = True
    differentiates = False
    autonomous = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.certificate, BarrierCertificate):
            raise ConfigurationError(
                f"certificate = {shown(self.certificate)}; give a BarrierCertificate, or"
                " certified:file=FILE with a file of `safe-envs certify`"
            )
        if self.sampling_margin == FIRST_ORDER:
            raise ConfigurationError(
                f"{self.name} has no sampling margin of first order; give a number"
            )

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> Certified:
        """Raise ConfigurationError: the condition needs a certificate; see `for_problem`."""
        raise ConfigurationError(
            f"{cls.name} needs a certificate: {cls.name}:file=FILE, with a file of"
            " `safe-envs certify`"
        )

    @classmethod
    def for_problem(
        cls,
        problem: SafetyProblem,
        file: str | None = None,
        **settings: Any,
    ) -> Certified:
        """Return the condition of a problem's certificate.

        Args:
            problem: which the certificate has to be of.
            file: of `safe-envs certify`; by default the certificate of this package is taken.
            settings: further arguments of the condition.

        Raises:
            ConfigurationError: The file is no certificate or of another problem, or this package
                has none of this problem.
        """
        found = kept_certificate(problem) if file is None else load_certificate(Path(file))
        condition = cls(found, file, **settings)
        condition.require_fit(problem)
        return condition

    def require_fit(self, problem: SafetyProblem) -> None:
        """Raise ConfigurationError for a certificate of another problem, or late inputs."""
        require_direct(problem, "certificates")
        against = differences(self.certificate, problem)
        if against:
            raise ConfigurationError(
                f"{self._described} is of another problem; they differ in {', '.join(against)}."
                f" {_ADVICE}"
            )

    @property
    def parameters(self) -> dict[str, Any]:
        """The file, nothing for a certificate of this package, or a checksum of another one."""
        if self.file is not None:
            return {"file": self.file}
        if is_kept(self.certificate):
            return {}
        text = repr((self.certificate.plant, sorted(self.certificate.psi.coefficients.items())))
        return {"sha256": hashlib.sha256(text.encode()).hexdigest()[:12]}

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint.

        Raises:
            ConfigurationError: the certificate is of another system or of other barriers.
        """
        certificate = self.certificate
        plant = certificate.plant
        if not is_among(plant.barriers, exact_in(model, barrier.expression)):
            raise ConfigurationError(
                f"{self._described} is not of the barrier {barrier.name} = {barrier.expression}."
                f" {_ADVICE}"
            )
        against = system_differences(plant, model)
        if against:
            raise ConfigurationError(
                f"{self._described} is of another system than the one that this filter knows; they"
                f" differ in {', '.join(against)}. {_ADVICE}; or let the filter know the system of"
                " the certificate, by knowledge = 'plant' or 'model'"
            )
        places = Places(certificate)
        coefficient, offset = generator_parts(certificate, model, places)
        return AffineConstraint(
            coefficient,
            offset,
            (barrier.expression, places.polynomial(certificate.psi)),
            demand=sp.Integer(0),
            domain=places.domain,
        )

    @property
    def _described(self) -> str:
        """What messages call the certificate."""
        options = ", ".join(f"{key} = {value}" for key, value in self.certificate.options.items())
        of = f" of {self.certificate.env_id or 'a system'}{f' with {options}' if options else ''}"
        return f"the certificate{of}" + (f" in {shown(self.file)}" if self.file else "")
