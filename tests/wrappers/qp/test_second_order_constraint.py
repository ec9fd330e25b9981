"""Rows with an uncertainty that depends on the input: one input against a grid, several against the
root at points of the box."""

from __future__ import annotations

import math

import numpy as np
import pytest

from safe_envs.engine.qp import interval
from safe_envs.engine.qp.second_order import majorant, project_arrays, project_floats

EPS = float(np.finfo(float).eps)
LOW, HIGH = -2.0, 1.5
GRID = np.linspace(LOW, HIGH, 1751)
NOTHING = (0.0, 0.0, 0.0)
KINDS = [
    "plain",
    "singular",
    "sizes",
    "no slope",
    "parabola",
    "integers",
    "input alone",
    "certain",
    "far",
]


def random_rows(rng, k, size, kind):
    """a, b (k, size), q (3, k, size), positive semidefinite up to rounding, and v (size,)."""
    a, b = (
        rng.normal(size=(k, size)),
        rng.normal(size=(k, size)) + rng.choice([0.0, 1.0, 4.0], (k, size)),
    )
    factor = rng.normal(size=(k, size, 2, 2)) * rng.choice(
        [0.0, 1e-3, 0.1, 0.5, 2.0], (k, size, 1, 1)
    )
    v = rng.normal(size=size) * 2
    if kind == "singular":
        factor[..., 1] = 0.0
    if kind == "integers":  # edges, ends and touching rows that coincide exactly
        a, b, factor = (
            rng.integers(-2, end, part.shape) * 1.0 for part, end in ((a, 3), (b, 6), (factor, 2))
        )
        v = rng.integers(-3, 4, size) * 0.5
    form = factor @ factor.swapaxes(2, 3)
    q = np.stack([form[..., 0, 0], form[..., 0, 1], form[..., 1, 1]])
    if kind == "no slope":
        a[:] = 0.0
    if kind == "parabola":
        q[2] = a * a
        q[0] = q[1] ** 2 / q[2] * (1.0 + rng.choice([0.0, 1.0], (k, size)))
    if kind == "input alone":
        q[:2] = 0.0
    if kind == "certain":
        q[:] = 0.0
    if kind == "sizes":
        units = 10.0 ** rng.uniform(-6, 6, (k, size))
        a, b, q = a * units, b * units, q * units**2
    if kind == "far":
        v *= 1e6
    return a, b, q, v


def solve(a, b, q, v, priority, low=LOW, high=HIGH):
    return project_arrays(
        list(a), list(b), [tuple(q[:, i]) for i in range(len(a))], v, low, high, priority
    )


def spread(q, u):
    return np.sqrt(np.maximum(q[0] + u * (2.0 * q[1] + u * q[2]), 0.0))


def sizes(a, b, q, u):
    """Of the terms of each row."""
    return np.abs(a * u) + np.abs(b) + np.sqrt(np.abs(q[0]) + 2.0 * np.abs(q[1] * u) + q[2] * u * u)


def rounding(a, b, q, u):
    """Of a margin: some eps of its terms; of the root r of a sum of size s^2, eps s^2/r, which is
    not more than sqrt(eps) s."""
    size = sizes(a, b, q, u)
    return (
        64 * EPS * size * (1.0 + size / np.maximum(spread(q, u), np.sqrt(64 * EPS) * size + 1e-300))
    )


@pytest.mark.parametrize("size", [100, pytest.param(600, marks=pytest.mark.oracle)])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("k", [1, 2, 3])
def test_equals_a_grid(kind, k, size):
    rng = np.random.default_rng([k, KINDS.index(kind)])
    step = GRID[1] - GRID[0]
    a, b, q, v = random_rows(rng, k, size, kind)
    priority = 10.0 ** rng.uniform(-1, 1, k)
    u, margin, active, feasible = solve(a, b, q, v, priority.tolist())
    assert 0.02 * size < np.count_nonzero(feasible) < 0.98 * size
    assert ((u >= LOW) & (u <= HIGH)).all()
    tolerance = rounding(a, b, q, u)
    assert (abs(margin - (a * u + b - spread(q, u))) <= tolerance).all()
    assert (margin >= -tolerance)[:, feasible].all()

    tried = a[..., None] * GRID + b[..., None] - spread(q[..., None], GRID)
    # A margin changes by its steepest slope from one point of the grid to the middle between two.
    reach = 0.5 * step * (abs(a) + np.sqrt(q[2]))[..., None]
    clear = (tried > 1e-9 * sizes(a, b, q, HIGH - LOW)[..., None]).all(axis=0)
    touched = (tried >= -reach - tolerance[..., None]).all(axis=0)
    assert feasible[clear.any(axis=1)].all()
    assert touched[feasible].any(axis=1).all()
    best = np.where(clear, abs(GRID - v[:, None]), np.inf).min(axis=1)
    assert (abs(u - v) <= best * (1 + 4 * EPS) + 1e-9)[feasible].all()
    inside = np.clip(v, LOW, HIGH)
    kept = (a * inside + b - spread(q, inside) >= 0.0).all(axis=0)
    assert (u[kept] == inside[kept]).all()
    assert not active[:, kept].any()

    units = sizes(a, b, q, HIGH - LOW).max(axis=0)
    missed = [
        (priority[:, None] * np.minimum(part / units, 0.0) ** 2).sum(axis=0)
        for part in (margin, *np.moveaxis(tried, 2, 0))
    ]
    blurred = (priority[:, None] * tolerance / units * (abs(margin) + tolerance) / units).sum(
        axis=0
    )
    least = np.array(missed[1:])
    beaten = (missed[0] > least * (1 + 1e-12) + 4 * blurred) & ~feasible
    for j, i in np.argwhere(beaten).tolist():
        # The point of the grid is near a kink, where one bit of the form is far more of its root
        # than at u.
        there = rounding(a[:, i], b[:, i], q[:, :, i], GRID[j])
        blur = (priority * there / units[i] * (abs(tried[:, i, j]) + there) / units[i]).sum()
        assert missed[0][i] <= least[j, i] * (1 + 1e-12) + 4 * (blurred[i] + blur)
    # Rows that are clearly met do not act, and those that are clearly missed do.
    assert not active[margin > tolerance].any()
    assert active[margin < -tolerance].all()


@pytest.mark.parametrize("kind", KINDS)
def test_floats_are_arrays_to_the_last_bit(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    for k in (1, 2, 3):
        a, b, q, v = random_rows(rng, k, 120, kind)
        priority = (10.0 ** rng.uniform(-1, 1, k)).tolist()
        u, margin, active, feasible = solve(a, b, q, v, priority)
        for i in range(24 if k < 3 else 10):
            rows = a[:, i].tolist(), b[:, i].tolist(), [tuple(row) for row in q[:, :, i].T.tolist()]
            found = project_floats(*rows, v[i].item(), LOW, HIGH, priority)
            assert found == (u[i], margin[:, i].tolist(), active[:, i].tolist(), feasible[i])


def test_certain_rows_are_those_of_the_interval_solver():
    rng = np.random.default_rng(5)
    for k in (1, 2, 3):
        a, b, q, v = random_rows(rng, k, 2000, "certain")
        a[rng.random(a.shape) < 0.1] = 0.0
        priority = (10.0 ** rng.uniform(-2, 2, k)).tolist()
        found, known = (
            solve(a, b, q, v, priority),
            interval.project_arrays(list(a), list(b), v, LOW, HIGH, priority),
        )
        assert (found[3] == known[3]).all()
        # A sum of squares s^2 with the curvature c is as large to rounding within sqrt(eps) s/c of
        # its minimum, its slope is not.
        np.testing.assert_allclose(found[0], known[0], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(found[1], known[1], rtol=1e-11, atol=1e-11)
        assert (found[2] == known[2])[:, found[3]].all()


def test_the_form_of_an_input_alone_bounds_its_size():
    # 1 - 2 |u| >= 0, beside u >= .2, and u >= .6, which contradicts: slacks 1 - 2u and u - .6 with
    # the priorities 1 and 9.
    form, none = (0.0, 0.0, 4.0), (0.0, 0.0, 0.0)
    assert project_floats([0.0], [1.0], [form], 3.0, LOW, HIGH, [1.0]) == (0.5, [0.0], [True], True)
    assert project_floats([0.0, 1.0], [1.0, -0.2], [form, none], -3.0, LOW, HIGH, [1.0, 1.0])[
        0
    ] == pytest.approx(0.2, rel=4 * EPS)
    u, margin, active, feasible = project_floats(
        [0.0, 1.0], [1.0, -0.6], [form, none], -3.0, LOW, HIGH, [1.0, 9.0]
    )
    assert u == pytest.approx((2 * 1 + 9 * 0.6) / (4 + 9))
    assert margin == pytest.approx([1 - 2 * u, u - 0.6])
    assert (active, feasible) == ([True, True], False)


def test_of_equally_bad_inputs_the_nearest_is_taken():
    for v, expected in ((0.3, 0.3), (9.0, HIGH), (-9.0, LOW)):
        assert project_floats([0.0], [-1.0], [NOTHING], v, LOW, HIGH, [1.0])[0] == pytest.approx(
            expected, abs=1e-15
        )
        # Beside a row that is met everywhere, they are searched.
        assert project_floats([0.0, 0.0], [-1.0, 1.0], [NOTHING] * 2, v, LOW, HIGH, [1.0] * 2)[
            0
        ] == pytest.approx(expected, abs=1e-15)
    # u + 1 - |u + 2|: -1 from -2 on, and less before it. Near -2 the root of a square is known to
    # sqrt(eps).
    for v in (0.3, 9.0, -2.5):
        u, margin, _, feasible = project_floats(
            [1.0], [1.0], [(4.0, 2.0, 1.0)], v, -3.0, 1.5, [1.0]
        )
        assert -2.0 - 1e-6 <= u <= 1.5
        assert (margin, feasible) == ([pytest.approx(-1.0)], False)


def test_a_state_is_solved_alike_in_every_batch():
    rng = np.random.default_rng(7)
    a, b, q, v = random_rows(rng, 2, 60, "plain")
    whole = solve(a, b, q, v, [1.0, 2.0])
    for i in range(60):
        alone = solve(a[:, [i]], b[:, [i]], q[:, :, [i]], v[[i]], [1.0, 2.0])
        for parts, part in zip(whole, alone, strict=True):
            assert np.array_equal(parts[..., i], part[..., 0])


def test_what_changes_the_input_is_active():
    u, _, active, feasible = project_floats(
        [-1.07], [-0.21], [(0.09, 0.3 * 1.5, 2.25)], 3.7, LOW, HIGH, [1.0]
    )
    assert feasible
    assert u < HIGH
    assert active == [True]


def test_the_least_violating_input_of_an_endless_box():
    # u - 1 - 2 |u| is at most -1, at 0.
    u, margin, _, feasible = project_floats(
        [1.0], [-1.0], [(0.0, 0.0, 4.0)], 3.0, -1e100, 1.3e100, [1.0]
    )
    assert not feasible
    assert (u, margin) == (pytest.approx(0.0, abs=1e-6), [pytest.approx(-1.0)])


def test_the_least_violating_input_of_an_endless_box_beside_another_row():
    u, margin, _, feasible = project_floats(
        [1.0, 0.0], [-1.0, 1.0], [(0.0, 0.0, 4.0), NOTHING], 3.0, -1e100, 1.3e100, [1.0] * 2
    )
    assert not feasible
    assert (u, margin) == (pytest.approx(0.0, abs=1e-6), [pytest.approx(-1.0), 1.0])


@pytest.mark.parametrize("unit", [1e-100, 1e-85, 1e85, 1e100])
def test_the_unit_of_a_row_does_not_matter(unit):
    row = [unit], [-0.2 * unit], [(0.01 * unit**2, 0.0, 0.01 * unit**2)]
    assert project_floats(*row, 0.0, -1.0, 1.0, [1.0])[0] == pytest.approx(0.30453425823325)


def test_a_row_of_nearly_no_slope_that_is_met_everywhere_does_not_forbid_the_rest():
    rows = [1e-170, 1.0], [1.0, -0.5]
    assert interval.project_arrays(*rows, np.zeros(1), -1.0, 1.0, [1.0] * 2)[3].all()
    assert project_floats(*rows, [NOTHING] * 2, 0.0, -1.0, 1.0, [1.0] * 2)[3]


@pytest.mark.parametrize("q2", [1e-300, 1e-170, 1e-20])
def test_a_form_that_hardly_bends_has_a_maximiser_in_both_flavours(q2):
    for a in (0.0, 0.5 * math.sqrt(q2), 2.0 * math.sqrt(q2)):
        row = [a], [-1.0], [(1.0, 0.0, q2)]
        u, margin, active, feasible = project_floats(*row, 0.5, LOW, HIGH, [1.0])
        found = project_arrays(*row, np.array([0.5]), LOW, HIGH, [1.0])
        assert LOW <= u <= HIGH
        assert (u, margin, active, feasible) == (
            found[0][0],
            found[1][:, 0].tolist(),
            found[2][:, 0].tolist(),
            found[3][0],
        )
        assert not feasible


def test_rows_that_meet_in_one_point_are_feasible_whatever_their_scale():
    for scale in (3.0, 7e5, 0.1):
        rows = [1.0, -scale], [-0.3, 0.3 * scale]
        assert interval.project_arrays(*rows, np.full(1, 0.9), -1.0, 1.0, [1.0] * 2)[3].all()
        assert project_floats(*rows, [NOTHING] * 2, 0.9, -1.0, 1.0, [1.0] * 2)[3]


def random_forms(rng, m, size, rank=None):
    factor = rng.normal(size=(size, m + 1, rank or m + 1)) * 10.0 ** rng.uniform(
        -2, 2, (size, 1, 1)
    )
    return factor @ factor.swapaxes(1, 2)


def plane_of(form, low, high):
    m = len(low)
    slopes, constant = majorant(
        [[form[:, i, j] for j in range(m + 1)] for i in range(m + 1)], low, high
    )
    return np.stack(slopes, axis=1), constant


def roots_at(form, points):
    lifted = np.column_stack((np.ones(len(points)), points))
    return np.sqrt(np.maximum(np.einsum("pi,bij,pj->bp", lifted, form, lifted), 0.0))


@pytest.mark.parametrize("m", [1, 2, 3, 4])
@pytest.mark.parametrize("bounds", [(-1.0, 2.0), (-1.0, 1.0), (0.0, 1e5), (-3e-3, -1e-3)])
def test_the_plane_is_above_the_root_and_touches_it(m, bounds):
    rng = np.random.default_rng(m)
    low, high = [bounds[0]] * m, [bounds[1] * (1 + 0.1 * j) for j in range(m)]
    form = np.concatenate([random_forms(rng, m, 150), random_forms(rng, m, 50, rank=1)])
    form[::2, 1:] /= bounds[1] - bounds[0]
    form[::2, :, 1:] /= bounds[1] - bounds[0]
    slopes, constant = plane_of(form, low, high)
    points = np.concatenate(
        [
            rng.uniform(low, high, (300, m)),
            np.stack(np.meshgrid(*zip(low, high, strict=True)), -1).reshape(-1, m),
        ]
    )
    gap = constant[:, None] + slopes @ points.T - roots_at(form, points)
    size = roots_at(abs(form), abs(points)).max(axis=1)
    assert (gap.min(axis=1) >= -1e-13 * size).all()
    # No smaller constant would do: at one corner there is no gap.
    assert (gap[:, 300:].min(axis=1) <= 1e-13 * size).all()
    if m == 1:
        assert (abs(gap[:, 300:]) <= 1e-13 * size[:, None]).all()


def test_the_plane_of_a_root_without_a_direction_is_level():
    # sqrt(1 + |u|^2) on a box about 0: all corners are alike, and the plane is the value there.
    for m in (1, 2, 3, 4):
        slopes, constant = majorant(np.eye(m + 1).tolist(), [-2.0] * m, [2.0] * m)
        assert slopes == pytest.approx([0.0] * m, abs=1e-15)
        assert constant == pytest.approx(np.sqrt(1 + 4 * m))


def test_the_plane_of_a_linear_root_is_the_root():
    rng = np.random.default_rng(2)
    for m in (1, 2, 3, 4):
        low, high = [-1.0] * m, [2.0] * m
        linear = rng.normal(size=(100, m))
        offset = abs(linear).sum(axis=1) * 2 + rng.random(100)  # positive everywhere in the box
        row = np.column_stack((offset, linear)) * rng.choice([-1.0, 1.0], (100, 1))
        slopes, constant = plane_of(row[:, :, None] * row[:, None, :], low, high)
        np.testing.assert_allclose(slopes, linear, atol=1e-13 * abs(row).max())
        np.testing.assert_allclose(constant, offset, rtol=1e-13)


def test_the_plane_takes_numbers_as_well_as_arrays():
    rng = np.random.default_rng(3)
    form = random_forms(rng, 2, 5)
    slopes, constant = plane_of(form, [-1.0, 0.0], [1.0, 2.0])
    for i in range(5):
        alone, above = majorant(form[i].tolist(), [-1.0, 0.0], [1.0, 2.0])
        assert alone == pytest.approx(slopes[i].tolist(), rel=1e-14)
        assert above == pytest.approx(constant[i], rel=1e-14)
