"""The bound of a certificate of held input for the env's own steps."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from safe_envs.agents.evaluation.filtered_policy import FilteredPolicy
from safe_envs.agents.evaluation.visited_states import VisitedStates
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.certificates.certificate import HeldCertificate
from safe_envs.wrappers.certificates.matching import system_differences
from safe_envs.wrappers.conditions import Certified, Condition
from safe_envs.wrappers.conditions.filter_settings import FilterSettings
from safe_envs.wrappers.verification.assumptions import reaches
from safe_envs.wrappers.verification.held_check import stated_bound, why_not_proved
from safe_envs.wrappers.verification.results import RELATIVE, Extremum

PROVED = "the certificate's statements are proved by branch and bound"
"""Note on such a bound."""


class HeldCertificateBound:
    """The bound of a certificate of held input, which holds for every policy under its filter.

    Args:
        certificate: of the filter.
        conditions: all of the filter.
        problem: what is simulated.

    Attributes:
        word: "proved".
        note: what it is of.
        nowhere: what to say where it is 0 at all starts.
    """

    word: Literal["proved"] = "proved"
    note = PROVED
    nowhere = "the certificate says nothing at any start"

    def __init__(
        self,
        certificate: HeldCertificate,
        conditions: tuple[Condition, ...],
        problem: SafetyProblem,
    ) -> None:
        self._certificate, self._conditions, self._problem = certificate, conditions, problem
        self._bound = stated_bound(certificate)

    @property
    def why_none(self) -> str:
        """Why there is none at any start; "" where there may be one."""
        if any(condition != self._conditions[0] for condition in self._conditions):
            return "other conditions act besides that of the certificate"
        differing = system_differences(self._certificate.plant, self._problem.plant)
        if differing:
            parts = ", ".join(differing)
            return f"the plant differs from the system of the certificate in {parts}"
        reason = why_not_proved(self._certificate)
        return f"the certificate is not proved: {reason}" if reason else ""

    def at(self, starts: np.ndarray) -> np.ndarray:
        """Return the bound at starts; see `HeldInputBound.at`."""
        return self._bound.held_bounds_at(starts, self._problem.steps)

    def contradiction(self, visited: VisitedStates) -> str:
        """Return how states contradict psi <= c; "" if they do not."""
        psi, x = self._certificate.psi, visited.deepest
        middle, half = (np.array(part, dtype=float) for part in (psi.center, psi.scale))
        inside = (np.abs(x - middle) <= half).all(axis=1) & (visited.depth > 0.0)
        highest = float(psi.values(x[inside]).max(initial=-math.inf))
        c = float(self._certificate.supremum)
        return reaches("psi", highest, Extremum(c, c)) if highest > c * (1.0 + RELATIVE) else ""


def held_certificate_bound(of: FilteredPolicy) -> HeldCertificateBound | None:
    """Return the bound of a filter with a certificate of held input; None for other filters.

    Args:
        of: a policy, which does not matter, and the filter.
    """
    if isinstance(of.parts, FilterSettings):
        return None
    certificates = (c.certificate for c in of.parts if isinstance(c, Certified))
    held = next((c for c in certificates if isinstance(c, HeldCertificate)), None)
    return None if held is None else HeldCertificateBound(held, of.parts, of.problem)
