"""Ball matrices hold what exact arithmetic finds, and bound norms closely."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from safe_envs.enclosures.intervals import Interval
from safe_envs.proofs.backup_sets import (
    BallMatrix,
    enclosing,
    exactly,
    frobenius,
    interval_of,
    norm_bound,
    plus,
    scaled,
    times,
)

RNG = np.random.default_rng(0)


def exact(matrix):
    return [[Fraction(entry) for entry in row] for row in matrix.tolist()]


def holds(ball, matrix):
    low, high = interval_of(ball)
    return all(
        Fraction(a) <= entry <= Fraction(b)
        for lows, highs, row in zip(low.tolist(), high.tolist(), matrix, strict=True)
        for a, b, entry in zip(lows, highs, row, strict=True)
    )


def product(a, b):
    return [
        [sum(x * y for x, y in zip(row, column, strict=True)) for column in zip(*b, strict=True)]
        for row in a
    ]


def test_products_sums_and_multiples_hold_the_exact_ones():
    for _ in range(20):
        a, b = RNG.standard_normal((2, 5, 5)) * 10.0 ** RNG.integers(-8, 8, (2, 5, 5))
        assert holds(times(exactly(a), exactly(b)), product(exact(a), exact(b)))
        total = [
            [x + y for x, y in zip(*rows, strict=True)]
            for rows in zip(exact(a), exact(b), strict=True)
        ]
        assert holds(plus(exactly(a), exactly(b)), total)
        third = 1.0 / 3.0
        assert holds(
            scaled(third, exactly(a)), [[Fraction(third) * x for x in row] for row in exact(a)]
        )


def test_a_product_of_balls_holds_products_of_their_corners():
    a, b = RNG.standard_normal((2, 3, 3))
    r, s = np.abs(RNG.standard_normal((2, 3, 3)))
    ball = times(BallMatrix(a, r), BallMatrix(b, s))
    for _ in range(200):
        left, right = (c + w * RNG.choice([-1, 1], (3, 3)) for c, w in ((a, r), (b, s)))
        low, high = interval_of(ball)
        assert (low <= left @ right + 1e-12).all()
        assert (left @ right - 1e-12 <= high).all()


def test_an_interval_is_held():
    low = RNG.standard_normal((4, 3, 3))
    ball = enclosing(Interval(low, low + 0.1))
    assert (ball.center - ball.radius <= low).all()
    assert (ball.center + ball.radius >= low + 0.1).all()


def test_the_norm_is_bounded_from_above_and_closely():
    many = RNG.standard_normal((100, 6, 6)) * np.exp(RNG.standard_normal((100, 6, 6)) * 3)
    true = np.linalg.norm(many, 2, axis=(-2, -1))
    bound = norm_bound(exactly(many))
    assert (bound >= true).all()
    assert (bound <= true * (1.0 + 1e-10)).all()
    assert (frobenius(exactly(many)) >= true).all()


def test_the_norm_of_a_ball_is_at_least_that_of_its_corners():
    center, radius = RNG.standard_normal((4, 4)), np.abs(RNG.standard_normal((4, 4)))
    bound = norm_bound(BallMatrix(center, radius))
    for _ in range(500):
        corner = center + radius * RNG.choice([-1, 1], (4, 4))
        assert np.linalg.norm(corner, 2) <= bound


def test_a_norm_that_is_not_known_is_infinite():
    unknown = enclosing(Interval(np.array([[[-np.inf]], [[0.0]]]), np.array([[[np.inf]], [[1.0]]])))
    assert norm_bound(unknown).tolist()[0] == np.inf
    assert norm_bound(unknown)[1] >= 1.0
