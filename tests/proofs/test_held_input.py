"""Bounds on the env's own step: proved numbers, tails, and episodes that do not contradict them."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy as sp
from scipy.stats import beta

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.errors import ConfigurationError
from safe_envs.filters.certificates.certificate import Plant
from safe_envs.filters.certificates.held_step import HeldStep
from safe_envs.proofs.held import (
    HeldBound,
    check_held,
    held_certificate,
    prove_held_bound,
    stated_bound,
    tail_bound,
    why_not_proved,
)
from safe_envs.proofs.judge import Budget
from tests.filters.certificates.held_examples import scalar_certificate, with_numbers

X, Y, U = sp.symbols("x y u", real=True)
DT = Fraction(1, 100)
NOISE = sp.Rational(1, 5)


def line(policy: tuple[sp.Expr, ...] = (), noise: sp.Expr = NOISE) -> Plant:
    """Return dx = (x + u) dt + noise dW, which is safe in (-1, 1)."""
    return Plant(
        states=(X,),
        workspace=((sp.Rational(-9, 10), sp.Integer(3)),),
        inputs=(U,),
        bounds=((sp.Integer(-10), sp.Integer(10)),),
        drift=(X,),
        input_matrix=((sp.Integer(1),),),
        diffusion=((noise,),),
        barriers=(1 - X,),
        policy=policy,
    )


def hump(scale: Fraction = Fraction(5, 4)) -> Polynomial:
    """Return .95 - (x/.9)^4, which is above 0 in (-.889, .889)."""
    coefficients = {(0,): Fraction(95, 100), (4,): -((scale / Fraction(9, 10)) ** 4)}
    return Polynomial((X,), (Fraction(0),), (scale,), coefficients)


@pytest.fixture(scope="module")
def bound() -> HeldBound:
    found = prove_held_bound(line(), hump(), DT)
    assert found.reason == ""
    return found


def test_the_numbers_are_those_of_a_dense_grid(bound: HeldBound) -> None:
    x = np.linspace(-0.889, 0.889, 4001)
    v = np.linspace(-1.0, 1.0, 41)
    moved = x + 0.01 * (x + 10.0 * v[:, None])
    variance = 0.01 * float(NOISE) ** 2
    fourth = moved**4 + 6.0 * moved**2 * variance + 3.0 * variance**2
    gain = x**4 / 0.9**4 - fourth / 0.9**4
    shortfall = -np.maximum(gain[0], gain[-1]).min()
    assert shortfall <= float(bound.shortfall) <= max(shortfall, 0.0) + 3e-5
    chord = 0.5 * (1.0 - v[:, None]) * gain[0] + 0.5 * (1.0 + v[:, None]) * gain[-1]
    assert (gain >= chord - float(bound.sag) * (1.0 - v[:, None] ** 2) - 1e-12).all()
    assert 0.95 <= float(bound.supremum) <= 0.951


def test_false_numbers_are_refuted_and_proved_ones_stand(bound: HeldBound) -> None:
    assert {verdict.word for _, verdict in bound.judged()} == {"proved"}
    # At 0 both ends move the state by .1, and psi falls by (.1/.9)^4.
    least = Fraction(float(Fraction(1, 9) ** 4) * 0.99).limit_denominator(10**12)
    lifted = {**bound.psi.coefficients, (0,): Fraction(3, 2)}
    for name, changes in (
        ("E psi(X') >= psi - m at an end of the bounds", {"shortfall": least}),
        ("psi <= c", {"supremum": Fraction(9, 10)}),
        ("psi <= 0 outside the workspace", {"psi": replace(bound.psi, coefficients=lifted)}),
    ):
        assert dict(replace(bound, **changes).judged())[name].word == "refuted"


def test_psi_is_lowered_where_it_is_not_safe() -> None:
    high = replace(hump(), coefficients={**hump().coefficients, (0,): Fraction(1)})
    # At the end of the workspace, -.9, it is 0, so that nothing need be done there.
    assert prove_held_bound(line(), high, DT).held_bounds_at(np.zeros((1, 1)), 1)[0] > 0.9
    higher = replace(hump(), coefficients={**hump().coefficients, (0,): Fraction(6, 5)})
    found = prove_held_bound(line(), higher, DT)
    assert found.psi.coefficients[(0,)] == pytest.approx(Fraction(1), abs=2e-4)
    assert found.psi.coefficients[(0,)] <= 1


def played(a: sp.Expr, b: sp.Expr, start: float, steps: int, episodes: int) -> int:
    """Return the safe episodes of the worst of three policies under a x u + b >= 0."""
    constraint = sp.lambdify(X, [a, b], "numpy")
    worst = episodes
    for wanted in (10.0, -10.0, 0.0):
        rng = np.random.default_rng(5)
        x = np.full(episodes, start)
        safe = np.ones(episodes, dtype=bool)
        for _ in range(steps):
            slope, offset = constraint(x)
            least = -offset / slope
            u = np.where(slope * wanted + offset >= 0.0, wanted, np.clip(least, -10.0, 10.0))
            x = x + 0.01 * (x + u) + 0.1 * float(NOISE) * rng.standard_normal(episodes)
            safe &= (x < 1.0) & (x > -0.9)
        worst = min(worst, int(safe.sum()))
    return worst


def test_no_policy_under_the_constraint_contradicts_the_bound(bound: HeldBound) -> None:
    a, b = HeldStep(bound.plant, bound.psi, DT).constraint(bound.shortfall)
    start, steps, episodes = 0.6, 100, 2000
    safe = played(a, b, start, steps, episodes)
    high = beta.ppf(1.0 - 1e-4, safe + 1, episodes - safe) if safe < episodes else 1.0
    claimed = bound.held_bounds_at(np.array([[start]]), steps)[0]
    assert 0.4 < claimed <= high


def test_a_policy_has_its_own_bound() -> None:
    policy = (sp.Max(-10, sp.Min(10, -9 * X)),)
    found = prove_held_bound(line(policy), hump(), DT)
    assert found.reason == ""
    assert found.sag == 0
    # Near 0 the noise alone lowers psi: 3 v^2/.9^4, v = .0004; elsewhere the policy lifts it.
    assert float(found.shortfall) < 3e-5
    at = found.held_bounds_at(np.array([[0.0], [0.7], [0.95], [-7.0]]), 100)
    assert at[0] > 0.99
    assert 0.6 < at[1] < at[0]
    assert at[2:].tolist() == [0.0, 0.0]
    away = prove_held_bound(line((sp.Integer(10),)), hump(), DT)
    assert away.held_bounds_at(np.zeros((1, 1)), 100)[0] == 0.0


def test_what_has_no_proof_has_no_bound() -> None:
    found = prove_held_bound(line(), hump(Fraction(9, 10)), DT)
    assert "make the box larger" in found.reason
    assert found.held_bounds_at(np.zeros((1, 1)), 1).tolist() == [0.0]
    with pytest.raises(ConfigurationError, match="make the box larger"):
        held_certificate(found, 50)
    assert prove_held_bound(line(), hump(), DT, budget=Budget(boxes=1)).reason
    two = {"inputs": (U, Y), "bounds": ((sp.Integer(-1), sp.Integer(1)),) * 2}
    with pytest.raises(ConfigurationError, match="2 inputs"):
        prove_held_bound(
            replace(line(), input_matrix=((sp.Integer(1), sp.Integer(1)),), **two), hump(), DT
        )


@pytest.mark.parametrize("distance", [3.0, 6.0, 9.0])
def test_tails_hold_those_of_the_normal_law(distance: float) -> None:
    psi, nu = hump(), 0.016
    mean = 1.0 - distance * nu

    def beyond(z: float) -> float:
        scaled = (z - mean) / nu
        value = abs(mpmath.mpf("0.95") - (mpmath.mpf(5) / 4 / mpmath.mpf("0.9")) ** 4 * z**4)
        return value * mpmath.npdf(scaled) / nu

    found: Any = mpmath.quad(beyond, [1.0, 1.0 + 5 * nu, 1.0 + 40 * nu])
    exact = float(found)
    bound = tail_bound(psi, [nu], [distance])
    assert exact <= bound <= 1e3 * exact**0.8
    assert tail_bound(psi, [0.0], [math.inf]) == 0.0


# Certificates.


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
    assert name not in ("sag", "tail") or why_not_proved(certificate)


def test_a_policy_is_judged_within_the_bounds_of_the_input() -> None:
    plant = scalar_certificate().plant
    policy = (sp.Integer(-1000) * plant.states[0],)
    stated = stated_bound(with_numbers(plant=replace(plant, policy=policy)))
    (law,) = stated.plant.policy
    assert [law.subs(plant.states[0], x) for x in (-1, 1)] == [10, -10]
