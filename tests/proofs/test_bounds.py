"""The bounds against exact laws."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import norm

from safe_envs.proofs.guarantees import stage_bound, union_bound

TIMES = np.array([0.01, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0])


def killed_on_an_interval(x, time, s):
    """P(Brownian motion of variance s^2 t from x stays in (0, pi) up to a time), a sine series."""
    k = np.arange(1, 400, 2)
    return float((4 / (math.pi * k) * np.sin(k * x) * np.exp(-0.5 * (k * s) ** 2 * time)).sum())


def inside_with_no_drift_of_h(x, time, s):
    """P(|x| < 1 up to a time) for dx = -s^2 x/2 dt + s x dW, so that A h = 0 for h = 1 - x^2: log x
    is Brownian with drift -s^2."""
    a, root = -math.log(x), s * math.sqrt(time)
    return norm.cdf((a + s**2 * time) / root) - math.exp(-2 * a) * norm.cdf(
        (-a + s**2 * time) / root
    )


def above_zero_with_drift(h, time, m, s):
    """P(h - m t + s W stays above 0 up to a time)."""
    root = s * math.sqrt(time)
    return norm.cdf((h - m * time) / root) - math.exp(2 * m * h / s**2) * norm.cdf(
        (-h - m * time) / root
    )


@pytest.mark.parametrize("x", [0.05, 0.3, 0.7, 0.95])
def test_the_bound_for_ever_is_attained(x):
    bound = stage_bound(1 - x**2, 1.0)
    laws = [inside_with_no_drift_of_h(x, time, 0.7) for time in TIMES]
    assert all(law >= bound - 1e-12 for law in laws)
    assert inside_with_no_drift_of_h(x, 1e6, 0.7) == pytest.approx(float(bound), abs=1e-9)


@pytest.mark.parametrize("s", [0.5, 1.0, 2.0, 3.0])
@pytest.mark.parametrize("x", [0.2, 1.0, math.pi / 2, 2.9])
def test_the_bound_with_a_rate_holds_for_an_eigenfunction(x, s):
    k = s**2 / 2
    for time in TIMES:
        bound = stage_bound(math.sin(x), 1.0, time, rate=k)
        assert killed_on_an_interval(x, time, s) >= bound - 1e-9
    # Late, only the first term of the series is left: the rate of the bound is the true one.
    late = 5 / k
    assert killed_on_an_interval(x, late, s) == pytest.approx(
        4 / math.pi * float(stage_bound(math.sin(x), 1.0, late, rate=k))
    )


@pytest.mark.parametrize("s", [0.3, 1.0])
@pytest.mark.parametrize("x", [0.0, 0.4, -0.9])
def test_the_bound_with_a_shortfall_holds_for_brownian_motion(x, s):
    # h = 1 - x^2 has A h = -s^2 everywhere: the condition A h >= 0 is missed by m = s^2.
    for time in TIMES:
        law = killed_on_an_interval(math.pi * (x + 1) / 2, time, s * math.pi / 2)
        assert law >= stage_bound(1 - x**2, 1.0, time, shortfall=s**2) - 1e-9
    late = 3 / s**2
    assert killed_on_an_interval(math.pi * (x + 1) / 2, late, s * math.pi / 2) < stage_bound(
        1 - x**2, 1.0
    )


def test_an_unbounded_barrier_has_no_bound():
    # ACC with A h = 0: h is Brownian, and leaves for sure in the end; h/c would be false for every
    # finite c.
    h, spread = 123.0, 1.8
    assert above_zero_with_drift(h, 1e9, 0.0, spread) < 0.01
    assert above_zero_with_drift(h, 100.0, 0.0, spread) == pytest.approx(
        1 - 2 * norm.cdf(-h / (spread * 10.0))
    )
    assert stage_bound(h, math.inf) == 0.0
    assert stage_bound(h, math.inf, 10.0, shortfall=1.0) == 0.0
    assert union_bound([h, 1.0], [math.inf, 1.0]) == 0.0


@pytest.mark.parametrize("time", TIMES)
def test_union_bound_of_two_barriers_holds_for_independent_motions(time):
    x, y, s, t = 1.2, 0.8, 0.5, 0.3
    law = killed_on_an_interval(x, time, s) * killed_on_an_interval(y, time, t)
    bound = union_bound([math.sin(x), math.sin(y)], [1.0, 1.0], time, rates=(s**2 / 2, t**2 / 2))
    assert law >= bound - 1e-9


def test_stage_bound_is_the_formula_and_continuous_in_the_rate():
    b, c, time, m = 0.9, 1.3, 2.0, 0.05
    for a in (1e-12, 1e-6, 0.4, 3.0):
        formula = (b - m * math.expm1(a * time) / a) * math.exp(-a * time) / c
        assert stage_bound(b, c, time, a, m) == pytest.approx(max(formula, 0.0), rel=1e-9)
    at_0 = float(stage_bound(b, c, time, 0.0, m))
    assert stage_bound(b, c, time, 1e-13, m) == pytest.approx(at_0, rel=1e-9)
    # For ever only without a rate and a shortfall.
    assert stage_bound(1.0, 2.0) == 0.5
    assert stage_bound(1.0, 2.0, rate=0.1) == 0.0
    assert stage_bound(1.0, 2.0, shortfall=0.1) == 0.0


def test_the_union_over_stages():
    b, c = np.array([[0.9, 0.8], [0.5, 0.4], [-0.1, 1.0]]), [1.0, 1.0]
    np.testing.assert_allclose(union_bound(b, c), [0.7, 0.0, 0.0])
    finite = union_bound(b[0], c, 0.5, (0.1, 0.2), (0.0, 0.3))
    assert finite == pytest.approx(
        0.9 * math.exp(-0.05) + 0.8 * math.exp(-0.1) - 0.3 * (1 - math.exp(-0.1)) / 0.2 - 1
    )


def test_bounds_are_probabilities_and_nothing_outside():
    b = np.linspace(-3.0, 3.0, 61)
    for values in (
        stage_bound(b, 2.0),
        stage_bound(b, 2.0, 1.0, 0.5, 0.2),
        union_bound(np.stack([b, b], axis=1), [2.0, 3.0]),
    ):
        assert ((values >= 0.0) & (values <= 1.0)).all()
        assert (values[b <= 0.0] == 0.0).all()
