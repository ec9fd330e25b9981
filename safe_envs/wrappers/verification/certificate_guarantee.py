"""The guarantee of a barrier certificate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from safe_envs.dynamics.tables import tabulated
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.certificates.certificate import BarrierCertificate, HeldCertificate
from safe_envs.wrappers.certificates.matching import system_differences
from safe_envs.wrappers.conditions import Certified, Condition
from safe_envs.wrappers.verification.assumptions import reaches
from safe_envs.wrappers.verification.branch_and_bound import Budget
from safe_envs.wrappers.verification.certificate_statements import judged
from safe_envs.wrappers.verification.judge import JudgeResult
from safe_envs.wrappers.verification.results import RELATIVE, Bound, Extremum, Status

_BUDGET = Budget(boxes=2_000_000, seconds=120.0)
OF_HELD_INPUT = "its certificate is of held input, and not of continuous control"
_NAME = "barrier certificate: (psi_0 e^(-a T) - m (1 - e^(-a T))/a)/c"


@dataclass(frozen=True)
class CertificateGuarantee:
    """The bound of a barrier certificate, once the judge has proved its statements.

    Attributes:
        certificate: with psi and the numbers; None where it is of held input.
        against: why its bound is not one of the filter, in words; empty where it is.
    """

    certificate: BarrierCertificate | None
    against: str = ""
    remark = ""

    @cached_property
    def statements(self) -> list[tuple[str, JudgeResult]]:
        """The statements of the certificate, with the judge's word."""
        return [] if self.certificate is None else judged(self.certificate, _BUDGET)

    @property
    def note(self) -> str | None:
        """Why there is no bound; None if there is one."""
        if self.against:
            return self.against
        refuted = (v.reason for _, v in self.statements if v.word == "refuted")
        return next(refuted, None)

    @property
    def word(self) -> Status:
        """Whether the bound is proved or estimated."""
        proved = all(verdict.word == "proved" for _, verdict in self.statements)
        return "proved" if proved else "estimated"

    def at(self, starts: np.ndarray, horizon: float) -> np.ndarray:
        """Return the bound at starts; see `ChainGuarantee.at`."""
        starts = np.asarray(starts, dtype=np.float64)
        if self.note or self.certificate is None:
            return np.zeros(len(starts))
        return np.where(
            _inside(self.certificate, starts), self.certificate.bounds_at(starts, horizon), 0.0
        )

    def best_start(self, seed: int = 0) -> None:
        """Return None: no printed formula has to be tried where it is largest."""

    def contradiction(
        self, reached: np.ndarray, violated: np.ndarray, actions: np.ndarray, slack: np.ndarray
    ) -> str:
        """Say what states contradict in c; see `ChainGuarantee.contradiction`."""
        if self.certificate is None:
            return ""
        psi = self.certificate.values(reached[_inside(self.certificate, reached)])
        highest, c = float(psi.max(initial=-math.inf)), float(self.certificate.supremum)
        stated = Extremum(c, c)  # The judge does not refute it, or there is no bound.
        return reaches("psi", highest, stated) if highest > c * (1.0 + RELATIVE) else ""

    def applicable_bounds(self, starts: np.ndarray, horizon: float) -> list[Bound]:
        """Return the bound on average over starts; see `ChainGuarantee.applicable_bounds`."""
        if self.note:
            return [Bound(_NAME, None, "hypothesis fails", self.note)]
        values = self.at(starts, horizon)
        error = float(values.std(ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else 0.0
        undecided = (v.reason for _, v in self.statements if v.word == "undecided")
        return [Bound(_NAME, float(values.mean()), self.word, next(undecided, ""), False, error)]


def certificate_guarantee(
    problem: SafetyProblem, conditions: Sequence[Condition]
) -> CertificateGuarantee:
    """Return the bound of a filter with the condition of a certificate.

    Args:
        problem: whose plant has to be that of the certificate.
        conditions: one for each barrier, at least one of which is `Certified`.
    """
    first = next(c for c in conditions if isinstance(c, Certified))
    if isinstance(first.certificate, HeldCertificate):
        return CertificateGuarantee(None, OF_HELD_INPUT)
    against = ""
    if any(condition != first for condition in conditions):
        against = "other conditions act besides that of the certificate"
    if not against:
        differing = system_differences(first.certificate.plant, problem.plant)
        parts = ", ".join(differing)
        against = f"the plant differs from the system of the certificate in {parts}" * bool(parts)
    return CertificateGuarantee(first.certificate, against)


def _inside(certificate: BarrierCertificate, x: np.ndarray) -> np.ndarray:
    """Return which states are in C and in the workspace, shape (B,)."""
    plant = certificate.plant
    with np.errstate(all="ignore"):
        barriers = tabulated(plant.states, list(plant.barriers))(x)
    low, high = np.array([[float(end) for end in ends] for ends in plant.workspace]).T
    within = ((x >= low) & (x <= high)) | np.array(plant.angles)
    return (barriers > 0.0).all(axis=1) & within.all(axis=1)
