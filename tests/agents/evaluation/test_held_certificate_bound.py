"""The bound of a certificate of held input, as evaluations tell it."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from safe_envs.agents.evaluation.bounds import (
    FilteredPolicy,
    HeldCertificateBound,
    held_certificate_bound,
)
from safe_envs.agents.evaluation.episodes import VisitedStates
from safe_envs.wrappers import SZCBF, Certified
from tests.conftest import problem_of
from tests.filters.certificates.held_examples import SCALAR, scalar_certificate, with_numbers

PROBLEM = problem_of(SCALAR, horizon=0.5)


def bound_of(certificate, *more, problem=PROBLEM) -> HeldCertificateBound:
    conditions = (Certified(certificate), *more)
    found = held_certificate_bound(FilteredPolicy(problem, conditions, "model", "random"))
    assert found is not None
    return found


def test_a_proved_certificate_has_a_bound_at_each_start() -> None:
    found = bound_of(scalar_certificate())
    assert (found.why_none, found.word) == ("", "proved")
    at = found.at(np.array([[0.0], [0.7], [0.99], [1.4]]))
    assert 0.5 < at[1] < at[0] < 1.0
    assert at[2:].tolist() == [0.0, 0.0]
    longer = bound_of(scalar_certificate(), problem=problem_of(SCALAR)).at(np.zeros((1, 1)))
    assert longer < at[0]


def test_others_have_a_reason() -> None:
    assert held_certificate_bound(FilteredPolicy(PROBLEM, (), "model", "random")) is None
    assert "other conditions" in bound_of(scalar_certificate(), SZCBF((1.0,))).why_none
    false = with_numbers(shortfall=Fraction(1, 10**7))
    assert "is not proved: E psi(X')" in bound_of(false).why_none
    louder = problem_of(SCALAR, horizon=0.5, noise=0.3)
    assert "differs from the system" in bound_of(scalar_certificate(), problem=louder).why_none


def test_a_psi_above_c_contradicts() -> None:
    x = np.array([[0.1]])
    none = np.empty(0)
    visited = VisitedStates.of(np.empty((0, 1)), np.empty((0, 1)), none, x, np.array([0.9]))
    assert bound_of(scalar_certificate()).contradiction(visited) == ""
    assert "psi" in bound_of(with_numbers(supremum=Fraction(1, 2))).contradiction(visited)
