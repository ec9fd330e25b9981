"""The closed form for one row, against brute force and against ProxQP."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import qpsolvers

from safe_envs.engine.qp.one_constraint import project_arrays, project_floats
from safe_envs.engine.qp.rounding import added

project_arrays = np.errstate(divide="ignore")(project_arrays)

EPS = float(np.finfo(float).eps)


def oracle(a, b, v, low, high, w):
    """The minimiser by enumeration: each component at an end of its interval or free, with the row
    active or not.

    Among all candidates that satisfy the constraints, the nearest one; None if there is none.
    """
    m = len(v)
    best, best_cost = None, np.inf
    for active in (False, True):
        for pattern in itertools.product((-1, 0, 1), repeat=m):
            p = np.array(pattern)
            u = np.where(p < 0, low, np.where(p > 0, high, v))
            if active:
                free = p == 0
                slope = np.sum(a[free] ** 2 / w[free])
                if slope == 0.0:
                    continue
                multiplier = -(b + a @ u) / slope
                u = np.where(free, u + multiplier * a / w, u)
            scale = abs(b) + np.abs(a) @ np.abs(u)
            if (
                np.all(u >= low - 1e-12)
                and np.all(u <= high + 1e-12)
                and b + a @ u >= -1e-12 * (1 + scale)
            ):
                cost = np.sum(w * (u - v) ** 2)
                if cost < best_cost:
                    best, best_cost = u, cost
    return best


def random_problem(rng, m):
    a = rng.normal(size=m) * 10.0 ** rng.uniform(-2, 2)
    a[rng.random(m) < 0.15] = 0.0
    low, high = np.sort(rng.normal(size=(2, m)) * 3, axis=0)
    high += 0.05
    return (
        a,
        rng.normal() * 3 * (np.abs(a).sum() + 0.1),
        rng.normal(size=m) * 4,
        low,
        high,
        rng.uniform(0.2, 5.0, m),
    )


@pytest.mark.parametrize("size", [100, pytest.param(5000, marks=pytest.mark.oracle)])
@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_equals_enumeration_and_both_flavours_agree(m, size):
    rng = np.random.default_rng(m)
    problems = [random_problem(rng, m) for _ in range(size)]
    met = 0
    for a, b, v, low, high, w in problems:
        u, margin, active, feasible = project_floats(a, b, v, low, high, w)
        u = np.array(u)
        best = oracle(a, b, v, low, high, w)
        assert np.all((u >= low) & (u <= high))
        assert feasible == (best is not None)
        assert margin == pytest.approx(b + a @ u, abs=1e-12 * (1 + abs(b)))
        if best is None:
            assert margin == pytest.approx(b + np.where(a > 0, a * high, a * low).sum(), rel=1e-12)
        else:
            met += 1
            np.testing.assert_allclose(u, best, atol=1e-9)
        # The batch holds this problem beside two others, so that masks cannot leak from row to row.
        aa, bb = np.stack([a, -a, 0 * a], axis=1), np.array([b, b, b])
        batch = project_arrays(aa, bb, [np.full(3, c) for c in v], low, high, w)
        np.testing.assert_allclose([c[0] for c in batch[0]], u, atol=1e-12 * (1 + np.abs(v).max()))
        assert (batch[2][0], batch[3][0]) == (active, feasible)
    assert 0.25 * size < met < size, "the sample must hold both feasible and infeasible rows"


@pytest.mark.parametrize("m", [1, 2, 4])
def test_equals_proxqp(m):
    rng = np.random.default_rng(10 + m)
    compared = 0
    for _ in range(1000):
        a, b, v, low, high, w = random_problem(rng, m)
        u, _, active, feasible = project_floats(a, b, v, low, high, w)
        if not (feasible and active):
            continue
        scale = np.abs(a).max()
        solution = qpsolvers.solve_qp(
            np.diag(w),
            -w * v,
            -a[None] / scale,
            np.array([b / scale]),
            lb=low,
            ub=high,
            solver="proxqp",
            eps_abs=1e-10,
            eps_rel=0.0,
            check_duality_gap=True,
            eps_duality_gap_abs=1e-10,
        )
        if solution is None:
            continue  # ProxQP gives up on a few feasible problems; its answers are what is compared
        np.testing.assert_allclose(u, solution, atol=1e-6)
        compared += 1
    assert compared > 50


def test_peers_case_returns_the_least_violating_action_and_says_so():
    # peers.md: nominal 3, box 10, a row that no action meets. Right: 10, flagged, with its slack.
    u, margin, active, feasible = project_floats([1.0], -13.0, [3.0], [-10.0], [10.0], [1.0])
    assert (u, margin, active, feasible) == ([10.0], -3.0, True, False)


def test_flat_row_leaves_the_action_and_decides_by_its_offset():
    for b, feasible in ((0.0, True), (1e-300, True), (-1e-300, False), (-2.0, False)):
        u, _, _, met = project_floats(
            [0.0, 0.0], b, [3.0, 0.5], [-1.0, -1.0], [1.0, 1.0], [1.0, 1.0]
        )
        assert (u, met) == ([1.0, 0.5], feasible)
        u, _, _, met = project_floats([0.0], b, [0.5], [-1.0], [1.0], [1.0])
        assert (u, met) == ([0.5], feasible)
        arrays = project_arrays(
            [np.zeros(2)], np.full(2, b), [np.array([0.5, 3.0])], [-1.0], [1.0], [1.0]
        )
        np.testing.assert_array_equal(arrays[0][0], [0.5, 1.0])
        assert arrays[3].tolist() == [feasible, feasible]


def test_tiny_gain_saturates_without_overflow_warnings():
    u, margin, _, feasible = project_floats([1e-320], -1.0, [0.0], [-1.0], [1.0], [1.0])
    assert u == [1.0]
    assert not feasible
    assert margin == pytest.approx(-1.0)


def test_row_that_only_the_corner_meets_is_feasible():
    u, _, _, feasible = project_floats(
        [1.0, 1.0], -2.0, [0.0, 0.3], [-1.0, -1.0], [1.0, 1.0], [1.0, 1.0]
    )
    np.testing.assert_allclose(u, [1.0, 1.0], atol=4 * EPS)
    assert feasible


def test_proposal_outside_the_box_is_projected_onto_row_and_box_at_once():
    # Clipping first and projecting then would give (0.5, 0.5).
    u, *_ = project_floats([-1.0, -1.0], 1.0, [3.0, 1.0], [-1.0, -1.0], [1.0, 1.0], [1.0, 1.0])
    np.testing.assert_allclose(u, [1.0, 0.0], atol=1e-12)


def test_feasibility_is_decided_by_the_reach_of_the_box_and_not_by_rounding():
    u, _, _, feasible = project_floats(
        [-1.0202216377232305, 0.14422933038232305],
        -0.011445797228288595,
        [2.182723419535889, -0.11143900878845633],
        [-1.5263859058894809, -0.4477092783909338],
        [0.27884684919436314, 2.9190568849119978],
        [1.0, 1.0],
    )
    assert feasible
    np.testing.assert_allclose(u, [0.01632375909475714, 0.19482617988487125], rtol=1e-12)


@pytest.mark.parametrize("size", [1e-300, 1e-200, 1.0, 1e200, 1e300])
def test_size_of_a_row_does_not_matter(size):
    arguments = ([0.0, 0.3], [-1.0, -1.0], [1.0, 1.0], [1.0, 1.0])
    u, _, _, feasible = project_floats([size, 2 * size], -1.5 * size, *arguments)
    assert feasible
    np.testing.assert_allclose(u, [0.18, 0.66], rtol=1e-12)
    v, low, high, w = arguments
    arrays = project_arrays(
        [np.array([size]), np.array([2 * size])],
        np.array([-1.5 * size]),
        [np.array([c]) for c in v],
        low,
        high,
        w,
    )
    np.testing.assert_allclose([c[0] for c in arrays[0]], u, rtol=1e-12)
    assert arrays[3].tolist() == [True]


def test_weights_and_bounds_of_each_state():
    rng = np.random.default_rng(4)
    problems = [random_problem(rng, 3) for _ in range(200)]
    a, b, v, low, high, w = [np.array(part) for part in zip(*problems, strict=True)]
    found = project_arrays(list(a.T), b, list(v.T), list(low.T), list(high.T), list(w.T))
    for i, problem in enumerate(problems):
        u, margin, active, feasible = project_floats(
            *[part.tolist() if isinstance(part, np.ndarray) else part for part in problem]
        )
        np.testing.assert_allclose([c[i] for c in found[0]], u, rtol=1e-12, atol=1e-12)
        assert found[1][i] == pytest.approx(margin, rel=1e-12, abs=1e-12 * (1 + np.abs(a[i]).max()))
        assert (found[2][i], found[3][i]) == (active, feasible)


def test_two_inputs_have_the_answer_of_the_general_way():
    # A third input without a say takes the general way.
    rng = np.random.default_rng(21)
    ends = set()
    for _ in range(2000):
        a, b, _, low, high, w = random_problem(rng, 2)
        v = low + rng.choice([-40.0, -0.6, 0.0, 0.3, 0.8, 1.0, 1.7], 2) * (high - low)
        u, _, active, feasible = project_floats(
            a.tolist(), b, v.tolist(), low.tolist(), high.tolist(), w.tolist()
        )
        general = [
            np.append(part, end).tolist()
            for part, end in zip((v, low, high), (0, -1, 1), strict=True)
        ]
        expected = project_floats([*a.tolist(), 0.0], b, *general, [*w.tolist(), 1.0])
        np.testing.assert_allclose(u, expected[0][:2], rtol=1e-12, atol=1e-12)
        assert (active, feasible) == expected[2:]
        assert np.all((low <= u) & (u <= high))
        ends.add((active, feasible, int(np.isin(u, (low, high)).sum())))
    assert ends >= {(True, True, 0), (True, True, 1), (True, False, 2), (False, True, 0)}


def test_sums_are_the_same_in_every_version_of_python():
    """From 3.12 on the built-in sum of these is 2.0, and that of an array remains 0.0."""
    terms = [1.0, 1e100, 1.0, -1e100]
    assert added(terms) == added(np.array([terms]).T)[0] == 0.0
