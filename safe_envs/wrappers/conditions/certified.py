"""The condition of a barrier certificate."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, shown
from safe_envs.problem.actuators import require_direct
from safe_envs.problem.barrier import Barrier
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.certificates.certificate import (
    AnyCertificate,
    BarrierCertificate,
    HeldCertificate,
)
from safe_envs.wrappers.certificates.files import load_certificate
from safe_envs.wrappers.certificates.kept import Control, differences, is_kept, kept_certificate
from safe_envs.wrappers.certificates.matching import is_among, system_differences
from safe_envs.wrappers.certificates.statements import exact_in
from safe_envs.wrappers.conditions.base import FIRST_ORDER, Condition
from safe_envs.wrappers.conditions.certificate_rows import (
    Places,
    generator_parts,
    held_parts,
)
from safe_envs.wrappers.conditions.constraint import AffineConstraint

_ADVICE = (
    "Run `safe-envs certify` with the options of this env (--noise, --plant, --model, --box and so"
    " on), and give its file as certified:file=FILE"
)


@dataclass(frozen=True)
class Certified(Condition):
    """A psi + a psi + m >= 0 where psi and all barriers are positive, with the generator A.

    That is the constraint of a certificate of continuous control. That of one of held input says
    E psi(X') >= psi - m of the state X' after a control period, with the chord of E psi(X') between
    the bounds of the input in its place; see `HeldStep.constraint`.

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

    certificate: AnyCertificate = field(hash=False)
    file: str | None = None
    name = "certified"
    stochastic = True
    differentiates = False
    autonomous = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.certificate, BarrierCertificate | HeldCertificate):
            raise ConfigurationError(
                f"certificate = {shown(self.certificate)}; give a BarrierCertificate or a"
                " HeldCertificate, or certified:file=FILE with a file of `safe-envs certify`"
            )
        if self._held and self.certificate.plant.policy:
            raise ConfigurationError(
                f"{self._described} is of one policy with held input, from which no constraint"
                " follows; give one that is of every input"
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
        control: Control | None = None,
        **settings: Any,
    ) -> Certified:
        """Return the condition of a problem's certificate.

        Args:
            problem: which the certificate has to be of.
            file: of `safe-envs certify`; by default the certificate of this package is taken.
            control: "held" for the certificate of this package for the env's own steps, by default
                "continuous". A file says that itself.
            settings: further arguments of the condition.

        Raises:
            ConfigurationError: The file is no certificate or of another problem, or this package
                has none of this problem.
        """
        if control not in (None, "continuous", "held") or None not in (file, control):
            raise ConfigurationError(
                f"{cls.name} with control = {shown(control)} and file = {shown(file)}; give"
                " control=held or control=continuous, or a file, which says it itself"
            )
        found = (
            kept_certificate(problem, control or "continuous")
            if file is None
            else load_certificate(Path(file))
        )
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
            return {"control": "held"} if self._held else {}
        text = repr((self.certificate.plant, sorted(self.certificate.psi.coefficients.items())))
        text += " held" if self._held else ""
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
        coefficient, offset = (
            held_parts(certificate, places)
            if isinstance(certificate, HeldCertificate)
            else generator_parts(certificate, model, places)
        )
        return AffineConstraint(
            coefficient,
            offset,
            (barrier.expression, places.polynomial(certificate.psi)),
            demand=sp.Integer(0),
            domain=places.domain,
        )

    @property
    def _held(self) -> bool:
        return isinstance(self.certificate, HeldCertificate)

    @property
    def _described(self) -> str:
        """What messages call the certificate."""
        options = ", ".join(f"{key} = {value}" for key, value in self.certificate.options.items())
        of = f" of {self.certificate.env_id or 'a system'}{f' with {options}' if options else ''}"
        return f"the certificate{of}" + (f" in {shown(self.file)}" if self.file else "")
