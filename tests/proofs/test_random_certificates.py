"""Proved numbers of random polynomials against samples, and their bounds against episodes."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import sympy as sp
from scipy import stats

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.filters.certificates.certificate import BarrierCertificate, Plant
from safe_envs.proofs.guarantees import CertificateStatements, judged, rounded_up
from safe_envs.proofs.judge import Budget, supremum

x, y, u, w = sp.symbols("x y u w", real=True)
R = sp.Rational
QUICK = Budget(60_000, 60.0)
RATE = Fraction(1, 2)
_SAMPLES, _EPISODES, _DT, _HORIZON = 20_000, 2_000, 1e-3, 0.3
ERROR = 1e-5


def _drawn(rng, states, degree, size):
    """A random polynomial, with coefficients in thousandths."""
    powers = [
        p for p in itertools.product(range(degree + 1), repeat=len(states)) if sum(p) <= degree
    ]
    return sum(
        R(int(rng.integers(-1000, 1001)), 1000)
        * R(size)
        * sp.prod([s**k for s, k in zip(states, p, strict=True)])
        for p in powers
    )


def _plant(rng, policy):
    n = int(rng.integers(1, 3))
    states, inputs = (x, y)[:n], (u, w)[:n]
    one = sp.Integer(1)
    laws = tuple(_drawn(rng, states, 2, 1) for _ in inputs) if policy else ()
    return Plant(
        states=states,
        workspace=((-R(5, 4), R(5, 4)),) * n,
        inputs=inputs,
        bounds=((-one, R(3, 2)),) * n,
        drift=tuple(_drawn(rng, states, 3, R(1, 2)) for _ in states),
        input_matrix=tuple(
            tuple(one * int(i == j) + _drawn(rng, states, 1, R(1, 5)) for j in range(n))
            for i in range(n)
        ),
        diffusion=tuple(
            tuple((R(1, 2) + _drawn(rng, states, 1, R(1, 5))) * int(i == j) for j in range(n))
            for i in range(n)
        ),
        barriers=(1 - sum(s**2 for s in states),),
        policy=laws,
    )


def _psi(rng, plant):
    """The barrier with a random factor that is near 1, and a random rest."""
    factor = 1 + _drawn(rng, plant.states, 2, R(1, 5))
    made = sp.expand(plant.barriers[0] * factor + _drawn(rng, plant.states, 3, R(1, 50)))
    terms = sp.Poly(made, *plant.states).terms()
    n = len(plant.states)
    return Polynomial(
        plant.states,
        (Fraction(0),) * n,
        (Fraction(1),) * n,
        {key: Fraction(int(c.p), int(c.q)) for key, c in terms},
    )


def _functions(plant, psi):
    """psi, h, L_f psi + 1/2 tr(..) and L_g psi as functions of states (B, n), by sympy alone."""
    value = sp.expand(psi.expression)
    slopes = [sp.diff(value, s) for s in plant.states]
    free = sum(f * p for f, p in zip(plant.drift, slopes, strict=True))
    for (i, s), (j, t) in itertools.product(enumerate(plant.states), repeat=2):
        covariance = sum(a * b for a, b in zip(plant.diffusion[i], plant.diffusion[j], strict=True))
        free += covariance * sp.diff(value, s, t) / 2
    moved = [
        sum(row[j] * p for row, p in zip(plant.input_matrix, slopes, strict=True))
        for j in range(len(plant.inputs))
    ]
    entries = [value, plant.barriers[0], free, *moved]
    function = sp.lambdify([plant.states], entries, "numpy")
    return lambda z: np.stack([np.broadcast_to(e, len(z)) for e in function(z.T)], axis=1)


def _input(plant, moved, z):
    """The policy, cut to its bounds, or the input for which A psi is largest."""
    low, high = np.array(plant.bounds, dtype=float).T
    if not plant.policy:
        return np.where(moved > 0.0, high, low)
    laws = sp.lambdify([plant.states], plant.policy, "numpy")(z.T)
    return np.clip(np.stack([np.broadcast_to(e, len(z)) for e in laws], axis=1), low, high)


def _safe_episodes(plant, functions, start, dt, rng):
    """The number of Euler-Maruyama paths that stay in C up to T or leave the workspace before."""
    n = len(plant.states)
    parts = [*plant.drift, *itertools.chain(*plant.input_matrix, *plant.diffusion)]
    system = sp.lambdify([plant.states], parts, "numpy")
    z, safe, over = (
        np.tile(start, (_EPISODES, 1)),
        np.ones(_EPISODES, bool),
        np.zeros(_EPISODES, bool),
    )
    for _ in range(round(_HORIZON / dt)):
        found = np.stack([np.broadcast_to(e, len(z)) for e in system(z.T)], axis=1)
        f, rest = found[:, :n], found[:, n:].reshape(len(z), 2, n, n)
        action = _input(plant, functions(z)[:, 3:], z)
        noise = rng.standard_normal(z.shape) * math.sqrt(dt)
        step = (f + np.einsum("bij,bj->bi", rest[:, 0], action)) * dt
        z = np.where(over[:, None], z, z + step + np.einsum("bij,bj->bi", rest[:, 1], noise))
        outside = (abs(z) > 1.25).any(axis=1)
        safe &= over | outside | (functions(z)[:, 1] > 0.0)
        over |= outside | ~safe
    return int(safe.sum())


def _proved(plant, psi, rng):
    """Lower psi on the edge of C, and find the least numbers; None where they are not proved."""
    edge = rng.standard_normal((_SAMPLES, len(plant.states)))
    excess = psi.values(edge / np.linalg.norm(edge, axis=1)[:, None]).max()
    origin = (0,) * len(plant.states)
    lowered = psi.coefficients.get(origin, Fraction(0)) - rounded_up(max(excess, 0.0) + 1e-3)
    psi = replace(psi, coefficients={**psi.coefficients, origin: lowered})
    parts = CertificateStatements(plant, psi, RATE)
    region = parts.statement("G", sp.Integer(0))
    c = supremum(region, parts.value, 1e-3, QUICK).upper
    m = supremum(region, -parts.generator, 1e-3, QUICK).upper
    if not (math.isfinite(m) and 0.0 < c < math.inf):
        return None
    numbers = (RATE, rounded_up(max(m, 0.0)), rounded_up(c), Fraction(3, 10))
    certificate = BarrierCertificate("", {}, plant, psi, *numbers)
    words = [verdict.word for _, verdict in judged(certificate, QUICK)]
    assert "refuted" not in words
    return certificate if set(words) == {"proved"} else None


def _compared(seed, policy):
    """Compare one random certificate; return whether it has a bound above 0."""
    rng = np.random.default_rng(seed)
    plant = _plant(rng, policy)
    found = _proved(plant, _psi(rng, plant), rng)
    if found is None:
        return False
    functions = _functions(plant, found.psi)
    z = rng.uniform(-1.25, 1.25, (_SAMPLES, len(plant.states)))
    edge = z / np.linalg.norm(z, axis=1)[:, None]
    assert functions(edge)[:, 0].max() <= 1e-12
    values = functions(z)
    inside = (values[:, :2] > 0.0).all(axis=1)
    psi, free, moved = values[inside, 0], values[inside, 2], values[inside, 3:]
    flow = free + (moved * _input(plant, moved, z[inside])).sum(axis=1)
    most = (-flow - float(RATE) * psi).max()
    assert psi.max() <= float(found.supremum) + 1e-12
    assert most <= float(found.shortfall) + 1e-12
    # The numbers are near those of the samples, so that they tell something.
    assert psi.max() >= float(found.supremum) - 0.05
    assert max(most, 0.0) >= float(found.shortfall) - 0.2
    bounds = found.bounds_at(z[inside], _HORIZON)
    best = int(bounds.argmax())
    start = z[inside][best]
    rates = []
    for parts in (1, 2, 4):
        safe = _safe_episodes(plant, functions, start, _DT / parts, rng)
        rates.append(safe)
        upper = 1.0 if safe == _EPISODES else stats.beta.ppf(1 - ERROR, safe + 1, _EPISODES - safe)
        if bounds[best] <= upper:
            break
    else:
        pytest.fail(f"{seed}: bound {bounds[best]:.4g}, safe {rates} at shorter and shorter steps")
    return bool(bounds[best] > 0.0)


@pytest.mark.parametrize("policy", [False, True], ids=["best input", "policy"])
def test_numbers_of_random_certificates_hold(policy):
    assert all(_compared(seed, policy) for seed in (1, 6))


@pytest.mark.oracle
@pytest.mark.parametrize("policy", [False, True], ids=["best input", "policy"])
def test_numbers_of_many_random_certificates_hold(policy):
    assert sum(_compared(seed, policy) for seed in range(100)) >= 40


def test_psi_is_not_above_zero_where_an_angle_jumps():
    """x' = 1 comes round at pi, where psi = 2 + x/4 falls from 2.8 to 1.2, and grows elsewhere."""
    one = sp.Integer(1)
    plant = Plant((x,), ((-sp.pi, sp.pi),), (u,), ((-one, one),), (one,), ((0 * one,),),
                  ((0 * one,),), (one,))  # fmt: skip
    origin, unit = (Fraction(0),), (Fraction(1),)
    psi = Polynomial((x,), origin, unit, {(0,): Fraction(2), (1,): Fraction(1, 4)})
    numbers = (Fraction(0), Fraction(0), Fraction(3), Fraction(1))
    certificate = BarrierCertificate("", {}, plant, psi, *numbers)
    words = dict.fromkeys(n for n, v in judged(certificate, QUICK) if v.word == "refuted")
    assert list(words) == ["psi <= 0 where an angle jumps"]
    low = replace(plant, workspace=((-3 * one, 3 * one),))
    free = replace(certificate, plant=low)
    assert all(n != "psi <= 0 where an angle jumps" for n, _ in judged(free, QUICK))
