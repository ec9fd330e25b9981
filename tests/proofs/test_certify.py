"""Certificates of systems whose safety is known: never above it, and near it."""

from __future__ import annotations

import math
import time
from fractions import Fraction

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, define_problem
from safe_envs.errors import ConfigurationError
from safe_envs.filters.certificates.checker import check
from safe_envs.proofs.certify import Named, SynthesisSettings, certify
from safe_envs.registry import make_problem

x, y, u = sp.symbols("x y u", real=True)
TURN = 2 * math.pi


def brownian(horizon, start=math.pi / 2, drift=u):
    """Brownian motion in (0, pi) under the nominal input, which is 0."""
    system = ControlAffineSDE.from_rate((x,), (u,), [drift], diffusion=[1])
    return define_problem(
        system,
        [x, sp.pi - x],
        input_bounds=(-1, 1),
        start=(start,) if np.isscalar(start) else [start],
        nominal=0,
        dt=0.01,
        horizon=horizon,
        workspace={x: (-1, 4)},
    )


def survival(start, time):
    """The probability that Brownian motion stays in (0, pi), by its series of eigenfunctions."""
    k = np.arange(1, 200, 2)
    return float((4 / (np.pi * k) * np.sin(k * start) * np.exp(-(k**2) * time / 2)).sum())


def certified(problem, policy=True, **settings):
    """What is certified of a problem."""
    return certify(Named(problem), SynthesisSettings(**settings), policy)


def test_the_bound_of_brownian_motion_approaches_that_of_the_eigenfunction():
    best = math.exp(-1.0 / 2)  # At pi/2 for a = 1/2: psi is the first eigenfunction, sin x.
    found = certified(brownian(1.0), degrees=(2, 4, 8), rates=(0.5,))
    sampled = [attempt.candidate.mean for attempt in found.attempts]
    assert sampled == sorted(sampled)
    assert sampled[0] < best - 0.05
    assert best - 0.01 < found.mean <= best
    certificate = found.certificate
    z = np.linspace(0.1, 3.0, 50)
    psi = certificate.values(z[:, None]) / float(certificate.supremum)
    np.testing.assert_allclose(psi, np.sin(z), atol=0.02)
    # At the edge of C it is not above 0.
    assert certificate.values(np.array([[0.0], [math.pi]])).max() <= 0.0


@pytest.mark.parametrize("rate", [0.0, 0.5, 1.0])
def test_no_proved_bound_is_above_the_exact_probability(rate):
    problem = brownian(0.4, (0.05, 3.1))
    certificate = certified(problem, degrees=(6,), rates=(rate,)).certificate
    starts = np.linspace(0.05, 3.1, 40)
    bounds = certificate.bounds_at(starts[:, None], 0.4)
    assert bounds.max() > 0.3
    assert (bounds <= [survival(start, 0.4) for start in starts]).all()
    assert check(certificate, seconds=60.0).word == "checked"


@pytest.mark.oracle
def test_no_degree_is_proved_worse_than_a_lower_one():
    """Noise that vanishes at the origin: linear programs of higher degrees fail here."""
    drift = [-1.5 * x + y, -x - 1.5 * y + u]
    noise = [[0.2 * x, 0], [0, 0.2 * y]]
    system = ControlAffineSDE.from_rate((x, y), (u,), drift, diffusion=noise)
    problem = define_problem(
        system,
        x + 80,
        input_bounds=(-1.0, 1.0),
        start=[(45.0, 55.0), (-55.0, -45.0)],
        dt=0.01,
        horizon=1.0,
        workspace={x: (-100.0, 100.0), y: (-100.0, 100.0)},
    )
    lowest, higher = (certified(problem, degrees=(degree,)) for degree in (6, 8))
    assert higher.mean >= lowest.mean - 1e-9
    assert lowest.mean > 0.99
    assert [a.degree for a in higher.attempts] == [6, 8]  # Degree 6 is where it begins.
    sampled = [a.candidate.mean for a in higher.attempts]
    assert sampled == sorted(sampled)


def test_a_certificate_is_checked_by_the_other_program_and_repeats_itself():
    problem = make_problem("safe_envs/Scalar-v0", horizon=0.2)
    named = Named(problem, "safe_envs/Scalar-v0", {"horizon": 0.2})
    settings = SynthesisSettings(degrees=(6,), rates=(0.0,))
    first, second = certify(named, settings), certify(named, settings)
    certificate = first.certificate
    assert certificate == second.certificate
    assert (certificate.plant.policy, certificate.horizon) == ((), Fraction(1, 5))
    assert first.mean <= first.attempts[-1].candidate.program + first.margin
    assert check(certificate, seconds=60.0).word == "checked"
    # That of the nominal controller is another one.
    nominal = certify(named, settings, policy=True)
    assert len(nominal.certificate.plant.policy) == 1
    assert 0.05 < nominal.mean < first.mean - 0.05
    assert check(nominal.certificate, seconds=60.0).word == "checked"


def test_nothing_is_certified_where_the_system_leaves_at_once():
    # From the edge of C no bound is above 0.
    found = certified(make_problem("safe_envs/Scalar-v0", start=(1.0,)), False, degrees=(4,))
    assert (found.certificate, found.mean) == (None, 0.0)


def test_starts_are_taken_within_the_period_of_an_angle():
    system = ControlAffineSDE.from_rate((x, y), (u,), [u - x, 1], diffusion=[0.3, 0])
    problems = [
        define_problem(
            system,
            1 - x**2 + sp.cos(y) / 100,
            input_bounds=(-1, 1),
            start=(0.0, angle),
            nominal=0,
            dt=0.01,
            horizon=0.2,
            workspace={x: (-2, 2)},
        )
        for angle in (0.5, 0.5 + TURN)
    ]
    near, turned = (certified(problem, degrees=(4,), rates=(0.0,)).mean for problem in problems)
    assert near == pytest.approx(turned, rel=1e-6)
    assert near > 0.1


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: SynthesisSettings(degrees=(0,)), "degree = 0"),
        (lambda: SynthesisSettings(degrees=(21,)), "degree 20"),
        (lambda: SynthesisSettings(rates=(-0.1,)), "rate"),
        (lambda: SynthesisSettings(rates=(math.nan,)), "rate"),
        (lambda: SynthesisSettings(tolerance=0.0), "tolerance"),
        (lambda: SynthesisSettings(seconds=0.0), "seconds"),
        (lambda: certified(make_problem("safe_envs/DubinsReach-v0"), degrees=(8,)), "degree"),
        (lambda: certified(make_problem("safe_envs/Quadrotor-v0")), "12 states"),
    ],
)
def test_what_is_out_of_range_or_too_large_is_refused_at_once(call, told):
    begin = time.process_time()
    with pytest.raises(ConfigurationError, match=told):
        call()
    assert time.process_time() - begin < 5.0
