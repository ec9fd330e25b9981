"""Sine, cosine and arc tangent of compiled programs against exact values and the C library."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable

import mpmath
import numpy as np
import pytest
import sympy as sp

from safe_envs.engine.trigonometry_kernel import arc_tangent, cosine, sine
from tests.engine.test_formulas import Data, program, read, t, x, y

LIMIT = 2.0**17
INF = math.inf


def worst(function: Callable, exact: Callable, points: Iterable[tuple[float, ...]]) -> float:
    """Return the largest error, in units in the last place."""
    with mpmath.workprec(150):
        errors = []
        for point in points:
            value = exact(*(mpmath.mpf(number) for number in point))
            errors.append(abs(function(*point) - value) / math.ulp(float(value)))
        return float(max(errors))


def angles() -> list[tuple[float]]:
    rng = np.random.default_rng(1)
    spread = [rng.uniform(-r, r, 200) for r in (0.8, 4.0, LIMIT)]
    return [(float(a),) for a in np.concatenate([*spread, 10.0 ** rng.uniform(-300, 5, 100)])]


def angles_near_quarter_turns() -> list[tuple[float]]:
    rng = np.random.default_rng(2)
    turns = [*range(1, 9), *rng.integers(9, 83000, 300)]
    near = [float(k * mpmath.pi / 2) for k in turns]
    return [(a,) for b in near for a in (math.nextafter(b, 0.0), b, math.nextafter(b, INF))]


@pytest.mark.parametrize(("function", "exact"), [(sine, mpmath.sin), (cosine, mpmath.cos)])
def test_sine_and_cosine_are_right_to_a_unit_in_the_last_place(function, exact) -> None:
    assert 0.5 < worst(function, exact, angles()) < 0.95
    assert 0.4 < worst(function, exact, angles_near_quarter_turns()) < 0.6


@pytest.mark.parametrize("number", [LIMIT, -LIMIT, 1e6, 2.0**53 + 2.0, -1e22, 1e300, 1.7e308])
def test_large_angles_are_those_of_the_c_library(number) -> None:
    assert (sine(number), cosine(number)) == (math.sin(number), math.cos(number))


def test_sine_is_odd_and_cosine_even_to_the_bit() -> None:
    for (a,) in [*angles(), *angles_near_quarter_turns()]:
        assert sine(-a) == -sine(a)
        assert cosine(-a) == cosine(a)
    assert math.copysign(1.0, sine(-0.0)) == -1.0
    assert math.copysign(1.0, sine(0.0)) == 1.0
    assert cosine(0.0) == cosine(-0.0) == 1.0
    assert math.isnan(sine(math.nan))
    assert math.isnan(cosine(math.nan))


def vectors() -> list[tuple[float, float]]:
    rng = np.random.default_rng(3)
    near = rng.uniform(-1.0, 1.0, (500, 2))
    flat = near * np.column_stack([10.0 ** rng.uniform(-12, 0, 500), np.ones(500)])
    wide = near * 10.0 ** rng.uniform(-140, 140, (500, 2))
    # Here an arc tangent just below a power of 2 has twice the error of its quotient.
    k = rng.integers(1, 12, 300)
    x_hard = rng.uniform(1.0, 2.0, 300)
    hard = np.column_stack([x_hard * 0.5**k * (1.0 + rng.uniform(0, 1 / 3, 300) * 0.25**k), x_hard])
    return [(float(b), float(a)) for b, a in np.concatenate([near, flat, wide, hard])]


def test_arc_tangents_are_right_to_about_a_unit_in_the_last_place() -> None:
    assert 0.5 < worst(arc_tangent, mpmath.atan2, vectors()) < 1.1


def test_arc_tangents_are_symmetric_to_the_bit() -> None:
    for b, a in vectors():
        assert arc_tangent(-b, a) == -arc_tangent(b, a)


def test_special_arc_tangents_are_those_of_c() -> None:
    numbers = [0.0, 5e-324, 1e-310, 1.0, 1e300, 1.7e308, INF, math.nan]
    signed = [s * v for v in numbers for s in (1.0, -1.0)]
    for b, a in itertools.product(signed, repeat=2):
        found, expected = arc_tangent(b, a), math.atan2(b, a)
        assert found == pytest.approx(expected, rel=3e-16, abs=0.0, nan_ok=True)
        assert math.copysign(1.0, found) == math.copysign(1.0, expected) or expected != expected


@pytest.mark.oracle
def test_compiled_programs_have_the_same_bits() -> None:
    data = Data()
    linked = program([sp.sin(x) + 3 * sp.cos(x) + 7 * sp.atan2(y, t)], data)
    plain, compiled = linked.plain(), linked.compiled()
    points = [(*a, *v) for a, v in zip(angles(), vectors(), strict=False)]
    points += [(1e9, 0.0, -0.0), (-3e22, 1e-300, 1e300), (0.5, INF, -INF)]
    # Scalars of NumPy, which entry points read off arrays, warn of what leads to the C library.
    with np.errstate(over="ignore", invalid="ignore"):
        for point in points:
            assert read(plain, data, point) == read(compiled, data, point)
