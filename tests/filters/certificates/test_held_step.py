"""Expectations of a step under a held input: exact, against quadrature of the step itself."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.errors import ConfigurationError
from safe_envs.filters.certificates.certificate import Plant
from safe_envs.filters.certificates.held_step import HeldStep, Order, derivative, held_period
from safe_envs.registry import make_problem

X, Y, U, V = sp.symbols("x y u v", real=True)
DT = Fraction(1, 20)

NOISES = {
    "constant": ((sp.Rational(3, 10), 0), (sp.Rational(1, 5), sp.Rational(2, 5))),
    "of the state": ((X / 2, 0), (0, sp.cos(Y) / 3)),
    "correlated, of the state": ((X / 2, sp.Rational(1, 5)), (Y / 3, 1 + X / 4)),
}


def plant(noise: str, inputs: tuple[sp.Symbol, ...] = (U,)) -> Plant:
    matrix = ((sp.Integer(0),), (1 + X**2,)) if len(inputs) == 1 else ((1, 0), (0, X))
    return Plant(
        states=(X, Y),
        workspace=((sp.Integer(-2), sp.Integer(2)),) * 2,
        inputs=inputs,
        bounds=((sp.Integer(-3), sp.Integer(5)),) * len(inputs),
        drift=(Y, sp.sin(X) - Y / 2),
        input_matrix=tuple(tuple(map(sp.sympify, row)) for row in matrix),
        diffusion=tuple(tuple(map(sp.sympify, row)) for row in NOISES[noise]),
        barriers=(1 - X**2 - Y**2,),
    )


def polynomial(degree: int = 4) -> Polynomial:
    random = np.random.default_rng(3)
    keys = [k for k in itertools.product(range(degree + 1), repeat=2) if sum(k) <= degree]
    values = [Fraction(int(v), 64) for v in random.integers(-64, 64, len(keys))]
    scale = (Fraction(3, 2), Fraction(5, 4))
    return Polynomial(
        (X, Y), (Fraction(1, 10), Fraction(0)), scale, dict(zip(keys, values, strict=True))
    )


def by_quadrature(step: HeldStep, at: tuple[float, float], u: float) -> float:
    """Return E psi(F(x, u, xi)) by Gauss and Hermite, which is exact for polynomials."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(8)
    weights = weights / weights.sum()
    here = {X: at[0], Y: at[1], U: u}
    p, dt = step.plant, float(step.period)
    drift = np.array([float(f.subs(here)) for f in p.drift])
    effect = np.array([float(row[0].subs(here)) for row in p.input_matrix])
    sigma = np.array([[float(e.subs(here)) for e in row] for row in p.diffusion])
    pairs = np.array(list(itertools.product(nodes, repeat=2)))
    mean = np.array(at) + dt * (drift + effect * u)
    reached = mean + np.sqrt(dt) * pairs @ sigma.T
    return float(np.outer(weights, weights).ravel() @ step.psi.values(reached))


def evaluated(
    expression: sp.Expr, symbols: dict[sp.Symbol, tuple[Polynomial, Order]], here: dict
) -> float:
    point = np.array([[float(here[X]), float(here[Y])]])
    known = {s: derivative(p, k).values(point)[0] for s, (p, k) in symbols.items()} | here
    return float(sp.lambdify(list(known), expression, "math")(*known.values()))


@pytest.mark.parametrize("noise", NOISES)
def test_expectations_are_those_of_quadrature(noise: str) -> None:
    step = HeldStep(plant(noise), polynomial(), DT)
    assert (step.smoothed is not None) == (noise == "constant")
    table: dict[tuple[int, Order], sp.Symbol] = {}
    symbols: dict[sp.Symbol, tuple[Polynomial, Order]] = {}

    def symbol_of(p: Polynomial, order: Order) -> sp.Symbol:
        symbol = table.setdefault((id(p), order), sp.Dummy())
        symbols[symbol] = (p, order)
        return symbol

    gain, series = step.gain([U], symbol_of), step.gain_by_input(symbol_of)
    for at, u in (((0.3, -0.4), 4.5), ((-0.9, 0.2), -3.0), ((0.0, 0.0), 1.0)):
        here = {X: at[0], Y: at[1], U: u}
        exact = by_quadrature(step, at, u)
        assert evaluated(step.expectation([U]), {}, here) == pytest.approx(exact, abs=1e-11)
        change = exact - step.psi.values(np.array([at]))[0]
        assert evaluated(gain, symbols, here) == pytest.approx(change, abs=1e-11)
        scaled = (u - 1.0) / 4.0
        summed = sum(evaluated(c, symbols, here) * scaled**j for j, c in enumerate(series))
        assert summed == pytest.approx(change, abs=1e-11)


def test_constraint_is_the_chord_between_the_bounds() -> None:
    step = HeldStep(plant("of the state"), polynomial(3), DT)
    a, b = step.constraint(Fraction(1, 100))
    here = {X: 0.3, Y: 0.5}
    for bound in (-3, 5):
        level = step.psi.values(np.array([[0.3, 0.5]]))[0] - 0.01
        exact = by_quadrature(step, (0.3, 0.5), bound) - level
        assert evaluated(a * bound + b, {}, here) == pytest.approx(exact, abs=1e-11)


SCALAR = make_problem("safe_envs/Scalar-v0")
TWO = HeldStep(plant("constant", (U, V)), polynomial(2), DT)
OTHER = Polynomial((V,), (Fraction(0),), (Fraction(1),), {})


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: held_period(SCALAR.configured(substeps=2)), "substeps = 2"),
        (lambda: held_period(SCALAR.configured(noise=0.0)), "no noise"),
        (lambda: TWO.constraint(Fraction(0)), "2 inputs"),
        (lambda: TWO.gain_by_input(lambda p, k: sp.Dummy()), "2 inputs"),
        (lambda: HeldStep(plant("constant"), OTHER, DT), "polynomial of v"),
    ],
)
def test_what_has_no_held_step_is_refused(call, told) -> None:
    assert held_period(SCALAR) == Fraction(1, 100)
    with pytest.raises(ConfigurationError, match=told):
        call()
