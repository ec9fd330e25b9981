"""The checker of certificates, against some that are true and false by hand."""

from __future__ import annotations

import ast
import math
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.errors import ConfigurationError
from safe_envs.filters.certificates import certificate, checker
from safe_envs.filters.certificates.checker import Bands, check
from tests.filters.certificates.examples import (
    FALSE,
    TRUE,
    UNDECIDED,
    R,
    brownian,
    in_line,
    with_plant,
    x,
    y,
)


def test_it_shares_no_code_with_what_finds_certificates():
    """Nor does what it imports: the statement of a certificate, and errors."""
    text = Path(checker.__file__).read_text(encoding="utf-8")
    assert len(text.splitlines()) < 210
    for file in (checker, certificate):
        tree = ast.walk(ast.parse(Path(file.__file__).read_text(encoding="utf-8")))
        imported = {node.module for node in tree if isinstance(node, ast.ImportFrom)}
        own = {name for name in imported if name.startswith("safe_envs")}
        assert not {name for name in own if "proofs" in name or "enclosures" in name}


@pytest.mark.parametrize("name", TRUE)
def test_what_is_true_is_proved_also_by_1e_9(name):
    found = check(TRUE[name], boxes=20_000)
    assert (found.word, found.statement, found.state) == ("checked", "", None)
    assert found.boxes == sum(part.boxes for part in found.parts)


@pytest.mark.parametrize("name", FALSE)
def test_what_is_false_is_refuted_also_by_1e_9_at_a_state(name):
    found = check(FALSE[name], boxes=20_000)
    assert found.word == "refuted"
    if name != "a < 0":
        low, high = np.array(FALSE[name].plant.workspace, dtype=float).T
        assert found.state is not None
        assert np.all((low <= found.state) & (found.state <= high))


@pytest.mark.parametrize("name", UNDECIDED)
def test_what_it_cannot_know_is_undecided_with_the_reason(name):
    found = check(UNDECIDED[name], boxes=5_000)
    assert found.word == "undecided"
    part = next(part for part in found.parts if part.name == found.statement)
    assert "boxes are left" in part.reason
    assert part.state is not None


def test_limits_end_a_check_as_undecided():
    assert check(TRUE["the disk"], boxes=10).word == "undecided"
    assert check(TRUE["the disk"], seconds=0.0).word == "undecided"


@pytest.mark.oracle
def test_mean_value_forms_in_arb_agree():
    from tests.oracles import arb_certificates  # of python-flint

    assert {arb_certificates.word(each, boxes=8000) for each in TRUE.values()} == {"checked"}
    assert {arb_certificates.word(each) for each in FALSE.values()} == {"refuted"}
    assert all(arb_certificates.word(each, boxes=400) != "checked" for each in UNDECIDED.values())


def test_a_psi_that_is_a_barrier_needs_no_room_on_its_edge():
    found = in_line(["0", "1", "-1"], h=x - x**2, shortfall="1.0001", supremum="0.2501")
    assert check(found).word == "checked"
    assert [part.name for part in check(found).parts][1:] == ["psi <= c", "A psi >= -a psi - m"]
    for h in (x * (1 - x), x - x**2 / 2 - x**3 / 2):
        assert check(with_plant(found, barriers=(h,))).statement == "psi <= 0 where h_1 = 0"


def test_an_input_has_to_help_where_no_other_term_does():
    # A psi = -2 (x - 1) u - 1 for psi = 2 x - x^2 - 1/100: only 0 at x = 1.
    steered = in_line(["-0.01", "2", "-1"], h=x, shortfall="1.000001", supremum="1.1")
    steered = with_plant(steered, input_matrix=((R(1),),))
    assert check(steered).word == "checked"
    assert check(replace(steered, shortfall=Fraction("0.999999"))).word == "refuted"
    # Without an input at the other end of its bounds it is false.
    one_sided = with_plant(steered, bounds=((R(1, 2), R(1)),))
    assert check(one_sided).word == "refuted"


def test_functions_that_it_does_not_know_are_an_error():
    with pytest.raises(ConfigurationError, match="sign"):
        check(with_plant(brownian(), drift=(sp.sign(x),)))


FUNCTIONS = [
    *(sp.sin(x), sp.cos(x), sp.exp(x), sp.tanh(x), sp.atan(x), sp.Abs(x), x**2, x**3, x**-1, x**-2),
    *(sp.log(x + 3), sp.sqrt(x + 3), (x + 3) ** R(-3, 2), sp.Max(x, x**2), sp.Min(x, 1 - x, 0)),
    *(sp.sqrt(x**2 * 1 + 1) / (2 + sp.sin(3 * x)), sp.exp(sp.sin(x) * x) - x / 3, sp.pi * x),
]


@pytest.mark.parametrize("e", FUNCTIONS, ids=str)
def test_enclosures_hold_the_values(e):
    rng = np.random.default_rng(0)
    middles, radii = rng.uniform(-2, 2, 300), 10 ** rng.uniform(-9, 0, 300)
    with np.errstate(all="ignore"):
        found = Bands((x,), {}, middles[None], radii[None])[e]
    points = rng.uniform(-1, 1, (20, 300))
    points[:2] = [[-1], [1]]
    exact = sp.lambdify(x, e, "mpmath")
    for t in points[:5]:
        for k in range(0, 300, 20):
            value = exact(sp.Float(middles[k], 30) + sp.Float(t[k], 30) * sp.Float(radii[k], 30))
            linear = found.c[k] + found.b[0, k] * t[k]
            slack = 1e-15 * (1 + abs(value))
            assert found.low[k] - slack <= value <= found.high[k] + slack
            assert abs(value - linear) <= found.rho[k] + slack


def test_the_roundings_of_a_polynomial_are_held():
    binomials = {(k,): Fraction(math.comb(20, k) * (-1) ** k) for k in range(21)}
    psi = Polynomial((x,), (Fraction(0),), (Fraction(1),), binomials)  # (1 - x)^20
    middles = np.linspace(0.9, 1.1, 101)[None]
    found = Bands((x,), {x * y: psi}, middles, 0 * middles)[x * y]
    exact = [(1 - Fraction(v)) ** 20 for v in middles[0]]
    lows, highs = ([Fraction(v) for v in ends] for ends in (found.low, found.high))
    assert all(low <= v <= high for low, v, high in zip(lows, exact, highs, strict=True))
    assert found.rho.max() < 1e-6


def test_the_forms_of_a_polynomial_hold_its_derivatives():
    rng = np.random.default_rng(1)
    coefficients = {
        (i, j): Fraction(int(rng.integers(-999, 999)), 37) for i in range(9) for j in range(7)
    }
    psi = Polynomial(
        (x, y), (Fraction(1, 3), Fraction(-1, 7)), (Fraction(3, 2), Fraction(2, 3)), coefficients
    )
    middles, radii = rng.uniform(-1, 1, (2, 50)), 10 ** rng.uniform(-6, -1, (2, 50))
    orders = [(), (0,), (1,), (0, 0), (0, 1), (1, 1)]
    points = rng.uniform(-1, 1, (2, 50))
    for order in orders:
        derived = psi
        for i in order:
            derived = derived.derivative(i)
        form = Bands((x, y), {x * y: derived}, middles, radii)[x * y]
        values = derived.values((middles + points * radii).T)
        slack = 1e-10 * np.abs(values).max()
        linear = form.c + (form.b * points).sum(0)
        assert np.all(np.abs(values - linear) <= form.rho + slack)
        assert np.all((form.low - slack <= values) & (values <= form.high + slack))
        # They are of second order.
        smaller = Bands((x, y), {x * y: derived}, middles, radii / 10)[x * y]
        large = radii.min(0) > 1e-3  # roundings are less
        assert np.all(smaller.rho[large] <= form.rho[large] / 90)
