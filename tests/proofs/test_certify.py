"""Barriers of systems whose safety is known, and what the judge makes of them."""

from __future__ import annotations

import math
import time
from fractions import Fraction

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, state_problem
from safe_envs.errors import ConfigurationError
from safe_envs.filters.certificates.checker import check
from safe_envs.filters.certificates.matching import plant_of
from safe_envs.proofs import certify as synthesis_module
from safe_envs.proofs.certify import (
    Named,
    Synthesis,
    SynthesisSettings,
    Task,
    certify,
    degrees_of,
    finalize,
    nominal_laws,
)
from safe_envs.proofs.held_synthesis import certify_held
from safe_envs.proofs.linear_program import Domain
from safe_envs.registry import make_problem
from tests.proofs.brownian_motion import brownian, survival

HORIZON = 1.0
BEST = math.exp(-HORIZON / 2)
"""Largest bound at pi/2 for a = 1/2: psi is the first eigenfunction, sin x."""


def attempts(degrees, rate=0.5, horizon=HORIZON):
    settings = SynthesisSettings(degrees=degrees, rates=(rate,))
    synthesis = Synthesis(brownian(horizon), settings)
    return synthesis, synthesis.attempts()


def test_the_bound_of_brownian_motion_approaches_that_of_the_eigenfunction():
    synthesis, found = attempts((2, 4, 8))
    means = [a.candidate.mean for a in found]
    assert means == sorted(means)
    assert means[0] < BEST - 0.05
    assert BEST - 2e-3 < means[-1] <= BEST + 1e-6
    z = np.linspace(0.1, 3.0, 50)[:, None]
    np.testing.assert_allclose(found[-1].candidate.psi(z), np.sin(z[:, 0]), atol=0.01)
    numbers = finalize(found[-1].candidate, synthesis.domain)
    assert not numbers.reason
    bound = found[-1].candidate.bound.mean(
        numbers.psi.values(np.array([[math.pi / 2]])),
        float(numbers.shortfall),
        float(numbers.supremum),
    )
    assert BEST - 0.01 < bound <= BEST


def test_a_degree_that_finds_nothing_keeps_the_psi_of_the_lower_one(monkeypatch):
    # Behind the first linear programs none has a solution.
    synthesis = Synthesis(brownian(HORIZON), SynthesisSettings(degrees=(2, 4, 6), rates=(0.5,)))
    made = synthesis_module.solve
    fails = lambda claims, *rest: None if len(rest[1]) > 3 else made(claims, *rest)  # noqa: E731
    monkeypatch.setattr(synthesis_module, "solve", fails)
    first, *others = synthesis.attempts()
    assert first.candidate.mean > 0.2
    x = np.linspace(0.1, 3.0, 20)[:, None]
    for attempt in others:
        assert attempt.carried
        assert attempt.candidate.mean == first.candidate.mean
        np.testing.assert_allclose(attempt.candidate.psi(x), first.candidate.psi(x))
    automatic = Synthesis(brownian(HORIZON), SynthesisSettings(rates=(0.5,)))
    monkeypatch.setattr(
        synthesis_module,
        "solve",
        lambda claims, *rest: None if len(rest[1]) > 9 else made(claims, *rest),
    )
    assert [(a.degree, a.carried) for a in automatic.attempts()] == [(8, False), (14, True)]


@pytest.mark.slow
def test_no_degree_is_proved_worse_than_a_lower_one():
    """Noise that vanishes at the origin: linear programs of higher degrees fail here."""
    s, t, u = sp.symbols("s t u", real=True)
    system = ControlAffineSDE.from_rate(
        (s, t), (u,), [-1.5 * s + t, -s - 1.5 * t + u], diffusion=[[0.2 * s, 0], [0, 0.2 * t]]
    )
    problem = state_problem(
        system,
        s + 80,
        box=(-1.0, 1.0),
        start=[(45.0, 55.0), (-55.0, -45.0)],
        dt=0.01,
        horizon=1.0,
        workspace={s: (-100.0, 100.0), t: (-100.0, 100.0)},
    )
    chosen, lowest, higher = (
        certify(Named(problem), SynthesisSettings(degrees=degrees), policy=True)
        for degrees in ((), (6,), (8,))
    )
    assert 0.99 < lowest.mean <= chosen.mean
    assert higher.mean >= lowest.mean - 1e-9
    assert [a.degree for a in higher.attempts] == [6, 8]  # Degree 6 is where it begins.
    sampled = [a.candidate.mean for a in higher.attempts]
    assert sampled == sorted(sampled)


def test_no_proved_bound_is_above_the_exact_probability():
    for rate in (0.0, 0.5, 1.0):
        synthesis, found = attempts((6,), rate, horizon=0.4)
        candidate = found[0].candidate
        numbers = finalize(candidate, synthesis.domain)
        assert not numbers.reason
        for start in np.linspace(0.05, 3.1, 40):
            bound = candidate.bound.mean(
                numbers.psi.values(np.array([[start]])),
                float(numbers.shortfall),
                float(numbers.supremum),
            )
            assert bound <= survival(start, 0.4)


def test_psi_is_not_above_zero_on_the_edge_after_the_judge():
    synthesis, found = attempts((4,))
    psi = finalize(found[0].candidate, synthesis.domain).psi
    assert max(psi.values(np.array([[0.0], [math.pi]]))) <= 0.0


def test_a_certificate_is_checked_by_the_other_program_and_repeats_itself():
    problem = make_problem("safe_envs/Scalar-v0", horizon=1.0)
    settings = SynthesisSettings(degrees=(8,), rates=(0.0,))
    named = Named(problem, "safe_envs/Scalar-v0", {"horizon": 1.0})
    first, second = certify(named, settings), certify(named, settings)
    certificate = first.certificate
    assert certificate is not None
    assert certificate == second.certificate
    assert certificate.plant.policy == ()
    assert certificate.horizon == Fraction(1)
    assert 0.85 < first.mean < 0.999
    assert first.mean <= first.attempts[0].candidate.program + first.margin
    assert check(certificate, seconds=60.0).word == "checked"


def test_a_bound_of_the_nominal_controller_is_another_one():
    problem = make_problem("safe_envs/Scalar-v0", horizon=0.2)
    settings = SynthesisSettings(degrees=(6,), rates=(0.0,))
    every = certify(Named(problem), settings)
    nominal = certify(Named(problem), settings, policy=True)
    assert nominal.certificate is not None
    (law,), (given,) = nominal.certificate.plant.policy, nominal_laws(problem)
    assert sp.nsimplify(given) == law
    assert 0.05 < nominal.mean < every.mean - 0.05
    assert check(nominal.certificate, seconds=60.0).word == "checked"


def test_nothing_is_certified_where_the_system_leaves_at_once():
    # From the edge of C no bound is above 0.
    problem = make_problem("safe_envs/Scalar-v0", start=(1.0,))
    found = certify(Named(problem), SynthesisSettings(degrees=(4,), rates=(0.0,)))
    assert found.certificate is None
    assert (found.mean, found.attempts[0].candidate) == (0.0, None)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"degrees": (0,)}, "degree = 0"),
        ({"degrees": (21,)}, "up to degree 20"),
        ({"rates": (-0.1,)}, "at least 0"),
        ({"rates": (math.nan,)}, "at least 0"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"seconds": 0.0}, "seconds"),
    ],
)
def test_settings_out_of_range_are_refused(wrong, told):
    with pytest.raises(ConfigurationError, match=told):
        SynthesisSettings(**wrong)


def test_what_is_too_large_is_refused():
    five = make_problem("safe_envs/DubinsReach-v0").plant
    with pytest.raises(ConfigurationError, match="give a lower degree"):
        degrees_of(five, SynthesisSettings(degrees=(8,)))
    twelve = make_problem("safe_envs/Quadrotor-v0")
    for find in (certify, certify_held):
        begin = time.process_time()
        with pytest.raises(ConfigurationError, match="12 states"):
            find(Named(twelve), SynthesisSettings())
        assert time.process_time() - begin < 1.0


def test_starts_are_taken_within_the_period_of_an_angle():
    problem = make_problem("safe_envs/StochasticDubins-v0")
    plant = plant_of(problem)
    task = Task(plant, 1.0, np.array([[0.5, 0.5, 7.0], [0.5, 0.5, -4.0]]), (False, False, True))
    starts = Synthesis(task, SynthesisSettings(degrees=(2,))).starts
    np.testing.assert_allclose(starts[:, 2], [7.0 - 2 * np.pi, 2 * np.pi - 4.0])


def test_starts_outside_of_the_safe_set_have_no_bound():
    inside = brownian(HORIZON, starts=(1.0, -0.5, 3.5))
    assert Synthesis(inside, SynthesisSettings(degrees=(2,))).starts.tolist() == [[1.0]]
    with pytest.raises(ConfigurationError, match="no start"):
        Synthesis(brownian(HORIZON, starts=(-0.5,)), SynthesisSettings(degrees=(2,)))


def test_a_state_on_the_edge_is_on_it():
    problem = make_problem("safe_envs/CubicSDE-v0")
    domain = Domain.of(plant_of(problem), (False, False))
    edge = domain.draw_edge(500, np.random.default_rng(0))
    assert len(edge) > 100
    assert np.abs(domain.level(edge)).max() < 1e-9
    # Its corners with the ends of the workspace are among them.
    assert edge[:, 0].min() == -6.0
