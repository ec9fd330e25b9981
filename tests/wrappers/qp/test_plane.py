"""Several rows and two inputs, against enumeration, exact rational arithmetic and the optimality
conditions."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
import scipy.optimize

from safe_envs.engine.qp import bounded_least_squares, plane
from safe_envs.engine.qp.dispatch import project_arrays
from tests.oracles.plane_oracles import (
    EPS,
    HIGH,
    LOW,
    dot,
    least_sum_oracle,
    many,
    nearest_oracle,
    one,
    random_batch,
    terms,
)

KINDS = ["plain", "sizes", "flat", "integers", "thousands", "endless", "far"]
SIZES = [40, pytest.param(1000, marks=pytest.mark.oracle)]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("k", [2, 3, 4, 6])
def test_equals_enumeration_where_the_rows_can_be_met(kind, k, size):
    problem = random_batch(np.random.default_rng(10 * k + len(kind)), size, k, kind)
    u, margin, active, feasible = many(*problem, [1.0] * k)
    a, b, v, low, high, w = problem
    best = nearest_oracle(*problem)
    np.testing.assert_array_equal(feasible, ~np.isnan(best[:, 0]))
    assert 0.05 * size < np.count_nonzero(feasible) < size or kind == "endless"
    met = feasible
    root = np.sqrt(w[met])
    reach = (root * np.abs(best[met])).max(axis=1) + 1e-9 * (root * np.abs(v[met])).max(axis=1)
    assert np.all(root * np.abs(u[met] - best[met]) <= 1e-9 * reach[:, None])
    noise = (np.abs(a) / np.sqrt(w)[:, None, :]).sum(axis=2) * (np.sqrt(w) * np.abs(u)).max(axis=1)[
        :, None
    ] + np.abs(b)
    assert np.all(margin[met] >= -16 * EPS * noise[met])
    idle = np.all(dot(a, np.clip(v, low, high)) + b >= 0.0, axis=1)
    assert not active[idle].any()
    np.testing.assert_array_equal(active[~idle], (margin <= 1e-12 * noise)[~idle])


@pytest.mark.parametrize("kind", ["plain", "sizes", "thousands"])
def test_multipliers_certify_the_nearest_action(kind):
    a, b, v, low, high, w = random_batch(np.random.default_rng(7), 150, 4, kind)
    u, _, active, feasible = many(a, b, v, low, high, w, [1.0] * 4)
    checked = 0
    for i in np.flatnonzero(feasible & active.any(axis=1)):
        normals = [row / np.abs(row / np.sqrt(w[i])).max() for row in a[i][active[i]]]
        for j in (0, 1):
            near = 1e-12 * np.abs(u[i, j])
            at = int(u[i, j] <= low[i, j] + near) - int(u[i, j] >= high[i, j] - near)
            normals.append(at * np.eye(2)[j] * np.sqrt(w[i, j]))
        pull = np.sqrt(w[i]) * (u[i] - v[i])
        _, residual = scipy.optimize.nnls((np.array(normals) / np.sqrt(w[i])).T, pull)
        assert residual <= 1e-9 * np.linalg.norm(pull)
        checked += 1
    assert checked > 20


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("k", [2, 3, 5])
def test_unmet_rows_give_the_least_sum_and_then_the_nearest_action(kind, k, size):
    rng = np.random.default_rng(20 * k + len(kind))
    a, b, v, low, high, w = random_batch(rng, size, k, kind)
    if kind == "sizes":  # the reference is a sum of squares, where the least row must not drown
        shrink = (1.0 + np.abs(a).max(axis=2)) ** 0.7
        a, b = a / shrink[:, :, None], b / shrink
    b -= (
        rng.exponential(size=b.shape)
        * np.abs(a).max(axis=2)
        * (high - low).min(axis=1, keepdims=True).clip(max=1.0)
    )
    priority = 10.0 ** rng.uniform(-2, 2, k)
    u, margin, active, feasible = many(a, b, v, low, high, w, priority.tolist())
    unmet = np.flatnonzero(~feasible)
    assert unmet.size > 0.05 * size
    slack = np.maximum(-margin[unmet], 0.0)
    found = (priority * slack**2).sum(axis=1)
    if kind != "endless":  # pinv loses its way in a box of 1e100
        least = least_sum_oracle(a[unmet], b[unmet], low[unmet], high[unmet], priority)
        assert np.all(found <= least * (1 + 1e-9))
        assert np.all(least <= found * (1 + 1e-9))
    for i, value in zip(unmet, found, strict=True):
        fit = bounded_least_squares.least_violating(
            a[i], b[i], low[i], high[i], priority, np.clip(v[i], low[i], high[i])
        )
        assert value <= (priority * np.minimum(a[i] @ fit + b[i], 0.0) ** 2).sum() * (1 + 1e-9)
    assert np.all(active[unmet][slack > 1e-9])
    nearest = nearest_oracle(
        a[unmet], b[unmet] + slack, v[unmet], low[unmet], high[unmet], w[unmet]
    )
    distance, shortest = [
        np.sqrt((w[unmet] * (end - v[unmet]) ** 2).sum(axis=1)) for end in (u[unmet], nearest)
    ]
    assert np.all((distance <= shortest * (1 + 1e-6) + 1e-9) | np.isnan(shortest))
    assert np.count_nonzero(np.isnan(shortest)) <= 0.3 * unmet.size


@pytest.mark.parametrize("kind", ["plain", "flat", "far"])
def test_forces_of_unmet_rows_balance(kind):
    rng = np.random.default_rng(5)
    a, b, v, low, high, w = random_batch(rng, 120, 3, kind)
    b -= 1.0
    priority = np.array([1.0, 30.0, 0.2])
    u, margin, _, feasible = many(a, b, v, low, high, w, priority.tolist())
    slack = priority * np.maximum(-margin, 0.0)
    force = np.einsum("ni,nij->nj", slack, a)
    noise = np.einsum("ni,nij->nj", 1e-12 * slack + 4 * EPS * priority * terms(a, b, u), np.abs(a))
    held = np.where(force > 0.0, u == high, u == low)
    assert np.all(held | (np.abs(force) <= noise) | feasible[:, None])
    assert np.count_nonzero(~feasible) > 40


def exact_nearest(a, b, v, low, high, w):
    """The minimiser in rational arithmetic; None where no action meets the rows."""
    rows = [[*map(Fraction, r), Fraction(c)] for r, c in zip(a, b, strict=True)]
    for j in (0, 1):
        unit = [Fraction(int(j == 0)), Fraction(int(j == 1))]
        rows += [[*unit, -Fraction(low[j])], [-unit[0], -unit[1], Fraction(high[j])]]
    v, w = list(map(Fraction, v)), list(map(Fraction, w))
    points = [tuple(v)]
    for r in rows:
        square = r[0] ** 2 / w[0] + r[1] ** 2 / w[1]
        multiplier = -(r[0] * v[0] + r[1] * v[1] + r[2]) / square
        points.append((v[0] + multiplier * r[0] / w[0], v[1] + multiplier * r[1] / w[1]))
    for r, s in itertools.combinations(rows, 2):
        if cross := r[0] * s[1] - r[1] * s[0]:
            points.append(
                ((s[2] * r[1] - r[2] * s[1]) / cross, (r[2] * s[0] - s[2] * r[0]) / cross)
            )
    met = [p for p in points if all(r[0] * p[0] + r[1] * p[1] + r[2] >= 0 for r in rows)]
    return min(
        met,
        key=lambda p: sum(wj * (pj - vj) ** 2 for wj, pj, vj in zip(w, p, v, strict=True)),
        default=None,
    )


@pytest.mark.parametrize("angle", [1e-3, 1e-6, 1e-9])
def test_near_parallel_rows_equal_rational_arithmetic(angle):
    rng = np.random.default_rng(int(-np.log10(angle)))
    seen, crossed = set(), 0
    for _ in range(80):
        a = (rng.normal(size=2) + angle * rng.normal(size=(3, 2))) * rng.choice([-1.0, 1.0], (3, 1))
        b = -(a @ rng.uniform(-0.9, 0.9, 2)) + angle * rng.normal(size=3)
        v, w = rng.normal(size=2) * 2, rng.uniform(0.5, 2.0, 2)
        u, margin, active, feasible = one(a.tolist(), b.tolist(), v.tolist(), w=w.tolist())
        best = exact_nearest(a.tolist(), b.tolist(), v.tolist(), LOW, HIGH, w.tolist())
        seen.add(feasible)
        assert feasible == (best is not None)
        assert np.all(np.isfinite(u))
        if best is not None:
            # A crossing at this angle moves by the rounding of the rows over the angle.
            np.testing.assert_allclose(u, [float(p) for p in best], atol=100 * EPS / angle)
            assert min(margin) >= -16 * EPS
            crossed += sum(active) == 2
    assert seen == {True, False}
    assert crossed > 3


def test_near_parallel_rows_that_contradict_share_the_miss():
    for angle in (1e-4, 1e-7, 1e-9, 0.0):
        u, margin, active, feasible = one([[1.0, 0.0], [-1.0, angle]], [-0.6, -0.2], [0.0, 0.3])
        best = scipy.optimize.minimize_scalar(
            lambda y, angle=angle: 0.5 * (0.8 - angle * y) ** 2,
            bounds=LOW[1:] + HIGH[1:],
            method="bounded",
        )
        assert np.sum(np.minimum(margin, 0.0) ** 2) <= best.fun + 1e-14
        assert (active, feasible) == ([True, True], False)
        assert u[0] == pytest.approx(0.2, abs=2 * angle + 1e-15)
        assert u[1] == (
            1.5 if angle > 1e-8 else pytest.approx(0.3, abs=1e-9) if angle == 0.0 else u[1]
        )


def test_duplicates_of_any_size_and_opposite_rows_meet_on_a_line():
    for size in (1.0, 3.0, 0.1, 1e-3, 1e6):
        a, b = [[0.7, 0.1], [0.7 * size, 0.1 * size]], [-0.3, -0.3 * size]
        foot = 0.3 / 0.5
        u, _, active, feasible = one(a, b, [0.0, 0.0])
        np.testing.assert_allclose(u, [0.7 * foot, 0.1 * foot], rtol=1e-14)
        assert (active, feasible) == ([True, True], True)
        u, _, active, feasible = one([a[0], [-x for x in a[1]]], [b[0], -b[1]], [1.0, 0.9])
        off = (0.7 + 0.09 - 0.3) / 0.5
        np.testing.assert_allclose(u, [1.0 - 0.7 * off, 0.9 - 0.1 * off], rtol=1e-13)
        assert (active, feasible) == ([True, True], True)


def test_three_rows_through_one_point_and_a_corner_of_the_box():
    rng = np.random.default_rng(2)
    for point in (np.array([0.3, -0.7]), np.array([1.0, 1.5])):
        for _ in range(40):
            angle = (
                rng.uniform(0, 2 * np.pi) + np.array([0.0, 2.0, 4.0]) + rng.uniform(-0.3, 0.3, 3)
            )
            a = np.stack([np.cos(angle), np.sin(angle)], axis=1) * 10.0 ** rng.uniform(
                -3, 6, (3, 1)
            )
            v = rng.normal(size=2) * 0.4
            u, _, active, feasible = one(a.tolist(), (-(a @ point)).tolist(), v.tolist())
            np.testing.assert_allclose(u, point, atol=1e-13)
            assert (active, feasible) == ([True] * 3, True)
            _, _, _, feasible = one(
                a.tolist(),
                (-(a @ point) - 1e-12 * np.abs(a).max(axis=1)).tolist(),
                rng.normal(size=2).tolist(),
            )
            assert not feasible


def test_unreachable_corner_is_exactly_the_corner():
    u, _, active, feasible = one(
        [[1.0, 0.2], [0.4, 1.0], [0.5, 0.5]], [-3.0, -3.0, -2.0], [0.0, 0.0]
    )
    assert (u, active, feasible) == (HIGH, [True] * 3, False)


def test_flat_row_leaves_the_others_their_say():
    for value, feasible in ((0.5, True), (-0.5, False)):
        u, _, active, met = one([[0.0, 0.0], [1.0, 0.0]], [value, -0.5], [0.0, 0.2])
        assert (u, active, met) == ([0.5, 0.2], [not feasible, True], feasible)
    assert one([[0.0, 0.0], [0.0, 0.0]], [-1.0, 0.0], [3.0, 0.2])[0] == [1.0, 0.2]


def test_of_equal_actions_the_nearest():
    # The first two rows contradict along u_1 and leave u_2 free; the third, which can be met,
    # bounds it.
    a, b = [[1.0, 0.0], [-1.0, 0.0], [0.0, -1.0]], [-0.5, 0.1, 0.4]
    for v2, u2 in ((0.2, 0.2), (0.9, 0.4), (-7.0, -1.0)):
        u, _, active, feasible = one(a, b, [0.0, v2])
        np.testing.assert_allclose(u, [0.3, u2], atol=1e-15)
        assert (active[:2], feasible) == ([True, True], False)


def test_row_of_higher_priority_gives_way_by_as_much_less():
    _, margin, _, feasible = one(
        [[1.0, 0.3], [-1.0, -0.3]], [-0.5, 0.0], [0.0, 0.0], priority=[1e4, 1.0]
    )
    assert not feasible
    assert margin[0] / margin[1] == pytest.approx(1e-4, rel=1e-9)


def test_steep_row_is_a_wall_to_a_flat_one():
    # Slacks count in the rows' own units: the steep row misses by far less than its rounding, the
    # other one slides along it.
    for steep in (1e6, 1e9):
        u, margin, _, feasible = one(
            [[-steep, -steep], [1e-3, -1e-3], [1e-3, 0.0]], [0.0, -2e-4, -5e-3], [0.0, 0.0]
        )
        reference = scipy.optimize.minimize_scalar(
            lambda s: np.maximum(2e-4 - 2e-3 * s, 0.0) ** 2 + np.maximum(5e-3 - 1e-3 * s, 0.0) ** 2,
            bounds=(-1, 1),
            method="bounded",
        )
        assert np.sum(np.minimum(margin[1:], 0.0) ** 2) <= reference.fun * (1 + 1e-5)
        np.testing.assert_allclose(u, [1.0, -1.0], atol=1e-9)
        assert not feasible


def test_step_that_meets_a_wall_slides_along_it(monkeypatch):
    def unexpected(*_):
        raise AssertionError("the fallback is not needed here")

    monkeypatch.setattr(bounded_least_squares, "least_violating", unexpected)
    a, b = [[-235515.086, -123224.314], [0.0021163, -0.0110864]], [40517.378, -0.0148531]
    u, _, active, feasible = one(a, b, [0.0, 0.0], priority=[20.5, 0.08])
    np.testing.assert_allclose(u, [(40517.378 + 123224.314) / 235515.086, -1.0], rtol=1e-12)
    assert (active, feasible) == ([True, True], False)
    # Towards an endless edge and towards the near one the first row misses nothing: the near one it
    # is.
    u, _, _, feasible = one(
        [[0.8, -1.0], [-0.65, -1.0]], [-1.3, 0.1], [0.0, 0.0], [0.0, 0.0], [1e100, 1e100]
    )
    np.testing.assert_allclose(u, [(0.8 * 1.3 + 0.65 * 0.1) / (0.8**2 + 0.65**2), 0.0], rtol=1e-12)
    assert not feasible


def test_fallback_finds_the_same_minimisers(monkeypatch):
    rng = np.random.default_rng(6)
    a, b, v, low, high, w = random_batch(rng, 60, 3, "plain")
    b -= 1.5
    newton, *_ = many(a, b, v, low, high, w, [1.0, 5.0, 0.3])
    monkeypatch.setattr(plane, "_STEPS", 0)
    fallback, _, _, feasible = many(a, b, v, low, high, w, [1.0, 5.0, 0.3])
    assert np.count_nonzero(~feasible) > 30
    np.testing.assert_allclose(fallback, newton, atol=1e-9)


def test_batch_does_not_couple_its_states():
    rng = np.random.default_rng(9)
    k = 9
    a, b, v, low, high, w = random_batch(rng, 150, k, "sizes")
    b += 0.6 * np.abs(a).max(axis=2)
    u, _, _, feasible = many(a, b, v, low, high, w, [1.0] * k)
    assert 20 < np.count_nonzero(feasible) < 130
    order = rng.permutation(150)[:70]
    some, *_ = many(a[order], b[order], v[order], low[order], high[order], w[order], [1.0] * k)
    np.testing.assert_array_equal(some, u[order])


def test_numbers_beside_arrays():
    a = [[np.array([1.0, 2.0]), 0.5], [-1.0, 0.0]]
    u, margin, active, feasible = project_arrays(
        a,
        [-0.5, np.array([0.9, 0.9])],
        [np.zeros(2), np.zeros(2)],
        LOW,
        HIGH,
        [1.0, 1.0],
        [1.0, 1.0],
    )
    for i, slope in enumerate((1.0, 2.0)):
        expected = one([[slope, 0.5], [-1.0, 0.0]], [-0.5, 0.9], [0.0, 0.0])
        assert (
            [c[i] for c in u],
            [c[i] for c in margin],
            [c[i] for c in active],
            feasible[i],
        ) == expected


def test_slack_variable_of_any_scale_spoils_no_other_row():
    # The joint program of a goal and a barrier: e in [0, 1] is the share of the goal's slack, D its
    # size, with weight p D^2.
    rng = np.random.default_rng(8)
    size = 300
    scale, weight = 10.0 ** rng.uniform(-10, 9, size), 10.0 ** rng.uniform(-4, 4, size)
    gain = rng.normal(size=size) * 10.0 ** rng.uniform(-3, 1, size) * np.minimum(scale, 1.0)
    full = scale + np.abs(gain)
    a = np.zeros((size, 2, 2))
    a[:, 0, 0], a[:, 1, 0], a[:, 1, 1] = (
        rng.choice([-1.0, 1.0], size) * 10.0 ** rng.uniform(-2, 2, size),
        gain,
        full,
    )
    b = np.stack([np.abs(a[:, 0, 0]) * rng.uniform(-0.9, 0.9, size), -scale], axis=1)
    v, low, high = np.zeros((size, 2)), np.tile([-1.0, 0.0], (size, 1)), np.ones((size, 2))
    v[:, 0] = rng.normal(size=size)
    w = np.stack([np.ones(size), weight * full**2], axis=1)
    u, margin, _, feasible = many(a, b, v, low, high, w, [1.0, 1.0])
    assert feasible.all()
    assert np.all(margin >= -4 * EPS * np.abs(a).max(axis=2))
    for i in range(0, size, 10):
        best = exact_nearest(*[part[i].tolist() for part in (a, b, v, low, high, w)])
        np.testing.assert_allclose(u[i], list(map(float, best)), atol=1e-12)
