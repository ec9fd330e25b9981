"""Several rows and one input, against enumeration of roots, ends and violated sets."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest

from safe_envs.engine.qp.dispatch import project_arrays, project_floats

EPS = float(np.finfo(float).eps)


def nearest_oracle(a, b, v, low, high):
    """The nearest of all roots, ends and v that meets every row, or None."""
    candidates = [v, low, high, *(-b[a != 0.0] / a[a != 0.0])]
    met = [
        u
        for u in candidates
        if low <= u <= high and np.all(a * u + b >= -8 * EPS * (np.abs(a * u) + np.abs(b)))
    ]
    return min(met, key=lambda u: abs(u - v), default=None)


def least_oracle(a, b, v, low, high, priority):
    """Of the stationary points of all violated sets, the roots, the ends and v: the least sum, then
    the nearest; in rationals."""
    rows = [tuple(map(Fraction, row)) for row in zip(a, b, priority, strict=True)]
    v, low, high = map(Fraction, (v, low, high))
    candidates = [low, high, v, *(-bi / ai for ai, bi, _ in rows if ai)]
    sloping = [row for row in rows if row[0]]
    for chosen in itertools.chain(
        *(itertools.combinations(sloping, size) for size in range(1, len(sloping) + 1))
    ):
        candidates += [
            -sum(p * ai * bi for ai, bi, p in chosen) / sum(p * ai**2 for ai, _, p in chosen)
        ]
    inside = {min(max(u, low), high) for u in candidates}
    return float(
        min(
            inside,
            key=lambda u: (sum(p * min(ai * u + bi, 0) ** 2 for ai, bi, p in rows), abs(u - v)),
        )
    )


def random_problem(rng, k, kind):
    a, b, v = rng.normal(size=k), rng.normal(size=k) * 0.7, rng.normal() * 2
    low, high, priority = -1.0, 1.5, 10.0 ** rng.uniform(-2, 2, k)
    if kind == "sizes":
        size = 10.0 ** rng.uniform(-3, 6, k)
        a, b = a * size, b * size
    if kind == "flat":
        a[rng.random(k) < 0.4] = 0.0
    if kind == "integers":
        a, b, v = (
            rng.integers(-2, 3, k) * 1.0,
            rng.integers(-2, 3, k) * 1.0,
            rng.integers(-3, 4) * 1.0,
        )
    if kind == "thousands":
        a, low, high, v = a / 5000.0, -5000.0, 5000.0, v * 5000.0
    if kind == "endless":
        low, high = -1e100, 1e100
    if kind == "far":
        v *= 1e8
    return a, b, float(v), low, high, priority


@pytest.mark.parametrize(
    ("size", "unmet"), [(30, 8), pytest.param(30, 30, marks=pytest.mark.oracle)]
)
@pytest.mark.parametrize(
    "kind", ["plain", "sizes", "flat", "integers", "thousands", "endless", "far"]
)
def test_equals_enumeration_in_floats_and_in_arrays(kind, size, unmet):
    rng = np.random.default_rng(len(kind))
    for k in range(1, 7):
        problems = [random_problem(rng, k, kind) for _ in range(size)]
        a, b, v, low, high, priority = map(np.array, zip(*problems, strict=True))
        priority[:] = priority[0]
        batch = project_arrays(
            [[row] for row in a.T], list(b.T), [v], [low], [high], [1.0], priority[0].tolist()
        )
        seen, enumerated = set(), 0
        for i in range(len(problems)):
            u, margin, active, feasible = project_floats(
                a[i][:, None].tolist(),
                b[i].tolist(),
                [v[i].item()],
                [low[i].item()],
                [high[i].item()],
                [1.0],
                priority[i].tolist(),
            )
            assert [c[i] for c in batch[0]] == u
            assert [c[i] for c in batch[1]] == margin
            assert [c[i] for c in batch[2]] == active
            assert batch[3][i] == feasible
            assert low[i] <= u[0] <= high[i]
            terms = np.abs(a[i] * u[0]) + np.abs(b[i])
            np.testing.assert_allclose(margin, a[i] * u[0] + b[i], rtol=0, atol=EPS * terms.max())
            best = nearest_oracle(a[i], b[i], v[i], low[i], high[i])
            seen.add(feasible)
            assert feasible == (best is not None)
            if best is None:
                assert any(active)
                # Rational arithmetic over all violated sets takes most of the time.
                enumerated += 1
                best = (
                    least_oracle(a[i], b[i], v[i], low[i], high[i], priority[i])
                    if enumerated <= unmet
                    else u[0]
                )
            else:
                assert np.all(np.array(margin) >= -2 * EPS * terms)
            np.testing.assert_allclose(u[0], best, rtol=1e-12, atol=1e-15)
            changed = np.any(a[i] * np.clip(v[i], low[i], high[i]) + b[i] < 0.0)
            binding = np.array(margin) <= 1e-12 * terms
            assert active == (binding & changed).tolist()
        assert seen == {True, False} or (kind, k) == ("endless", 1)


def test_unmet_flat_row_does_not_switch_the_others_off():
    u, margin, active, feasible = project_floats(
        [[0.0], [1.0], [-1.0]], [-1.0, -0.5, 2.0], [0.0], [-1.0], [1.0], [1.0], [1.0] * 3
    )
    assert (u, margin, active, feasible) == ([0.5], [-1.0, 0.0, 1.5], [True, True, False], False)


def test_rows_that_meet_in_one_point_are_feasible_whatever_their_scale():
    for scale in (0.1, 3.0, 7e5):
        point = 0.3
        a, b = [[1.0], [-scale]], [-point, scale * point]
        u, _, active, feasible = project_floats(a, b, [0.9], [-1.0], [1.0], [1.0], [1.0, 1.0])
        assert u[0] == pytest.approx(point, rel=4 * EPS)
        assert (active, feasible) == ([True, True], True)
        _, _, _, feasible = project_floats(
            a, [-point * (1 + 1e-13), scale * point], [0.9], [-1.0], [1.0], [1.0], [1.0, 1.0]
        )
        assert not feasible


def test_row_of_higher_priority_gives_way_by_as_much_less():
    u, margin, _, feasible = project_floats(
        [[1.0], [-1.0]], [-0.5, 0.0], [0.0], [-1.0], [1.0], [1.0], [1e4, 1.0]
    )
    assert not feasible
    assert margin[0] / margin[1] == pytest.approx(1e-4)
    assert u[0] == pytest.approx(0.5 * 1e4 / (1e4 + 1))


def test_gain_too_small_to_divide_by_saturates():
    for other in ([1.0, 0.5], [0.0, 1.0]):
        u, margin, _, feasible = project_floats(
            [[1e-320], [other[0]]], [-1.0, other[1]], [0.0], [-1.0], [1.0], [1.0], [1.0, 1.0]
        )
        assert u == [1.0]
        assert np.all(np.isfinite(margin))
        assert not feasible


def test_bounds_of_each_state_and_independence_of_the_batch():
    rng = np.random.default_rng(3)
    size, k = 200, 9
    a, b, v = (
        rng.normal(size=(k, size)),
        rng.normal(size=(k, size)) * 0.4 + 0.5,
        rng.normal(size=size),
    )
    low, high = -rng.random(size), rng.random(size)

    def solve(states):
        rows = [[row[states]] for row in a]
        return project_arrays(
            rows,
            [row[states] for row in b],
            [v[states]],
            [low[states]],
            [high[states]],
            [1.0],
            [1.0] * k,
        )

    whole = solve(np.arange(size))
    assert 20 < np.count_nonzero(whole[3]) < size - 20
    for i in range(size):
        alone = solve(np.array([i]))
        for parts, part in zip(whole[:3], alone[:3], strict=True):
            assert [p[i] for p in parts] == [p[0] for p in part]
