"""Certificates of held input are what was proved, and false ones are found out."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import sympy as sp

from safe_envs.errors import ConfigurationError
from safe_envs.proofs.held import check_held, held_certificate, stated_bound, why_not_proved
from tests.filters.certificates.held_examples import scalar_certificate, with_numbers


def test_a_proved_bound_is_checked_again() -> None:
    certificate = scalar_certificate()
    found = check_held(certificate, 20.0)
    assert found.word == "checked", found
    assert len(found.parts) >= 5
    assert why_not_proved(certificate) == ""
    bound = stated_bound(certificate)
    assert held_certificate(bound, 50, certificate.env_id, certificate.options) == certificate
    # At 0 psi is .9, and an input at its bounds moves the state by .1.
    expected = 1.0 - 50 * float(certificate.shortfall + certificate.sag) / 0.9
    at = bound.held_bounds_at(np.zeros((1, 1)), certificate.steps)[0]
    assert at == pytest.approx(expected, abs=1e-4)
    assert 0.95 < at < 0.995


@pytest.mark.parametrize(
    ("name", "value", "word"),
    [
        ("shortfall", Fraction(1, 10**6), "refuted"),
        ("supremum", Fraction(8, 10), "refuted"),
        ("tail", Fraction(0), "undecided"),
        ("sag", Fraction(-1), "refuted"),
        ("period", Fraction(1, 10), "refuted"),
    ],
)
def test_a_false_number_is_found(name: str, value: Fraction, word: str) -> None:
    certificate = with_numbers(**{name: value})
    assert check_held(certificate, 2.0).word == word
    assert why_not_proved(certificate)


def test_a_policy_is_judged_within_the_bounds_of_the_input() -> None:
    plant = scalar_certificate().plant
    policy = (sp.Integer(-1000) * plant.states[0],)
    stated = stated_bound(with_numbers(plant=replace(plant, policy=policy)))
    (law,) = stated.plant.policy
    assert [law.subs(plant.states[0], x) for x in (-1, 1)] == [10, -10]


def test_without_a_bound_there_is_no_certificate() -> None:
    none = replace(stated_bound(scalar_certificate()), reason="the box is too small")
    with pytest.raises(ConfigurationError, match="box is too small"):
        held_certificate(none, 50)
