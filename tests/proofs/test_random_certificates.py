"""Random certificates: proved numbers against samples, and their bounds against episodes."""

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
from safe_envs.filters.certificates.checker import check
from safe_envs.proofs.guarantees import judged
from safe_envs.proofs.judge import Budget

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


def _above(value):
    """A fraction in ten-thousandths that is above a number."""
    return Fraction(math.ceil(1e4 * value), 10_000)


def _word(certificate):
    """What the judge says of a certificate."""
    words = {verdict.word for _, verdict in judged(certificate, QUICK)}
    return next((word for word in ("refuted", "undecided") if word in words), "proved")


def _compared(seed, policy, checked=False):
    """Compare one random certificate; return whether it is proved and has a bound above 0."""
    rng = np.random.default_rng(seed)
    plant = _plant(rng, policy)
    psi, origin = _psi(rng, plant), (0,) * len(plant.states)
    z = rng.uniform(-1.25, 1.25, (_SAMPLES, len(plant.states)))
    edge = z / np.linalg.norm(z, axis=1)[:, None]
    lowered = psi.coefficients.get(origin, Fraction(0)) - _above(max(psi.values(edge).max(), 0.0))
    psi = replace(psi, coefficients={**psi.coefficients, origin: lowered - Fraction(1, 1000)})
    functions = _functions(plant, psi)
    values = functions(z)
    inside = (values[:, :2] > 0.0).all(axis=1)
    z, values = z[inside], values[inside]
    if len(z) < 100:
        return False
    flow = values[:, 2] + (values[:, 3:] * _input(plant, values[:, 3:], z)).sum(axis=1)
    c, m = values[:, 0].max(), max((-flow - float(RATE) * values[:, 0]).max(), 0.0)
    numbers = (RATE, _above(m + 0.1), _above(c + 0.02), Fraction(3, 10))
    certificate = BarrierCertificate("", {}, plant, psi, *numbers)
    # Numbers that a sample contradicts are proved neither by the judge nor by the checker.
    false = [replace(certificate, supremum=_above(c - 0.01))] * int(c > 0.02)
    false += [replace(certificate, shortfall=_above(m - 0.05))] * int(m > 0.06)
    assert all(_word(each) != "proved" for each in false)
    assert not checked or all(check(each, boxes=20_000).word != "checked" for each in false)
    if _word(certificate) != "proved":
        return False
    assert not checked or check(certificate, boxes=200_000).word == "checked"
    bounds = certificate.bounds_at(z, _HORIZON)
    best = int(bounds.argmax())
    rates = []
    for parts in (1, 2, 4):
        safe = _safe_episodes(plant, functions, z[best], _DT / parts, rng)
        rates.append(safe)
        upper = 1.0 if safe == _EPISODES else stats.beta.ppf(1 - ERROR, safe + 1, _EPISODES - safe)
        if bounds[best] <= upper:
            break
    else:
        pytest.fail(f"{seed}: bound {bounds[best]:.4g}, safe {rates} at shorter and shorter steps")
    return bool(bounds[best] > 0.0)


@pytest.mark.parametrize("policy", [False, True], ids=["best input", "policy"])
def test_numbers_of_random_certificates_hold(policy):
    assert _compared(1, policy, checked=True)


@pytest.mark.oracle
@pytest.mark.parametrize("policy", [False, True], ids=["best input", "policy"])
def test_numbers_of_many_random_certificates_hold(policy):
    assert sum(_compared(seed, policy) for seed in range(60)) >= 30


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
