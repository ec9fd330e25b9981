"""The judge: no false statement is proved, and true ones are that are true by little."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE
from safe_envs.dynamics.lie import generator
from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.filters.certificates.certificate import BarrierCertificate, Plant
from safe_envs.proofs.guarantees import judged
from safe_envs.proofs.judge import Budget, PolynomialPart, Statement, judge, supremum

x, y, z, u = sp.symbols("x y z u", real=True)
R = sp.Rational
MARGIN = R(1, 10**9)
QUICK = Budget(300_000, 10.0)

# Expressions with their minimum over a box, where it is a rational number.
LEAST = {
    "parabola": (x**2 - R(2, 3) * x + R(1, 9), (x,), ((-1, 2),), 0),
    "parabola of two": ((x + 2 * y - 1) ** 2 + (x - y) ** 2, (x, y), ((-3, 3), (-3, 3)), 0),
    "sin^2 + cos^2": (sp.sin(x) ** 2 + sp.cos(x) ** 2, (x,), ((-4, 4),), 1),
    "exp(x) - x - 1": (sp.exp(x) - x - 1, (x,), ((-2, 2),), 0),
    "product": (x * y, (x, y), ((-1, 1), (-1, 1)), -1),
    "saddle": (x**2 - x * y + y**2, (x, y), ((-1, 2), (-2, 1)), 0),
    "root": (sp.sqrt(1 + x**2 + y**2), (x, y), ((-1, 2), (-1, 2)), 1),
    "cosine": (sp.cos(3 * x), (x,), ((0, 2),), -1),
    "maximum": (sp.Max(x, -x / 2), (x,), ((-1, 1),), 0),
    "inverse": (x + 1 / x, (x,), ((R(1, 2), 3),), 2),
    "x log x": (x * sp.log(x), (x,), ((R(1, 10), 1),), -sp.exp(-1)),
    "quartic": (x**4 - 2 * x**2, (x,), ((-2, 2),), -1),
    "atan": (x - sp.atan(x), (x,), ((0, 1),), 0),
}


@pytest.mark.parametrize("name", LEAST)
def test_what_is_true_by_a_billionth_is_proved_and_what_is_false_by_it_refuted(name):
    expression, states, box, least = LEAST[name]
    true = Statement(name, states, box, expression - least + MARGIN)
    assert judge(true, QUICK).word == "proved"
    verdict = judge(replace(true, claim=expression - least - MARGIN), QUICK)
    assert verdict.word == "refuted"
    assert verdict.state is not None
    values = dict(zip(states, map(sp.Rational, verdict.state.tolist()), strict=True))
    assert sp.N(expression.subs(values) - least - MARGIN, 40) < 0


CIRCLE = {"zeros": (x**2 + y**2 - 1,)}
DISK = {"positive": (1 - x**2 - y**2,)}
SQUARE = ((-2, 2), (-2, 2))
CUBIC = Polynomial((x,), (Fraction(1),), (Fraction(2),), {(3,): Fraction(1), (1,): Fraction(-3)})
p, slope = sp.symbols("p q", real=True)
PARTS = {"polynomials": {p: PolynomialPart(CUBIC, (0,)), slope: PolynomialPart(CUBIC, (1,))}}
# Pairs of claims over a box and a region: one that is true, and one that is false by little.
PAIRS = {
    # On the circle x + 2 y is at most sqrt(5).
    "a curve": (SQUARE, CIRCLE, *(sp.sqrt(5) + s * R(1, 10**6) - x - 2 * y for s in (1, -1))),
    "a disk whose edge ends the claim": (SQUARE, DISK, R(11, 10) - x, R(9, 10) - x),
    "a kink of what is zero": (
        SQUARE,
        {"zeros": (1 - sp.Abs(x) - sp.Max(y, -y),)},
        R(3, 2) - x,
        R(1, 2) - x,
    ),
    "one state": (((R(1, 3), R(1, 3)),), {}, x - R(1, 3) + MARGIN, x - R(1, 3) - MARGIN),
    "a box without end": (((-sp.oo, sp.oo),), {}, x**2 + 1, 100 - x),
    # z^3 - 3 z with z = (x - 1)/2 has the minimum -2 at z = 1, and the slope (3 z^2 - 3)/2.
    "a polynomial": (((-3, 5),), PARTS, p + 2 + MARGIN, p + 2 - MARGIN),
    "its slope": (((-3, 5),), PARTS, slope + R(3, 2) + MARGIN, slope + R(3, 2) - MARGIN),
}


@pytest.mark.parametrize("name", PAIRS)
def test_what_is_true_in_a_region_is_proved_and_what_is_false_refuted(name):
    box, region, true, false = PAIRS[name]
    statement = Statement(name, (x, y)[: len(box)], box, true, **region)
    assert judge(statement, QUICK).word == "proved"
    assert judge(replace(statement, claim=false), QUICK).word == "refuted"


@pytest.mark.parametrize("scale", [R(1, 10**6), 10**6])
def test_twelve_states_of_scales_far_apart(scale):
    states = sp.symbols("x_1:13", real=True)
    widths = [scale**k for k in range(2)] * 6
    shares = [s / w for s, w in zip(states, widths, strict=True)]
    ball = 1 - sum(share**2 for share in shares)
    box = tuple((-w, w) for w in widths)
    true = Statement("ball", states, box, R(13, 12) - sum(shares) / 12, positive=(ball,))
    assert judge(true, QUICK).word == "proved"
    assert judge(replace(true, claim=R(1, 2) - ball), QUICK).word == "refuted"


def test_the_bound_of_a_supremum_is_over_all_boxes_where_bisection_ends_at_one():
    """A narrow peak of height 5 in a box that is left when another one reaches no end."""
    peak = 5 * sp.exp(-(10**12) * ((x - R(1, 3)) ** 2 + (y - R(1, 7)) ** 2 + (z - R(1, 11)) ** 2))
    region = Statement("line", (x, y, z), ((0, sp.oo), (0, 1), (0, 1)), sp.Integer(1))
    found = supremum(region, peak + sp.sin(x) * sp.cos(x), 1e-3, QUICK)
    assert found.upper > 5.3
    assert found.lower <= 5.0 + 0.5


def _certificate(psi, barrier, drift, effect=0, policy=(), rate=Fraction(101, 100)):
    """Of x' = drift + effect u on [-2, 2], with c = 3.1 and m = .01."""
    one = sp.Integer(1)
    coefficients = {(k,): Fraction(int(c)) for (k,), c in sp.Poly(psi, x).terms()}
    plant = Plant(
        states=(x,),
        workspace=((-2 * one, 2 * one),),
        inputs=(u,),
        bounds=((-one, one),),
        drift=(drift * one,),
        input_matrix=((effect * one,),),
        diffusion=((0 * one,),),
        barriers=(barrier,),
        policy=tuple(p * one for p in policy),
    )
    made = Polynomial((x,), (Fraction(0),), (Fraction(1),), coefficients)
    numbers = (Fraction(rate), Fraction(1, 100), Fraction(31, 10), Fraction(2))
    return BarrierCertificate("", {}, plant, made, *numbers)


@pytest.mark.parametrize(
    "barrier",
    [
        1 / x,
        sp.tanh(1 / x),
        sp.exp(1 / x) - 1,
        sp.coth(x),
        1 / x**3,
        x / sp.Abs(x),
        x / sp.sqrt(x**2),
        sp.sign(x),
        sp.sign(x) - R(1, 2),
        sp.floor(x) + R(1, 2),
    ],
    ids=str,
)
def test_a_barrier_that_changes_its_sign_without_a_zero_has_an_edge_there(barrier):
    """x' = -1 leaves C = (0, 2) at x = 0 for certain, where psi = 1 + x is 1."""
    certificate = _certificate(1 + x, barrier, drift=-1)
    words = {name: verdict.word for name, verdict in judged(certificate, Budget(20_000, 5.0))}
    assert words["psi <= c"] == words["A psi >= -a psi - m"] == "proved"
    assert words["psi <= 0 on the edge of C"] != "proved"
    assert certificate.bounds_at(np.array([[1.9]]))[0] > 0.1


def test_a_policy_is_cut_to_the_bounds_of_its_input():
    """x' = -5 + u with u = 10 falls where |u| is at most 1."""
    words = [
        verdict.word
        for _, verdict in judged(_certificate(x, x, drift=-5, effect=1, policy=(10,), rate=0))
    ]
    assert words[1] == "refuted"


@pytest.mark.parametrize("change", [{"rate": -1}, {"shortfall": -1}, {"supremum": 0}])
def test_numbers_out_of_the_theorem_are_refuted(change):
    certificate = _certificate(x, x, drift=1)
    assert {v.word for _, v in judged(certificate, Budget(2_000, 1.0))} == {"proved"}
    changed = replace(certificate, **{name: Fraction(v) for name, v in change.items()})
    (verdict,) = (verdict for _, verdict in judged(changed))
    assert verdict.word == "refuted"


def test_a_sign_that_changes_at_a_pole_refutes_nothing():
    nowhere = Statement("pole", (x,), ((-1, 2),), sp.Integer(-1), zeros=(1 / x,))
    assert judge(nowhere, Budget(20_000, 5.0)).word != "refuted"


@pytest.mark.parametrize("exponent", [1 + R(1, 10**16), 2 + R(1, 10**16), R(1, 2) + R(1, 10**17)])
def test_an_exponent_that_rounds_to_a_simple_one_is_none(exponent):
    simple = R(round(2 * float(exponent)), 2)
    # x^(10^-16) is 1 + 6.9e-14 at 1e300.
    claim = x**simple * (1 + R(1, 10**14) * (exponent - simple) * 10**16) - x**exponent
    place = 10**140
    assert sp.N(claim.subs(x, place), 40) < 0
    assert judge(Statement("power", (x,), ((place, place),), claim)).word != "proved"


def test_an_exponent_between_floats_on_both_sides_of_zero_has_a_value():
    exponent = sp.pi / R("3.141592653589793238")
    statement = Statement("power", (x,), ((1, 2),), x**exponent - R(9, 10))
    assert judge(statement).word == "proved"


def test_hints_out_of_the_box_tell_nothing():
    statement = Statement("unit", (x,), ((0, 1),), R(11, 10) - x)
    assert judge(statement, hints=np.array([[2.0], [np.nan]])).word == "proved"
    assert supremum(statement, x, 1e-6, hints=np.array([[2.0]])).lower <= 1.0


def test_hints_refute_at_once():
    statement = Statement("needle", (x, y), ((-1, 1), (-1, 1)), (x - y) ** 2 - R(1, 10**12))
    verdict = judge(statement, hints=np.array([[0.5, -0.5], [0.25, 0.25]]))
    assert (verdict.word, verdict.boxes) == ("refuted", 0)
    np.testing.assert_array_equal(verdict.state, [0.25, 0.25])


@pytest.mark.parametrize("number", [sp.nan, sp.zoo, sp.I, sp.sqrt(-2)])
def test_what_is_no_real_number_is_undecided_with_a_reason(number):
    verdict = judge(Statement("number", (x,), ((0, 1),), x + number))
    assert (verdict.word, bool(verdict.reason)) == ("undecided", True)


def test_an_empty_region_has_no_state_where_a_claim_fails():
    empty = Statement("empty", (x,), ((-5, 5),), sp.Integer(-1), positive=(-1 - x**2,))
    assert judge(empty).word == "proved"
    assert supremum(empty, x, 1e-3).upper == -np.inf


def test_an_endless_region_is_undecided_with_a_reason_where_it_is_not_proved():
    claim = 1 - x + sp.sin(x) ** 2 + x**2 * (1 - sp.cos(x) ** 2 / 2)
    verdict = judge(Statement("line", (x,), ((-sp.oo, sp.oo),), claim), QUICK)
    assert verdict.word in ("proved", "undecided")
    assert bool(verdict.reason) == (verdict.word == "undecided")


def test_a_budget_of_boxes_ends_the_search():
    hard = Statement("hard", (x, y, z), ((-1, 1),) * 3, x**2 + y**2 + z**2 - x * y - y * z - z * x)
    verdict = judge(hard, Budget(boxes=20_000, seconds=60.0))
    assert verdict.word == "undecided"
    assert 20_000 <= verdict.boxes <= 30_000


def test_a_witness_may_be_chosen_on_each_box():
    claim = x * u - R(1, 10) * x**2 + R(1, 100)
    chosen = Statement(
        "input",
        (x,),
        ((-1, 1),),
        claim,
        witnesses=(u,),
        witness=lambda middle: np.sign(middle),
    )
    assert judge(chosen).word == "proved"
    assert judge(replace(chosen, witness=lambda middle: -np.sign(middle))).word != "proved"


BROWNIAN = ControlAffineSDE.from_rate((x,), (u,), [0], diffusion=[1])
SINE = sp.sin(x)


def _eigenfunction(rate):
    """A psi >= -a psi for psi = sin(x) on (0, pi), where Brownian motion has A psi = -psi/2."""
    effect = BROWNIAN.exact(generator(BROWNIAN, SINE))
    return Statement("sine", (x,), ((0, sp.pi),), effect + rate * SINE, positive=(SINE,))


def test_the_eigenfunction_of_brownian_motion_gives_a_bound_below_the_exact_rate():
    assert judge(_eigenfunction(R(1, 2))).word == "proved"
    # At the ends psi and the claim are 0 both, which a shortfall tells apart from below 0.
    faster = _eigenfunction(R(1, 2) + MARGIN)
    assert judge(replace(faster, claim=faster.claim + R(1, 10**12))).word == "proved"
    assert judge(_eigenfunction(R(1, 2) - MARGIN)).word == "refuted"
    top = supremum(_eigenfunction(R(1, 2)), SINE, 1e-9)
    assert 1.0 <= top.upper <= 1.0 + 1e-8
    starts = np.linspace(0.05, 3.1, 40)
    odd = np.arange(1, 400, 2)[:, None]
    for horizon in (0.01, 0.1, 1.0, 5.0):
        # The series of the heat equation with the value 0 at both ends, from 1 everywhere.
        modes = np.sin(odd * starts) * np.exp(-(odd**2) * horizon / 2) * 4 / (np.pi * odd)
        bound = np.sin(starts) / top.upper * np.exp(-horizon / 2)
        assert (bound <= modes.sum(axis=0)).all()


def _random_statement(random):
    """A smooth claim in two states within a region, of size about 1."""
    a, b, c, d, e, f = np.round(random.normal(0, 1, 6), 3).tolist()
    inner = a * x + b * y + c * x * y
    claim = sp.sin(inner) + d * x**2 + e * sp.exp(-(y**2)) + f * sp.sqrt(1 + inner**2)
    region = sp.cos(d * x + y) + R(1, 2) - x * y / 3
    return claim, region


@pytest.mark.parametrize("count", [3, pytest.param(300, marks=pytest.mark.oracle)])
def test_random_statements_against_dense_samples(count):
    random = np.random.default_rng(7)
    grid = np.linspace(-2, 2, 301)
    first, second = (part.ravel() for part in np.meshgrid(grid, grid))
    words = []
    for _ in range(count):
        claim, region = _random_statement(random)
        values, depth = (
            np.broadcast_to(sp.lambdify((x, y), e, "numpy")(first, second), first.shape)
            for e in (claim, region)
        )
        least = values[depth > 0].min()
        statement = Statement("random", (x, y), ((-2, 2), (-2, 2)), claim, positive=(region,))
        # Of the least of the samples, the least value of all is at most that.
        for offset in (1e-6, -0.05):
            moved = replace(statement, claim=claim - R(float(least)) - R(repr(offset)))
            verdict = judge(moved, Budget(30_000, 5.0))
            words.append(verdict.word)
            if offset > 0:
                assert verdict.word == "refuted"
            if verdict.word == "refuted":
                state = dict(zip((x, y), map(sp.Rational, verdict.state.tolist()), strict=True))
                assert moved.claim.subs(state).evalf(30) < 0
                assert region.subs(state).evalf(30) > 0
        top = supremum(statement, claim, 1e-3, Budget(30_000, 5.0))
        highest = values[depth > 0].max()
        assert top.lower <= top.upper
        assert highest <= top.upper + 1e-12
        if not top.reason:
            assert top.upper <= top.lower + 1e-3 + 1e-9
        assert top.lower <= highest + 0.05
    # The samples miss the least value by less than .05, so that all of these are proved.
    assert words[1::2].count("proved") >= 0.9 * count
